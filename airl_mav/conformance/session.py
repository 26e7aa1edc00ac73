"""The link to the flight controller under examination: MAVSDK, and raw messages through MAVSDK.

Waits follow the vehicle's own clock, so that they mean the same at any speed of a simulation; that
it has gone silent is told by the wall clock.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mavsdk import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.offboard import Offboard, VelocityBodyYawspeed, VelocityNedYaw

from airl_mav.conformance.family import FAMILIES, PX4, Family
from airl_mav.conformance.inbox import NAMES, Inbox
from airl_mav.conformance.steps import Ned, Setpoint
from airl_mav.conformance.transcript import Transcript
from airl_mav.conformance.vehicle_clock import VehicleClock
from airl_mav.conformance.words import (
    ARMED_FLAG,
    CUSTOM_MODE_FLAG,
    DO_SET_MODE,
    command_name,
)
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from companion.interfaces import LinkError
from companion.mavsdk_connection import first_autopilot, open_connection

POLL_S = 0.02
"""How often a condition is looked at [wall s]."""

SILENT_S = 5.0
"""After so long without a word the vehicle counts as lost [wall s]; a heartbeat comes each second.
"""

SLOWEST = 20.0
"""A wait is given up when it takes so many times as long as it should by the wall clock..."""

SLACK_S = 10.0
"""...and so much longer still [wall s]."""

COMMAND_TRIES = 5
"""MAVSDK repeats a command within 2 s of wall time; simulators have been seen to stall longer."""


class Session:
    """One vehicle, heard and commanded."""

    def __init__(self, url: str, speed: float, transcript: Transcript) -> None:
        """Open a connection; `connect` waits for the vehicle.

        Args:
            url: MAVSDK connection.
            speed: Simulated seconds per wall second of the vehicle.
            transcript: Where everything is noted.

        Raises:
            UsageError: The URL is invalid or its port is taken.
        """
        self.url, self.speed = url, speed
        self.clock = WallClock(speed)
        self.transcript = transcript
        self.inbox = Inbox(transcript)
        self.family: Family = PX4
        self.vehicle_clock = VehicleClock(self.inbox, self.send)
        # PX4 sends STATUSTEXT only where it hears a ground station.
        self._mavsdk = open_connection(url, ComponentType.GROUND_STATION)
        self._system: Any = None
        self._direct: Any = None
        self.action: Any = None
        self.offboard: Any = None
        self._target = 0
        self.arming = False
        """Whether it was asked to arm, and not yet seen to be disarmed after it."""

    def connect(self, timeout_s: float) -> None:
        """Wait for a flight controller and listen to it.

        Raises:
            UsageError: None is heard in time [wall s].
        """
        system = first_autopilot(self._mavsdk, timeout_s)
        if system is None:
            raise UsageError(
                f"--connect {self.url}: no flight controller heard in {timeout_s:g} s "
                "(--connect-timeout)"
            )
        self._system, self._target = system, system.get_system_id()
        self._direct = MavlinkDirect(system)
        for name in NAMES:
            self._direct.subscribe_message(name, self.inbox.hear)
        self.action, self.offboard = Action(system), Offboard(system)

    def choose_family(self, autopilot: int) -> None:
        """Expect the ways of an autopilot. Raises UsageError for one that is not known."""
        try:
            self.family = family = FAMILIES[autopilot]
        except KeyError:
            known = ", ".join(f"{key} {each.title}" for key, each in FAMILIES.items())
            raise UsageError(
                f"--connect {self.url}: HEARTBEAT.autopilot = {autopilot}; accepted: {known}"
            ) from None
        self.inbox.mode_name = lambda mode: family.modes.get(mode, f"mode {mode}")

    def close(self) -> None:
        """Release MAVSDK."""
        for plugin in (self.offboard, self.action, self._direct):
            if plugin is not None:
                plugin.destroy()
        self._mavsdk.destroy()

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Let the inbox count every message while the context lasts: costly, so not always."""
        every = self._direct.subscribe_message("", self.inbox.count)
        try:
            yield
        finally:
            self._direct.unsubscribe_message(every)

    # --- asking

    def call(self, what: str, call: Callable[[], Any]) -> str:
        """Make a call into MAVSDK; return "" when it succeeded, else the result's name."""
        self.transcript.say("sent", what)
        try:
            call()
        except MavsdkError as error:
            result = getattr(error, "result", None) or error.args[0]
            name = str(getattr(result, "name", result))
            self.transcript.say("heard", f"{what}: {name}")
            return name
        return ""

    def must(self, what: str, call: Callable[[], Any]) -> None:
        """Make a call into MAVSDK. Raises LinkError when it is refused."""
        if reason := self.call(what, call):
            raise LinkError(f"{what}: {reason}")

    def command(self, number: int, *params: float, note: str = "") -> int:
        """Send a COMMAND_LONG, and again when it is not answered, and return its MAV_RESULT.

        Args:
            number: MAV_CMD.
            params: Its parameters; those left out are 0, which means the same to all.
            note: What it is for.

        Raises:
            LinkError: There is no answer.
        """
        what = f"{command_name(number)} {' '.join(f'{value:g}' for value in params)}".strip()
        self.transcript.say("sent", f"COMMAND_LONG {what}{note and f': {note}'}")
        padded = (*params, *[0.0] * 7)[:7]
        fields = {
            "target_system": self._target,
            "target_component": 1,
            "command": number,
            "confirmation": 0,
            **{f"param{index}": value for index, value in enumerate(padded, 1)},
        }
        message = MavlinkMessage("COMMAND_LONG", fields_json=json.dumps(fields))
        for left in reversed(range(COMMAND_TRIES)):
            try:
                answer = self._direct.send_command(message)
                return int(json.loads(answer.fields_json)["result"])
            except MavlinkDirectError as error:
                problem = f"{what}: {error.result.name.lower()}"
                self.transcript.say("note", f"{problem}, {left} more attempts")
        raise LinkError(problem)

    def set_mode(self, mode: tuple[int, int], note: str) -> int:
        """Ask for a mode, by DO_SET_MODE's parameters 2 and 3, and return the MAV_RESULT."""
        flags = CUSTOM_MODE_FLAG | (ARMED_FLAG if self.armed else 0)
        return self.command(DO_SET_MODE, flags, *mode, note=note)

    def fly(self, setpoint: Setpoint) -> tuple[float, bool]:
        """Hand MAVSDK a setpoint, which it sends at once and then repeats at 20 Hz.

        Returns:
            When it came to the vehicle, by its clock [s], and whether it was asked for it.
        """
        came: list[tuple[float, bool]] = []
        clock = self.vehicle_clock

        def send() -> None:
            came.append(clock.sending(clock.fix(), self.inbox.boot_s, self.speed))
            if isinstance(setpoint, Ned):
                self.offboard.set_velocity_ned(VelocityNedYaw(*setpoint))
            else:
                self.offboard.set_velocity_body(VelocityBodyYawspeed(*setpoint))

        name = "set_velocity_ned" if isinstance(setpoint, Ned) else "set_velocity_body"
        self.must(f"{name}({', '.join(f'{value:g}' for value in setpoint)})", send)
        (came_s, exact), latest = came[0], clock.fix()
        # A simulation that was held up in between: it cannot have come later than asked again.
        return (came_s if latest is None else min(came_s, latest.boot_s)), exact

    def send(self, name: str, fields: dict[str, Any]) -> None:
        """Send a raw message; None in a field is NaN. Raises LinkError."""
        target = {"target_system": self._target, "target_component": 1}
        text = json.dumps({**target, **fields})
        try:
            self._direct.send_message(MavlinkMessage(name, fields_json=text))
        except MavlinkDirectError as error:
            raise LinkError(f"{name}: {error.result.name.lower()}") from None

    # --- time

    def pause(self) -> None:
        """Wait a moment. Raises LinkError when the vehicle has gone silent."""
        threading.Event().wait(POLL_S)
        if self.inbox.silence_s > SILENT_S:
            raise LinkError(f"nothing heard for {SILENT_S:g} s")

    def wait(self, condition: Callable[[], Any], seconds: float) -> Any:
        """Wait for a condition, so long by the vehicle's clock.

        Returns:
            The condition's last value: false when the time was over.

        Raises:
            LinkError: The vehicle has gone silent, or its clock stands still.
        """
        start_s, stopwatch = self.inbox.boot_s, WallClock()
        while not (value := condition()):
            if self.inbox.boot_s - start_s >= seconds:
                return value
            if stopwatch.time_us() / US_PER_S > SLOWEST * seconds / self.speed + SLACK_S:
                raise LinkError(f"its clock went on by {self.inbox.boot_s - start_s:.1f} s only")
            self.pause()
        return value

    def let(self, seconds: float) -> None:
        """Let so much time pass, by the vehicle's clock [s]. Raises as `wait`."""
        self.wait(lambda: False, seconds)

    # --- its state

    @property
    def armed(self) -> bool:
        """Whether the newest heartbeat says armed."""
        beat = self.inbox.latest("HEARTBEAT")
        return beat is not None and bool(beat["base_mode"] & ARMED_FLAG)

    @property
    def mode(self) -> int:
        """custom_mode of the newest heartbeat, -1 before the first."""
        beat = self.inbox.latest("HEARTBEAT")
        return -1 if beat is None else int(beat["custom_mode"])

    @property
    def landed(self) -> int:
        """Newest landed_state, 0 when it is not known."""
        state = self.inbox.latest("EXTENDED_SYS_STATE")
        return 0 if state is None else int(state["landed_state"])
