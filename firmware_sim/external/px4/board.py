"""The state of a PX4 board by its messages, and what is wrong with its configuration."""

from __future__ import annotations

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from firmware_sim.external.px4 import hil_messages as hil
from firmware_sim.external.transport.router import Router
from firmware_sim.mavlink.codec import WireMessage, dialect

HIL_SETUP = "set SYS_HITL = 1 with the airframe HIL Quadcopter X (SYS_AUTOSTART 1001) and reboot it"

JUMP_US = US_PER_S
"""Its clock going back by this is a restart [µs]."""

SURE_BEATS = 3
"""After so many heartbeats without the HIL flag, the board is not just starting up."""

_ALL_MOTORS = (1 << hil.MOTORS) - 1


class Board:
    """What was received from a board since its line was opened. No message raises."""

    def __init__(self, clock: Clock) -> None:
        """Start without any message; `clock` is the wall clock."""
        self._clock = clock
        self.system: int | None = None
        """MAVLink system id; None before its first heartbeat."""
        self.autopilot = 0
        """MAV_AUTOPILOT of its heartbeats."""
        self.beats = 0
        """Heartbeats received."""
        self.hil = False
        """Whether its newest heartbeat has the HIL flag."""
        self.armed = False
        """Whether its newest heartbeat says that it is armed."""
        self.controls: WireMessage | None = None
        """The newest HIL_ACTUATOR_CONTROLS."""
        self.controls_us = 0
        """When that was received [wall µs]."""
        self.restarted = False
        """Whether its clock went back."""
        self.reboot_answer: int | None = None
        """MAV_RESULT of its answer to a reboot command, whoever sent it."""
        self._boot_us = 0

    @property
    def ready(self) -> bool:
        """Whether it is a PX4 in HIL mode, which waits for sensors."""
        return self.hil and self.autopilot == dialect.MAV_AUTOPILOT_PX4

    @property
    def rebooting(self) -> bool:
        """Whether it has accepted a reboot command."""
        return bool(self.reboot_answer == dialect.MAV_RESULT_ACCEPTED)

    def take(self, message: WireMessage) -> None:
        """Take a message received from the line."""
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return  # of another component, forwarded by the board
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
        """Return what is wrong with its configuration, None while nothing is known to be."""
        if self.beats and self.autopilot != dialect.MAV_AUTOPILOT_PX4:
            return f"it is not a PX4 (HEARTBEAT.autopilot {self.autopilot}, PX4's is 12)"
        if self.beats >= SURE_BEATS and not self.hil:
            return f"it is not in HIL mode (HEARTBEAT.base_mode without bit 32): {HIL_SETUP}"
        if self.controls is None:
            return None
        # PX4 1.16's boards send 0, later ones a bit for each output that is a motor; a lockstep
        # build, which is for SITL only, sends 1.
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
    """Return why a connection was not completed: how far it got."""
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
