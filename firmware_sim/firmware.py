"""Firmware: runs simulation, MAVLink and camera tick by tick; flies alone with `fly`."""

from __future__ import annotations

import gc
import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from airl_mav.camera.frame import Frame
from airl_mav.core import clock, constants, files
from airl_mav.core.addons import entries, load
from airl_mav.core.frames import Goal
from airl_mav.flight.judge import Effect
from firmware_sim import fault_timeline, interfaces
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.parameter_store import Keeper
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.record import Record
from firmware_sim.mavlink.link import LinkCounters
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.traffic import TlogWriter
from firmware_sim.pacing import Pacing
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

AUTOSAVE_US = 300_000
"""Delay from the first parameter change to the save [µs]; PX4's value."""

IDLE_S = 0.02
"""Interval of checks for requests while no episode is loaded [s]."""


class FrameServer(Protocol):
    """Receiver of the camera's frames, such as `plant.camera.CameraServer`."""

    endpoint: str
    """Address for subscribers."""

    @property
    def awaited(self) -> bool:
        """True if a client waits for the next frame, which must then be on time."""

    @property
    def transport_us(self) -> int | None:
        """Time from exposure to a client that reads between ticks [µs]; None = read at any time."""

    def publish(self, frame: Frame) -> None:
        """Offer a frame without blocking."""

    def close(self) -> None:
        """Release the resources."""


class FlightLog(Protocol):
    """Flight log of the vehicle, by an add-on (table FLIGHT_LOGS)."""

    def after_ticks(self, flown: Record, truths: Record, state: AutopilotState) -> None:
        """Log n ticks, from their logs and the final state of the autopilot."""

    def text(self, message: OperatorText, time_us: int) -> None:
        """Log an operator text."""

    def close(self) -> None:
        """Complete the log. Idempotent; further ticks and texts are ignored."""

    def discard(self) -> None:
        """Complete the log, and release all files."""


class FlightStack(Protocol):
    """Flight controller and its MAVLink links, without sensors and motors.

    The links stay open; the flight controller reboots for each episode. Only `boot` and `connect`
    raise.
    """

    version: str
    """Name and version of real firmware; empty for the built-in autopilot."""

    def boot(self, setup: EpisodeSetup) -> interfaces.FlightController:
        """Boot the flight controller of an episode and wait until it accepts steps.

        Raises:
            UsageError: The vehicle's parameters are invalid, or the firmware does not exist.
            FirmwareLostError: External firmware died while it booted.
        """

    def connect(self, tick: Callable[[], int], truth: Callable[[], interfaces.TrueState]) -> None:
        """Open MAVLink after the flight controller's first tick.

        Args:
            tick: Flies one tick and returns its simulated time [µs], for firmware that needs
                simulated time to get ready.
            truth: Returns the true state, for clients that request it (HIL_STATE_QUATERNION).

        Raises:
            UsageError: External firmware is silent, or configured for another vehicle.
            FirmwareLostError: External firmware died.
        """

    def filenos(self) -> Sequence[int]:
        """Return the descriptors that become readable when MAVLink arrives."""

    def receive(self, now_us: int) -> int:
        """Handle messages received by simulated `now_us` [µs]; return how many took effect."""

    def next_send_us(self) -> float:
        """Return the latest simulated time for the next call of `send` [µs]."""

    def send(self, now_us: int, flown: Record) -> None:
        """Send the messages due at simulated `now_us` [µs], after the newest tick.

        `flown` is (n,) logs of the ticks since the last call; empty for external firmware.
        """

    def log_to(self, tlog: TlogWriter | None) -> None:
        """Start to log the onboard link to a tlog; None stops logging."""

    def counters(self) -> dict[str, LinkCounters]:
        """Return traffic counters by link name."""

    def local(self, goal: Goal) -> Goal:
        """Return a goal of the arena in the flight controller's local frame."""

    def title(self) -> str:
        """Return the source of the poses of a vehicle elsewhere; "" = it is simulated here."""

    def effects(self) -> Sequence[Effect]:
        """Return the messages that took effect on the vehicle in this episode, by sender.

        Empty for external firmware, whose MAVLink is not inspected here.
        """

    def close(self) -> None:
        """Release everything."""


class BuiltinFlightStack:
    """Built-in autopilot with the built-in MAVLink server. Implements `FlightStack`."""

    version = ""

    def __init__(self, server: MavlinkServer, keeper: Keeper | None = None) -> None:
        """Use the server's links; `keeper` stores parameters set by users, None = not stored."""
        self._server = server
        self._keeper = keeper
        self._autopilot: BuiltinAutopilot | None = None
        self._now_us = 0
        self._save_us: int | None = None
        """Simulated time of the next parameter save [µs]; None = nothing to save."""
        self.filenos = server.filenos
        self.receive, self.next_send_us = server.receive, server.next_send_us
        self.send = server.send if keeper is None else self._send_and_save
        self.log_to = server.log_to
        self.counters = server.counters
        self.effects = server.effects

    def boot(self, setup: EpisodeSetup) -> BuiltinAutopilot:
        """Boot the autopilot of an episode. Raises UsageError for an invalid parameter."""
        self._autopilot = autopilot = builtin_autopilot(setup, self._keeper)
        if self._keeper is not None:
            autopilot.parameters.on_change(self._changed)
        return autopilot

    def connect(self, tick: Callable[[], int], truth: Callable[[], interfaces.TrueState]) -> None:
        """Attach the autopilot to the MAVLink server."""
        del tick
        if self._autopilot is not None:
            self._server.attach(self._autopilot, truth)

    def local(self, goal: Goal) -> Goal:
        """Return the goal: the local frame is the arena's."""
        return goal

    def title(self) -> str:
        """Return "": the vehicle is simulated here."""
        return ""

    def close(self) -> None:
        """Save unsaved parameters and close the links."""
        self._save()
        self._server.close()

    def _send_and_save(self, now_us: int, flown: Record) -> None:
        self._server.send(now_us, flown)
        self._now_us = now_us
        if self._save_us is not None and now_us >= self._save_us:
            self._save()

    def _changed(self) -> None:
        if self._save_us is None:
            self._save_us = self._now_us + AUTOSAVE_US

    def _save(self) -> None:
        if self._save_us is None or self._autopilot is None:
            return
        self._save_us = None
        if not self._autopilot.parameters.save():
            self._autopilot.say(OperatorText(Severity.CRITICAL, "Parameters could not be saved"))


@dataclass(frozen=True)
class LoadedEpisode:
    """Start of a loaded episode."""

    time_us: int
    epoch_ns: int | None
    """Host monotonic time of simulated time 0 [ns]; None = simulated time is not paced."""


class Firmware:
    """Flight stack, camera and simulation. Links and camera stay open between episodes."""

    def __init__(
        self,
        flight_stack: FlightStack,
        camera: FrameServer | None,
        pacing: Pacing,
        *,
        recording: bool = True,
        failing: fault_timeline.FailingLink | None = None,
    ) -> None:
        """Create the firmware without an episode.

        `camera` receives the frames; None = no camera. Without `recording`, episodes cannot be
        saved and may last indefinitely. `failing` is the companion's link if it may fail.
        """
        self.flight_stack = flight_stack
        self.clock = pacing.clock
        self.simulation: Simulation | None = None
        self.on_tick: Callable[[Simulation], None] | None = None
        """Callback after every tick; if set, ticks are flown one at a time."""
        self.on_ticks: Callable[[Simulation], None] | None = None
        """Callback after the ticks of each `step` (see `Simulation.truths`)."""
        self.on_frame: Callable[[Frame], None] | None = None
        """Callback for every camera frame, called before the frame is published."""
        self.on_message: Callable[[OperatorText], None] | None = None
        """Callback for every operator text of the autopilot."""
        self.on_log_lost: Callable[[str], None] | None = None
        """Callback for a flight log that can no longer be written; receives log and reason."""
        self.logs_lost: list[str] = []
        """Messages of `on_log_lost` in the present episode."""
        self._camera = camera
        self._pacing = pacing
        self._recording = recording
        self._failing = failing
        self._sockets: Sequence[int] = ()
        self._tlog: TlogWriter | None = None
        self._flight_log: FlightLog | None = None
        """Flight log; None without the add-on `flight_log`."""

    @property
    def camera_endpoint(self) -> str:
        """Address where frames are published; "" without a camera."""
        return self._camera.endpoint if self._camera is not None else ""

    epoch_ns = property(lambda self: self._pacing.epoch_ns)
    """Host monotonic time of simulated time 0 [ns]; None = simulated time is not paced."""
    slipped_us = property(lambda self: self._pacing.slipped_us)
    """Simulated time skipped since the start because the host could not keep up [µs]."""

    def load(self, setup: EpisodeSetup, tlog: Path | None, start_unix_us: int) -> LoadedEpisode:
        """Replace the episode: a new arena, the vehicle at rest, the autopilot booting.

        Args:
            setup: The episode.
            tlog: Path of the MAVLink log; the vehicle's log (.ulg) is beside it. None = no logs.
            start_unix_us: Present calendar time [µs since 1970].

        Raises:
            UsageError: The episode cannot be flown, or the firmware does not exist.
            FirmwareLostError: External firmware died during boot.
        """
        self.discard()
        self.logs_lost.clear()
        autopilot = self.flight_stack.boot(setup)
        autopilot.on_message = self._hear
        start_us = (self.clock.time_us() // constants.TICK_US + 1) * constants.TICK_US
        try:
            simulation = Simulation(
                setup,
                start_us=start_us,
                clock=self.clock,
                autopilot=autopilot,
                recording=self._recording,
                read_by=self._pacing.read_by,
            )
        except BaseException:
            autopilot.close()
            raise
        self.simulation = simulation
        if self._failing is not None:
            self._failing.begin(simulation.faults)
        simulation.tick()
        powered_us = simulation.time_us
        if setup.hover is not None:
            setup.hover.fly(simulation)
        self.flight_stack.connect(self._tick_on_the_ground, simulation.plant.truth)
        if simulation.time_us > powered_us:
            # The boot of external firmware and the climb of a hover start precede the episode.
            simulation.begin()
            start_us = simulation.start_us
        self._sockets = self.flight_stack.filenos()
        if tlog is not None:
            self._tlog = TlogWriter(tlog, start_unix_us - simulation.time_us, self._lose_log)
            self.flight_stack.log_to(self._tlog)
            self._open_flight_log(tlog.with_suffix(interfaces.ULOG_SUFFIX), start_unix_us)
        if self.epoch_ns is not None:
            # Objects that live for the whole episode are exempt from garbage collection: a full
            # collection would stall the 250 Hz loop for tens of milliseconds.
            gc.collect()
            gc.freeze()
        # Loading took wall time that is not part of the episode.
        self._pacing.restart(simulation.time_us)
        return LoadedEpisode(start_us, self.epoch_ns)

    def _open_flight_log(self, path: Path, start_unix_us: int) -> None:
        """Open the vehicle's log. Real firmware hides its state and writes its own log."""
        simulation = self.simulation
        internals = None if simulation is None else simulation.autopilot.internals
        if simulation is not None and internals is not None:
            now_us = simulation.time_us
            for place in entries("firmware_sim", "FLIGHT_LOGS").values():
                self._flight_log = load(place)(
                    path, internals, now_us, start_unix_us - now_us, self._lose_log
                )

    def _lose_log(self, what: str) -> None:
        """Report a log that can no longer be written; the flight continues without it."""
        self.logs_lost.append(what)
        if self.on_log_lost is not None:
            self.on_log_lost(what)

    def _hear(self, message: OperatorText) -> None:
        if self.simulation is not None:
            now_us = self.simulation.time_us
            if self.epoch_ns is None and self.simulation.is_flying:
                self.clock.sleep_until(now_us)  # the clock is not advanced during `advance`
            if self._flight_log is not None:
                self._flight_log.text(message, now_us)
        if self.on_message is not None:
            self.on_message(message)

    def _tick_on_the_ground(self) -> int:
        simulation = self.simulation
        if simulation is None:
            return 0
        simulation.tick()
        return simulation.time_us

    def step(self) -> None:
        """Wait until the next tick is due, then run it.

        Raises FirmwareLostError when external firmware does not respond, or the image process has
        ended.
        """
        simulation, flight_stack = self.simulation, self.flight_stack
        if simulation is None:
            self.clock.sleep_until(self.clock.time_us() + int(IDLE_S * constants.US_PER_S))
            return
        receive, due_us, slipped_us = flight_stack.receive, simulation.time_us, self.slipped_us
        began_us = self._pacing.wait(due_us, self._sockets, receive)
        if simulation.recorder is not None and self.epoch_ns is not None:
            simulation.recorder.began_tick(due_us, began_us, self.slipped_us - slipped_us)
        receive(began_us)
        camera = self._camera
        if camera is not None:
            # Before the tick: after it, the state is one tick ahead of the capture time.
            publish = camera.publish if self.on_frame is None else self._show_and_publish
            simulation.capture_due(simulation.time_us, publish)
        until_us = 0.0 if self.on_tick is not None else self._pacing.quiet_until_us
        if camera is not None and camera.awaited:
            until_us = min(until_us, simulation.next_frame_us)
        log, internals = self._flight_log, simulation.autopilot.internals
        if until_us > simulation.time_us:
            until_us = min(until_us, flight_stack.next_send_us())
        simulation.advance(until_us, self._pacing.arrivals)
        if camera is not None and len(simulation.truths) > 1:
            now_us, transport_us = simulation.time_us, camera.transport_us
            if transport_us is None or self.on_frame is not None:
                transport_us = now_us  # every frame is read
            simulation.capture_due(now_us - constants.TICK_US, publish, now_us - transport_us)
        if log is not None and internals is not None:
            log.after_ticks(simulation.flown, simulation.truths, internals.state())
        flight_stack.send(simulation.time_us, simulation.flown)
        for listen in (self.on_tick, self.on_ticks):
            if listen is not None:
                listen(simulation)

    def _show_and_publish(self, frame: Frame) -> None:
        if self.on_frame is not None:
            self.on_frame(frame)
        if self._camera is not None:
            self._camera.publish(frame)

    def save(self, path: Path) -> None:
        """Write the episode's arrays and close its logs. The flight continues without logs."""
        if self.simulation is not None:
            lines = [json.dumps(asdict(effect)) for effect in self.flight_stack.effects()]
            effects = np.array(lines, np.str_)
            files.save_arrays(path, {**self.simulation.arrays(), "commands/effects": effects})
            self.close_logs()

    def close_logs(self) -> None:
        """Complete the logs of the episode. Idempotent."""
        if self._flight_log is not None:
            self._flight_log.close()
        if self._tlog is not None:
            self.flight_stack.log_to(None)
            self._tlog.close()
            self._tlog = None

    def discard(self) -> None:
        """Close the episode without saving it."""
        self.close_logs()
        if self._flight_log is not None:
            self._flight_log.discard()
            self._flight_log = None
        if self.simulation is not None:
            if self.epoch_ns is not None:
                gc.unfreeze()
            self.simulation.close()
            self.simulation = None

    def close(self) -> None:
        """Release everything."""
        self.discard()
        self.flight_stack.close()
        if self._camera is not None:
            self._camera.close()


def fly(
    firmware: Firmware,
    stop: threading.Event,
    duration_s: float | None,
    say: Callable[[str], None],
) -> None:
    """Fly until `stop` is set, or for a duration of simulated time [s]; report a summary.

    Without a duration, only `stop` ends the flight. `say` receives one line at a time. Raises
    FirmwareLostError when real firmware is lost.
    """
    start_us, stopwatch = firmware.clock.time_us(), clock.WallClock()
    end_us = None if duration_s is None else start_us + int(duration_s * constants.US_PER_S)
    while not stop.is_set() and (end_us is None or firmware.clock.time_us() < end_us):
        firmware.step()
    flown_s = (firmware.clock.time_us() - start_us) / constants.US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / constants.US_PER_S
    say(f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time")
    if firmware.slipped_us:
        given_up_s = firmware.slipped_us / constants.US_PER_S
        say(f"{given_up_s:.2f} s given up: this host could not keep up")
    for name, link in firmware.flight_stack.counters().items():
        say(
            f"{name:<8} received {link.rx}, malformed {link.malformed}, ignored {link.ignored}, "
            f"dropped {link.dropped}, "
            f"refused {link.refused}, sent {link.tx}, not sent {link.send_errors}"
        )
