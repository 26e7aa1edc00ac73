"""Hardware in the loop: a PX4 board that flies on simulated sensors over a serial or USB line.

There is no lockstep: the board runs on its own clock. Every tick sends sensors to the board and
applies its newest motor commands, delayed by a transfer and a cycle of the board.

Source: PX4, src/modules/mavlink: mavlink_receiver.cpp (HIL_SENSOR, HIL_GPS),
streams/HIL_ACTUATOR_CONTROLS.hpp; Commander.cpp (reboot).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import TICK_HZ, US_PER_S
from airl_mav.core.errors import UsageError
from firmware_sim import interfaces
from firmware_sim.addons.px4_hitl.board_link import BoardLink
from firmware_sim.addons.px4_hitl.line import Router
from firmware_sim.external import hil_messages as hil
from firmware_sim.external import parameters
from firmware_sim.external.flight_stack import FirmwareRequest
from firmware_sim.external.launcher import Launcher, no_process
from firmware_sim.external.programs import FirmwareKind
from firmware_sim.mavlink.endpoint import Endpoint

SILENCE_US = US_PER_S
"""Maximum time without motor commands after the first command [wall µs]."""

FIRST_CONTROLS_US = 10 * US_PER_S
"""Maximum time from the first sample to the first motor command [wall µs]."""

EPOCH_US = US_PER_S
"""Time in the first sample [µs]; the board uses its own clock instead."""

_CREEP_US = 20
_BEHIND_US = 20_000


class BoardPace:
    """Limiter to 250 ticks per second of wall time, as the board's clock is not simulated.

    If another clock already paces the ticks, the limiter adapts to its punctual ticks and does not
    wait.
    """

    def __init__(self, clock: WallClock) -> None:
        self._clock = clock
        self._origin_us: int | None = None
        """Wall time of simulated time 0 [µs]."""

    def wait(self, time_us: int) -> None:
        """Wait for the tick of simulated `time_us` [µs]."""
        now_us = self._clock.time_us()
        if self._origin_us is None:
            self._origin_us = now_us - time_us
        ahead_us = self._origin_us + time_us - now_us
        if ahead_us > 0:
            # Another pace may be permanently ahead: follow it slowly.
            self._origin_us -= min(ahead_us, _CREEP_US)
            self._clock.sleep_until(self._origin_us + time_us)
        elif ahead_us < -_BEHIND_US:
            self._origin_us = now_us - time_us


class HitlBridge:
    """Bridge to one board for one episode. Implements `Bridge`.

    A lost device, missing or invalid motor commands, a restart or leaving HIL mode end the flight
    (`FirmwareLostError`). Sensors are sent once HIL mode is reported. HIL_STATE_QUATERNION is never
    sent: a board would use it as its estimate.
    """

    rate_hz = TICK_HZ

    def __init__(self, link: BoardLink) -> None:
        """Set the link to the board, shared by all episodes and not yet opened."""
        self.armed = False
        self.time_us = 0
        self._link = link
        self._pace = BoardPace(link.clock)
        self._epoch_us: int | None = None
        """Simulated time at the board's time 0 [µs]."""
        self._began_us = 0
        """Time of the first sample [wall µs]."""
        self._stuck_us: int | None = None
        """Time since which the line has accepted no samples [wall µs]; None = not blocked."""
        self._stepped_us = 0
        """Time of the newest step [wall µs]."""
        self._resumed_us = 0
        """Time when this process resumed after a pause [wall µs]."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Find the board in HIL mode, reboot it, and find it again; see `Bridge`."""
        link = self._link
        returning, link.known = link.known, True
        rebooted, link.went_down = link.went_down, False
        link.connect(timeout_s, alive, returning=returning)
        if not rebooted:
            # The estimator may still contain an earlier flight.
            link.go_down(alive)
            link.connect(timeout_s, alive, returning=True)

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Send a tick's sensors and return the newest motor commands, initially stopped."""
        self._pace.wait(sample.time_us)
        link = self._link
        link.pump()
        now_us = link.clock.time_us()
        if self._epoch_us is None:
            self._epoch_us = sample.time_us - EPOCH_US
            self._began_us = now_us
            link.board.controls = None  # from before the episode
        if now_us - self._stepped_us > SILENCE_US // 2:
            self._resumed_us = now_us  # a board without sensors sends no commands
        self._stepped_us = now_us
        self._check(now_us)
        self._send(sample, sample.time_us - self._epoch_us, now_us)
        link.beat()
        message = link.board.controls
        if message is None:
            return interfaces.ActuatorControls(sample.time_us, hil.STILL, armed=False)
        self.time_us = int(message.time_usec)
        try:
            controls = hil.controls(message, sample.time_us)
        except hil.ControlsError as error:
            raise interfaces.FirmwareLostError(f"{link.device}: {error}") from error
        self.armed = controls.armed
        return controls

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Ignore the true state: a board would use it as its estimate."""

    def close(self) -> None:
        """Disarm the board and close the device. Idempotent."""
        link = self._link
        if link.board.rebooting:
            # The next connection must not mistake this board for a rebooted board.
            with suppress(interfaces.FirmwareLostError):
                link.go_down(no_process)
                link.went_down = True
        elif self.armed or link.board.armed:
            link.disarm()
        link.close()

    def _check(self, now_us: int) -> None:
        board, device = self._link.board, self._link.device
        if self._link.lost is not None:
            raise interfaces.FirmwareLostError(self._link.lost)
        if board.rebooting:
            raise interfaces.FirmwareLostError(f"{device}: the board was told to reboot, and does")
        if board.restarted:
            raise interfaces.FirmwareLostError(
                f"{device}: the board has restarted: its clock went back"
            )
        if not board.hil:
            raise interfaces.FirmwareLostError(f"{device}: the board has left HIL mode")
        quiet_us = now_us - max(board.controls_us, self._resumed_us)
        if board.controls is not None and quiet_us > SILENCE_US:
            raise interfaces.FirmwareLostError(
                f"{device}: board silent: no HIL_ACTUATOR_CONTROLS for "
                f"{(now_us - board.controls_us) / US_PER_S:.1f} s"
            )
        problem = board.setup_problem()
        if board.controls is None and now_us - self._began_us > FIRST_CONTROLS_US:
            problem = (
                "it sends no HIL_ACTUATOR_CONTROLS: does its firmware have pwm_out_sim, does the "
                "link allow more than 5000 bytes/s (MAV_0_RATE; USB always does)?"
            )
        if problem is not None and self.time_us == 0:
            raise interfaces.FirmwareMissingError(f"--serial {device}: the board: {problem}")
        if problem is not None:
            raise interfaces.FirmwareLostError(f"{device}: the board: {problem}")
        if self._stuck_us is not None and now_us - self._stuck_us > SILENCE_US:
            raise interfaces.FirmwareLostError(
                f"{device}: the line accepts no more data: the board hangs"
            )

    def _send(self, sample: interfaces.SensorSample, time_us: int, now_us: int) -> None:
        if self._link.send(hil.SENSOR, hil.sensor(sample, time_us)):
            self._stuck_us = None
        else:
            self._stuck_us = now_us if self._stuck_us is None else self._stuck_us
        if sample.gps is not None:
            self._link.send(hil.GPS, hil.gps(sample.gps, time_us))


def px4_hitl_parts(request: FirmwareRequest) -> tuple[Launcher, Endpoint]:
    """Bind the clients' ports. Return the launcher for the board, and the observer's endpoint."""
    options = request.aircraft.real
    airframe = parameters.px4_airframe(request.vehicle, parameters.HITL_OUTPUT)
    parameters.refuse_untold(request.vehicle, "px4-hitl")
    router = Router(request.bind_ends().by_name(), WallClock())
    try:
        link = BoardLink(router, options.serial or "", options.baud)
    except UsageError:
        router.close()
        raise
    return Launcher(airframe, partial(HitlBridge, link), options.firmware_timeout), router


PX4_HITL = FirmwareKind(
    airframe=partial(parameters.px4_airframe, output=parameters.HITL_OUTPUT),
    parameter_file=parameters.qgroundcontrol_file,
    parts=f"{__name__}:px4_hitl_parts",
)
