"""Streams that need more than the autopilot's snapshot.

RC_CHANNELS echoes the newest RC_CHANNELS_OVERRIDE (PX4 1.16, streams/RC_CHANNELS.hpp and
MavlinkReceiver::handle_message_rc_channels_override).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.autopilot.port import AutopilotPort
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.codec import SYSTEM_ID, Values, WireMessage
from firmware_sim.mavlink.streams import Builder, information, sensor_streams
from firmware_sim.mavlink.streams.pose import hil_state_quaternion
from firmware_sim.mavlink.streams.sensor_streams import VibrationMeter
from firmware_sim.mavlink.streams.status import manual_control
from firmware_sim.mavlink.streams.units import UINT16_MAX, boot_ms


class OwnStreams:
    """Stream builders of one server, for any attached autopilot.

    All links share the builders, so each message is built once per tick.
    """

    def __init__(self) -> None:
        """Start without an autopilot: the builders return None."""
        self.vibration = VibrationMeter()
        self._port: AutopilotPort | None = None
        self._truth: Callable[[], TrueState] | None = None
        self._system_id = SYSTEM_ID
        self.builders: Mapping[str, Builder] = {
            # The lambda resolves the meter at call time.
            "VIBRATION": lambda state: self.vibration.message(state),
            "BATTERY_STATUS": self._battery_status,
            "TIME_ESTIMATE_TO_TARGET": self._time_estimate,
            "HIL_STATE_QUATERNION": self._hil_state_quaternion,
            "MAG_CAL_REPORT": self._mag_cal_report,
            "MANUAL_CONTROL": lambda state: manual_control(state, self._system_id),
        }

    def attach(
        self, port: AutopilotPort, truth: Callable[[], TrueState] | None, system_id: int
    ) -> None:
        """Attach another autopilot, with its vehicle's true state; None = unavailable."""
        self._port, self._truth, self._system_id = port, truth, system_id
        self.vibration = VibrationMeter()

    def _battery_status(self, state: AutopilotState) -> Values | None:
        if self._port is None:
            return None
        return sensor_streams.battery_status(state, self._port.parameters)

    def _hil_state_quaternion(self, _state: AutopilotState) -> Values | None:
        if self._truth is None:
            return None
        truth = self._truth()
        return hil_state_quaternion(truth, truth.time_us)

    def _mag_cal_report(self, _state: AutopilotState) -> Values | None:
        return (
            None
            if self._port is None
            else sensor_streams.mag_cal_report(self._port.parameters.value)
        )

    def _time_estimate(self, state: AutopilotState) -> Values | None:
        if self._port is None:
            return None
        return information.time_estimate_to_target(state, self._port.parameters.value)


CHANNELS = 18
_ZERO_SAYS_NOTHING = 8
"""First channel for which 0 means unused. UINT16_MAX means unused for all channels."""
_FULL_SIGNAL = 100


class Radio:
    """Channel values of the newest RC_CHANNELS_OVERRIDE, common to all clients."""

    def __init__(self) -> None:
        self._said: tuple[int, ...] = ()
        self._time_us = 0
        self._count = 0
        """Number of RC_CHANNELS_OVERRIDE messages received."""

    def hear(self, message: WireMessage, now_us: int) -> None:
        """Store an RC_CHANNELS_OVERRIDE received at simulated `now_us` [µs]."""
        said = [getattr(message, f"chan{number}_raw") for number in range(1, CHANNELS + 1)]
        # Trailing unused channels do not count: PX4 reports the number of channels up to the last
        # used one.
        while said and _says_nothing(said[-1], len(said) - 1):
            said.pop()
        self._said, self._time_us = tuple(said), now_us
        self._count += 1

    def updates(self) -> Builder:
        """Return a builder of RC_CHANNELS for one link. Sends each update once."""
        # Updates before the link opened are not sent.
        sent = self._count

        def build(_state: AutopilotState) -> Values | None:
            nonlocal sent
            if sent == self._count:
                return None
            sent = self._count
            said = self._said
            # RC_CHANNELS always has 18 values; UINT16_MAX marks the missing ones.
            unused = (UINT16_MAX,) * (CHANNELS - len(said))
            signal = _FULL_SIGNAL if said else 0
            return boot_ms(self._time_us), len(said), *said, *unused, signal

        return build


def _says_nothing(width: int, place: int) -> bool:
    return width == UINT16_MAX or (width == 0 and place >= _ZERO_SAYS_NOTHING)
