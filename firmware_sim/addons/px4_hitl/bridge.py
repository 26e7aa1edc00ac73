"""Hardware in the loop: a PX4 board that flies on simulated sensors over a serial or USB line.

There is no lockstep: the board runs on its own clock. Every tick sends sensors to the board and
applies its newest motor commands, delayed by a transfer and a cycle of the board.

Source: PX4, src/modules/mavlink: mavlink_receiver.cpp (HIL_SENSOR, HIL_GPS),
streams/HIL_ACTUATOR_CONTROLS.hpp; Commander.cpp (reboot).
"""

from __future__ import annotations

import select
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import TICK_HZ, US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from firmware_sim import interfaces
from firmware_sim.addons.px4_hitl.line import (
    BITS_PER_BYTE,
    Router,
    SerialPort,
    carries_bytes_s,
    check_baud,
)
from firmware_sim.external import flight_stack, launcher, observer, parameters, programs
from firmware_sim.external import hil_messages as hil
from firmware_sim.mavlink.codec import Encoder, Values, WireLayout, WireMessage, dialect

HIL_SETUP = "set SYS_HITL = 1 with the airframe HIL Quadcopter X (SYS_AUTOSTART 1001) and reboot it"

JUMP_US = US_PER_S
"""Backward jump of the board's clock that indicates a restart [µs]."""

SURE_BEATS = 3
"""Number of heartbeats after which a missing HIL flag is not due to start-up."""

_ALL_MOTORS = (1 << hil.MOTORS) - 1


class Board:
    """State received from a board since its line was opened. No message raises."""

    def __init__(self, clock: Clock) -> None:
        """Create the state without messages; `clock` is the wall clock."""
        self._clock = clock
        self.system: int | None = None
        """MAVLink system id; None before the first heartbeat."""
        self.autopilot = 0
        """MAV_AUTOPILOT of the heartbeats."""
        self.beats = 0
        self.hil = False
        """True if the newest heartbeat has the HIL flag."""
        self.armed = False
        """True if the newest heartbeat reports armed."""
        self.controls: WireMessage | None = None
        """Newest HIL_ACTUATOR_CONTROLS."""
        self.controls_us = 0
        """Time when the newest HIL_ACTUATOR_CONTROLS was received [wall µs]."""
        self.restarted = False
        """True if the board's clock went back."""
        self.reboot_answer: int | None = None
        """MAV_RESULT of the reply to a reboot command of any sender."""
        self._boot_us = 0

    @property
    def ready(self) -> bool:
        """True if the board is a PX4 in HIL mode, which waits for sensors."""
        return self.hil and self.autopilot == dialect.MAV_AUTOPILOT_PX4

    @property
    def rebooting(self) -> bool:
        """True if the board has accepted a reboot command."""
        return bool(self.reboot_answer == dialect.MAV_RESULT_ACCEPTED)

    def take(self, message: WireMessage) -> None:
        """Handle a message received from the line."""
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return  # another component's message, forwarded by the board
        name = message.get_type()
        if name == "HEARTBEAT" and self.system in (None, message.get_srcSystem()):
            self.system = message.get_srcSystem()
            self.beats += 1
            self.autopilot = int(message.autopilot)
            self.hil = bool(message.base_mode & dialect.MAV_MODE_FLAG_HIL_ENABLED)
            self.armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        if message.get_srcSystem() != self.system:
            return
        if name == "HIL_ACTUATOR_CONTROLS":
            self.controls, self.controls_us = message, self._clock.time_us()
            self._age(int(message.time_usec))
        elif name == "COMMAND_ACK":
            if message.command == dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
                self.reboot_answer = int(message.result)
        elif name == "SYSTEM_TIME":
            self._age(int(message.time_boot_ms) * US_PER_MS)

    def _age(self, boot_us: int) -> None:
        if boot_us < self._boot_us - JUMP_US:
            self.restarted = True
        self._boot_us = max(self._boot_us, boot_us)

    def setup_problem(self) -> str | None:
        """Return the problem of the board's configuration; None = no known problem."""
        if self.beats and self.autopilot != dialect.MAV_AUTOPILOT_PX4:
            return f"it is not a PX4 (HEARTBEAT.autopilot {self.autopilot}, PX4's is 12)"
        if self.beats >= SURE_BEATS and not self.hil:
            return f"it is not in HIL mode (HEARTBEAT.base_mode without bit 32): {HIL_SETUP}"
        if self.controls is None:
            return None
        # Boards with PX4 1.16 send 0, later versions a bit for each motor output; a lockstep build,
        # for SITL only, sends 1.
        flags = int(self.controls.flags)
        if flags == dialect.HIL_ACTUATOR_CONTROLS_FLAGS_LOCKSTEP:
            return (
                "its HIL_ACTUATOR_CONTROLS.flags is 1: either a lockstep build, which is for "
                "--firmware px4, or only HIL_ACT_FUNC1 is a motor: expected 101, 102, 103, 104 in "
                "HIL_ACT_FUNC1 to 4"
            )
        if flags and flags & _ALL_MOTORS != _ALL_MOTORS:
            return (
                f"its HIL_ACTUATOR_CONTROLS.flags is {flags:#x}, outputs 1 to 4 are not all "
                "motors: expected 101, 102, 103, 104 in HIL_ACT_FUNC1 to 4"
            )
        return None


def silence(board: Board, line: Router) -> str:
    """Return the reason for an incomplete connection, from the last stage reached."""
    if line.received_bytes == 0:
        return (
            "no byte was received: is it powered, is this its port, does it send MAVLink there "
            "(USB: SYS_USB_AUTO = 2; TELEM 1: MAV_0_CONFIG = 101)?"
        )
    if not line.speaks_mavlink:
        return (
            f"{line.received_bytes} bytes were received, no MAVLink among them: another baud rate "
            "than --baud (the board's: SER_TEL1_BAUD), or another device"
        )
    if not board.beats:
        return (
            "MAVLink was received, but no heartbeat of an autopilot: a radio, or another component?"
        )
    return f"heartbeats were received without the HIL flag: {HIL_SETUP}"


REBOOT_S = 10.0
"""Timeout from a reboot command until the board goes down [wall s]."""

SILENCE_S = 1.5
"""Silence after which a board is down [wall s]; its heartbeat is due every second."""

SENSOR_BYTES, GPS_BYTES = 76, 51
"""Maximum frame lengths of HIL_SENSOR and HIL_GPS [bytes]."""

GPS_HZ = 10

HIL_BYTES_S = TICK_HZ * SENSOR_BYTES + GPS_HZ * GPS_BYTES
"""Data rate of the simulator [bytes/s]."""

HIL_SHARE = 2 / 3
"""Maximum share of a line's capacity for the simulator; the clients use the rest."""

USB_CLIENTS_BYTES_S = 100_000
"""Maximum data rate of the clients over USB [bytes/s]: a tenth of USB's full-speed capacity."""

_POLL_S = 0.02
_AGAIN_S = 0.2
_BEAT_US = US_PER_S
_MAVLINK_VERSION = 3


class BoardLink:
    """Link to a board that may vanish during a reboot. Sends only after data were received."""

    def __init__(self, router: Router, device: str, baud: int) -> None:
        """Configure a serial line for a router with lasting clients; UsageError if too slow."""
        self.known = False
        """True after the first search for the board; the device may then be absent for a while."""
        self.went_down = False
        """True if another client rebooted the board and it was down when released."""
        self.device = device
        self.clock = WallClock()
        self.board = Board(self.clock)
        """State received from the board; a new object each time the device is opened."""
        self._router = router
        self._baud = baud
        self._budget_bytes_s = check_line(device, baud)
        self._encoder = Encoder(observer.SYSTEM_ID, dialect.MAV_COMP_ID_USER1)
        self._line: SerialPort | None = None
        self._beat_due_us = 0

    @property
    def lost(self) -> str | None:
        """Reason for a missing connection; None while connected."""
        return self._router.lost or (None if self._line else f"{self.device}: not connected")

    # --- connecting

    def connect(self, timeout_s: float, alive: Callable[[], None], *, returning: bool) -> None:
        """Wait for a heartbeat of a board in HIL mode, at most `timeout_s` [wall s].

        `alive` is called at intervals and raises to abort. If `returning`, the device was present
        before and may be absent at first.

        Raises:
            UsageError: The device cannot be opened.
            FirmwareMissingError: No board in HIL mode was found.
            FirmwareLostError: The device did not come back.
        """
        self.close()
        deadline_us = self.clock.time_us() + int(timeout_s * US_PER_S)
        while not self.board.ready:
            alive()
            if self._line is None:
                self._open(deadline_us if returning else 0)
                continue
            self._listen()
            problem = self.board.setup_problem()
            if problem is not None:
                raise interfaces.FirmwareMissingError(
                    f"--serial {self.device}: the board: {problem}"
                )
            if self._router.lost is not None:
                # The boot loader is a separate USB device, which vanishes when the firmware starts.
                self.close()
                returning = True
            elif self.clock.time_us() > deadline_us and not self.board.ready:
                raise interfaces.FirmwareMissingError(
                    f"--serial {self.device}: no board in HIL mode within {timeout_s:g} s: "
                    + silence(self.board, self._router)
                )

    def _open(self, deadline_us: int) -> None:
        """Open the device, or wait briefly if it is absent before the deadline [wall µs]."""
        try:
            self._line = SerialPort(self.device, self._baud)
        except UsageError as error:
            if self.clock.time_us() < deadline_us:
                select.select([], [], [], _AGAIN_S)
                return
            if deadline_us:
                raise interfaces.FirmwareLostError(
                    f"the board did not come back: {error}"
                ) from error
            raise
        self.board = Board(self.clock)
        self._router.attach(self._line, self._budget_bytes_s)
        self._router.on_message = self.board.take

    def go_down(self, alive: Callable[[], None]) -> None:
        """Reboot a board in HIL mode and close the device; FirmwareLostError when it stays up."""
        board, clock = self.board, self.clock
        deadline_us = clock.time_us() + int(REBOOT_S * US_PER_S)
        due_us, heard_us, heard = 0, clock.time_us(), -1
        while self._router.lost is None and not board.restarted:
            alive()
            now_us = clock.time_us()
            if self._router.received_bytes != heard:
                heard, heard_us = self._router.received_bytes, now_us
            elif now_us - heard_us > SILENCE_S * US_PER_S:
                break
            if not board.rebooting and now_us >= due_us and now_us - heard_us < _AGAIN_S * US_PER_S:
                due_us = now_us + US_PER_S
                if board.armed:
                    self.disarm()  # an armed board rejects the reboot
                self._command(dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0)
            if now_us > deadline_us:
                raise interfaces.FirmwareLostError(
                    f"{self.device}: the board does not reboot (it answered "
                    f"{_result(board.reboot_answer)}): power-cycle it"
                )
            self._listen(beat=not board.rebooting)  # send nothing to a boot loader
        self.close()

    def _listen(self, *, beat: bool = True) -> None:
        self._router.pump(_POLL_S)
        if beat:
            self.beat()

    # --- sending

    def send(self, layout: WireLayout, values: Values) -> bool:
        """Send a simulator message; return False if the line did not accept it."""
        return self._router.send_ahead(self._encoder.frame(layout, layout.payload(values)))

    def pump(self) -> None:
        """Handle received messages, and forward the clients' messages."""
        self._router.pump()

    def beat(self) -> None:
        """Send a heartbeat when due, so that the board keeps using the line."""
        now_us = self.clock.time_us()
        if now_us >= self._beat_due_us and self.board.beats:
            self._beat_due_us = now_us + _BEAT_US
            self._tell(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_GENERIC,
                    dialect.MAV_AUTOPILOT_INVALID,
                    *(0, 0, dialect.MAV_STATE_ACTIVE, _MAVLINK_VERSION),
                )
            )

    def disarm(self) -> None:
        """Disarm a board in HIL mode, in any state."""
        if self.board.ready:
            self._command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, observer.FORCE)

    def _command(self, number: int, first: float, second: float = 0.0) -> None:
        target = self.board.system, dialect.MAV_COMP_ID_AUTOPILOT1
        self._tell(
            dialect.MAVLink_command_long_message(*target, number, 0, first, second, 0, 0, 0, 0, 0)
        )

    def _tell(self, message: WireMessage) -> None:
        self._router.send_ahead(self._encoder.pack(message))

    def close(self) -> None:
        """Close the device. Idempotent."""
        self._router.on_message = None
        self._router.detach()
        line, self._line = self._line, None
        if line is not None:
            line.close()
        self.board = Board(self.clock)


def _result(answer: int | None) -> str:
    if answer is None:
        return "nothing"
    known = dialect.enums["MAV_RESULT"].get(answer)
    return f"MAV_RESULT {answer}" if known is None else str(known.name)


def check_line(device: str, baud: int) -> int:
    """Return the clients' share of a line [bytes/s]; UsageError if too slow for the sensors."""
    check_baud(baud)
    carries = carries_bytes_s(device, baud)
    if carries is None:
        return USB_CLIENTS_BYTES_S
    if carries * HIL_SHARE < HIL_BYTES_S:
        raise UsageError(
            f"--baud {baud}: {TICK_HZ} HIL_SENSOR a second are {HIL_BYTES_S * BITS_PER_BYTE} bit/s,"
            f" {device} would carry {baud} for everything: accepted: at least "
            f"{int(HIL_BYTES_S * BITS_PER_BYTE / HIL_SHARE)} (usual: 460800, 921600), or USB"
        )
    return carries - HIL_BYTES_S


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
                link.go_down(launcher.no_process)
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


def px4_hitl_parts(
    request: flight_stack.FirmwareRequest,
) -> tuple[launcher.Launcher, observer.FirmwareObserver]:
    """Bind the clients' ports. Return the launcher for the board, and its observer."""
    options = request.aircraft.real
    airframe = parameters.px4_airframe(request.vehicle, parameters.HITL_OUTPUT)
    parameters.refuse_untold(request.vehicle, "px4-hitl")
    router = Router(request.bind_ends().by_name(), WallClock())
    try:
        link = BoardLink(router, options.serial or "", options.baud)
    except UsageError:
        router.close()
        raise
    bridge = partial(HitlBridge, link)
    return (
        launcher.Launcher(airframe, bridge, options.firmware_timeout),
        flight_stack.observed(request, router),
    )


PX4_HITL = programs.FirmwareKind(
    airframe=partial(parameters.px4_airframe, output=parameters.HITL_OUTPUT),
    parameter_file=parameters.qgroundcontrol_file,
    parts=f"{__name__}:px4_hitl_parts",
)
