"""The streams that need more of a vehicle than its autopilot's snapshot."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.autopilot.port import AutopilotPort
from firmware_sim.interfaces import Truth
from firmware_sim.mavlink.codec import SYSTEM_ID, Values
from firmware_sim.mavlink.streams import Builder, information, sensors
from firmware_sim.mavlink.streams.pose import hil_state_quaternion
from firmware_sim.mavlink.streams.sensors import VibrationMeter
from firmware_sim.mavlink.streams.status import manual_control


class OwnStreams:
    """Builds them for one server, whatever autopilot is attached to it.

    The same functions for every link: what two links send in one tick is built once.
    """

    def __init__(self) -> None:
        """Begin without an autopilot: there is nothing to say."""
        self.vibration = VibrationMeter()
        self._port: AutopilotPort | None = None
        self._truth: Callable[[], Truth] | None = None
        self._system_id = SYSTEM_ID
        self.builders: Mapping[str, Builder] = {
            "VIBRATION": lambda state: self.vibration.message(state),
            "BATTERY_STATUS": self._battery_status,
            "TIME_ESTIMATE_TO_TARGET": self._time_estimate,
            "HIL_STATE_QUATERNION": self._hil_state_quaternion,
            "MAG_CAL_REPORT": self._mag_cal_report,
            "MANUAL_CONTROL": lambda state: manual_control(state, self._system_id),
        }

    def attach(
        self, port: AutopilotPort, truth: Callable[[], Truth] | None, system_id: int
    ) -> None:
        """Speak for another autopilot, and of where its vehicle truly is; None = nobody knows."""
        self._port, self._truth, self._system_id = port, truth, system_id
        self.vibration = VibrationMeter()

    def _battery_status(self, state: AutopilotState) -> Values | None:
        if self._port is None:
            return None
        return sensors.battery_status(state, self._port.parameters)

    def _hil_state_quaternion(self, _state: AutopilotState) -> Values | None:
        if self._truth is None:
            return None
        truth = self._truth()
        return hil_state_quaternion(truth, truth.time_us)

    def _mag_cal_report(self, _state: AutopilotState) -> Values | None:
        return None if self._port is None else sensors.mag_cal_report(self._port.parameters.value)

    def _time_estimate(self, state: AutopilotState) -> Values | None:
        if self._port is None:
            return None
        return information.time_estimate_to_target(state, self._port.parameters.value)
