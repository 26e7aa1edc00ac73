"""Lockstep episodes: each episode creates, flies and discards its own vehicle and companion."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.core.compiling import COMPILING, heard_compiling
from airl_mav.core.constants import MAX_ATTEMPTS, US_PER_S
from airl_mav.flight.judge import BY_HAND, Outcome, Referee, TruthSample, Verdict
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import DecisionLog
from airl_mav.lockstep.stage import PATIENCE_S, LockstepStage
from airl_mav.lockstep.turns import FlightDigest, LockstepError, Unwitnessed, WitnessedPolicy
from airl_mav.lockstep.vehicle import real_vehicle
from airl_mav.policy.actions import Policy
from airl_mav.rehearsal import episode
from airl_mav.rehearsal.channel import Text
from airl_mav.rehearsal.firmware_process import episode_setup, state_of
from airl_mav.rehearsal.live_view import ViewAddresses, view_part
from airl_mav.rehearsal.observer import Observer
from airl_mav.rehearsal.run_folder import FIRMWARE_PRINTS, FlownEpisode, RunFolder
from airl_mav.scenario import checks, resolve
from companion.pilot import Mission, MissionResult, Start, check_camera, fly_mission
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.engine.record import Record
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.simulation import CrashDetector, Simulation
from firmware_sim.warm_up import warm_up

LOADING = "loading"
"""Status text before the first flight."""

SHOW_EVERY = 125
"""Ticks between two true states sent to the observer: twice per simulated second."""


def rehearse(
    scenario: resolve.ResolvedScenario,
    folder: RunFolder,
    observer: Observer,
    done: Collection[int] = (),
    view: ViewAddresses | None = None,
) -> None:
    """Fly episodes one after the other and save each one when it ends.

    Args:
        scenario: Scenario to fly.
        folder: Run folder for all results.
        observer: Receiver of progress reports.
        done: Indices of finished episodes to skip.
        view: Connection to the viewer; None = no viewer.

    Raises:
        UsageError: The policy cannot use the camera, or a seed gives no valid arena.
        LockstepError: The companion hangs or raised an error.
    """
    observer.waiting(LOADING)
    with heard_compiling(lambda begins: observer.waiting(COMPILING if begins else LOADING)):
        warm_up(scenario.vehicle, scenario.scenario.plant)
    for index, seed in enumerate(scenario.seeds):
        # Completed episodes of an earlier run are skipped.
        if index in done:
            continue
        # A fresh policy per seed: its memory must not carry over.
        policy, tlog = scenario.fresh_policy(seed), folder.tlog_path(index)
        log = folder.path / FIRMWARE_PRINTS
        flown = fly(scenario, policy, index, seed, tlog=tlog, log=log, observer=observer, view=view)
        # Saved before it is reported, so that a reported flight is never lost.
        folder.save_episodes([flown])
        observer.finished(flown.record)


def fly(
    resolved: resolve.ResolvedScenario,
    policy: Policy,
    index: int,
    seed: int,
    *,
    tlog: Path | None = None,
    log: Path | None = None,
    observer: Observer | None = None,
    view: ViewAddresses | None = None,
) -> FlownEpisode:
    """Fly one episode; equal scenario, policy and seed give a bit-identical flight.

    Flights of real firmware are only approximately equal. A flight that loses its firmware restarts
    from its seed, with a new policy of the same kind and new firmware.

    Args:
        resolved: Scenario to fly.
        policy: Policy, in its initial state.
        index: Index of the episode in its run.
        seed: Seed of arena, sensors, wind and latency.
        tlog: Path of the MAVLink log; None = no log.
        log: Path for the output of real firmware; None = a file in the firmware's folder.
        observer: Receiver of progress reports.
        view: Connection to the viewer, which can change the pace and, on record, the latency; None
            = no viewer.

    Raises:
        UsageError: The policy cannot use the camera, the seed gives no valid arena, or the firmware
            does not exist.
        LockstepError: The companion hangs or raised an error, or real firmware was lost too often.
    """
    observer = observer or Observer()
    notes: list[str] = []
    while True:
        flight = LockstepFlight(
            resolved, policy, index, seed, observer=observer, notes=notes, view=view
        )
        try:
            return flight.fly(tlog, log)
        except FirmwareLostError as error:
            # The first line of the error is the note; the rest is its output.
            what, *_ = str(error).splitlines()
            notes.append(f"flown again: {what}")
            title = f"flight {index:03d}, seed {seed}"
            # A flight that is lost repeatedly has a cause that a retry does not remove.
            if len(notes) == MAX_ATTEMPTS:
                raise LockstepError(
                    f"{title}: lost {MAX_ATTEMPTS} times; at last {error}"
                ) from None
            observer.lost(f"{title} begins again: {error}")
            policy = resolved.fresh_policy(seed)


class LockstepFlight:
    """One flight from take-off to landing; call `fly` once."""

    def __init__(
        self,
        resolved: resolve.ResolvedScenario,
        policy: Policy,
        index: int,
        seed: int,
        *,
        observer: Observer | None = None,
        notes: Sequence[str] = (),
        view: ViewAddresses | None = None,
        patience_s: float = PATIENCE_S,
        lands: bool = True,
        ticked: Callable[[Simulation, Referee, str | None], None] = lambda *_: None,
    ) -> None:
        """Set the parameters of the flight, see `fly`; nothing is started.

        `notes` are added to the episode's record. `patience_s` is the maximum duration of a
        decision [s of wall time]. Unless it `lands`, the companion continues after the time limit
        until the flight is aborted. `ticked` is called after every tick, with the first object that
        was hit.
        """
        self._view = view
        self._watched: Any = None
        """Live view's part `flight`; None without a viewer."""
        self._patience_s = patience_s
        self._lands = lands
        self._ticked = ticked
        self._abandon: threading.Event | None = None
        self._called_off = False
        self._notes = tuple(notes)
        self._resolved, self._policy, self._index, self._seed = resolved, policy, index, seed
        self._observer = observer or Observer()
        self._ticks = 0
        self.arena = resolved.arena_of(seed)
        """Arena of the flight."""
        self._goal = self.arena.goal_point
        self._start: Start = "hover" if resolved.scenario.start == "hover" else "arm"
        # Only the built-in firmware is bit-identical, so only its flights get digests.
        self._witnessed = resolved.scenario.firmware == "builtin"
        self._digest = FlightDigest() if self._witnessed else Unwitnessed()
        self._stop = threading.Event()
        self._supervisor = episode.EpisodeSupervisor(Referee(resolved.task(self._goal)), 0)
        self._judge = Judge(self._supervisor, self._digest, order=self._order, judged=self._decided)
        self._result: MissionResult | None = None

    def call_off(self) -> None:
        """Abort the flight without landing, as soon as the policy ends its turn."""
        self._called_off = True
        self._stop.set()
        if self._abandon is not None:
            self._abandon.set()

    def fly(self, tlog: Path | None = None, log: Path | None = None) -> FlownEpisode:
        """Fly the episode; see the function `fly`. Raises FirmwareLostError, too."""
        resolved = self._resolved
        setup = episode_setup(resolved, self.arena, self._seed)
        asked = resolved.scenario
        vehicle = real_vehicle(asked, resolved.vehicle, log)
        with ExitStack() as held:
            if self._view is not None:
                tap = view_part("flight")(self._view, resolved)
                self._watched = held.enter_context(closing(tap))
            self._stage = held.enter_context(
                LockstepStage(
                    transport_us=checks.TRANSPORT_US,
                    digest=self._digest,
                    # A viewer controls the pace.
                    speed=resolved.speed if self._view is None else None,
                    faults=resolved.scenario.faults,
                    vehicle=vehicle,
                    patience_s=self._patience_s,
                )
            )
            self._abandon = self._stage.abandon
            # `abandon` may be requested before the stage exists.
            if self._called_off:
                self._abandon.set()
            # Callbacks after each call of the simulator, on its thread.
            self._stage.firmware.on_ticks = self._look
            self._stage.conductor.orders_us = lambda: self._judge.due_us
            self._stage.firmware.on_message = self._hear
            if self._watched is not None:
                self._stage.firmware.on_frame = self._watched.frame
                self._stage.conductor.is_shown = True
            simulation = self._stage.run(
                setup,
                self._program,
                tlog=tlog,
                begun=self._begun,
                stop=self._stop,
                judged=lambda: self._supervisor.verdict is not None,
            )
            return self._flown(simulation)

    def _begun(self, started_us: int) -> None:
        self._supervisor.started_us = started_us
        if self._watched is not None:
            self._watched.begin(self._seed, self.arena, started_us)
        self._observer.episode(self._index, self._seed, self._goal)

    # --- the companion's thread

    def _program(self) -> None:
        resolved, stage, watched = self._resolved, self._stage, self._watched
        # Compensation and latency come from the scenario unless a viewer changes them.
        compensator, decided = resolved.compensator(), None
        latency = resolved.latency_sampler(self._seed, native=False)
        # Checked inside the flight: the first frame is needed.
        check_camera(self._policy, stage.camera, self._stop, compensator)
        if watched is not None:
            latency = watched.companion.latency(latency)
            compensator, decided = watched.companion.compensator(), watched.decided
        policy = WitnessedPolicy(self._policy, self._digest)
        mission = Mission.of(resolved, self._goal, policy, latency, compensator)
        self._result = fly_mission(
            stage.link,
            stage.camera,
            mission,
            stage.clock,
            self._stop,
            stage.abandon,
            self._announce,
            guard=stage.clock,
            decided=decided,
        )

    def _announce(self, phase: str) -> None:
        now_us = self._stage.clock.time_us()
        self._observer.phase(phase, now_us)
        self._judge.enter(phase, now_us)

    # --- the conductor's thread

    def _look(self, simulation: Simulation) -> None:
        """Process the true states of the newest ticks."""
        self._judge.look(simulation)
        self._ticked(simulation, self._supervisor.referee, self._judge.hit)
        if self._watched is not None:
            self._watched.tick(simulation, self._judge.hit)
        shown, self._ticks = self._ticks // SHOW_EVERY, self._ticks + len(simulation.truths)
        if self._observer.shows_states and self._ticks // SHOW_EVERY > shown:
            self._observer.state(state_of(simulation, self._judge.hit), simulation.start_us)

    def _order(self, order: episode.Order) -> None:
        verdict = self._supervisor.verdict
        if not self._lands and verdict is not None and verdict.outcome is Outcome.TIMEOUT:
            return
        if order is episode.Order.ABANDON:
            self._stage.abandon.set()
        self._stop.set()

    def _decided(self, verdict: Verdict) -> None:
        self._observer.phase(verdict.outcome.value, verdict.time_us)
        if self._start == "hover" and self._lands:
            self.call_off()

    def _hear(self, message: OperatorText) -> None:
        now_us = self._stage.conductor.clock.time_us()
        severity = int(message.severity)
        self._observer.text(Text(time_us=now_us, severity=severity, text=message.text))

    def _flown(self, simulation: Simulation) -> FlownEpisode:
        # Logs close before the arrays are read.
        self._stage.firmware.close_logs()
        # No mission result and no error: a fault kept the companion from starting.
        result = self._result or MissionResult(self._stage.unheard, (), DecisionLog())
        referee = self._supervisor.referee
        battery = self._judge.battery
        # A flight without a verdict ends with the companion's reason.
        if referee.verdict is None:
            battery = simulation.plant.battery_remaining
            referee.abort(simulation.time_us, self._stage.out or result.reason)
        arrays = simulation.arrays()
        trajectory = Trajectory.from_arrays(episode.part_of(arrays, "trajectory"))
        setpoints = episode.part_of(arrays, "setpoints")
        # The digest covers the setpoints that the vehicle has accepted.
        self._digest.add_setpoints(setpoints)
        latency = episode.part_of(arrays, "estimate", keep_prefix=True)
        # No slips in lockstep, hence the empty array.
        latency |= episode.join_stamps(result.log.columns(), setpoints, np.zeros((0, 2), np.int64))
        record = episode.judged_record(
            self._resolved,
            referee,
            trajectory,
            latency,
            referee.navigation_us,
            index=self._index,
            seed=self._seed,
            goal=self._goal,
            started_us=self._supervisor.started_us,
            wall_s=None,
            slipped_us=0,
            battery_remaining=battery,
            firmware=self._stage.firmware.flight_stack.version,
            notes=(*self._notes, *result.notes, *self._stage.firmware.logs_lost),
            faults=episode.faults_of(arrays),
            sha256=self._fingerprint(),
        )
        effects = self._stage.firmware.flight_stack.effects()
        record = episode.with_effects(record, self._resolved, effects)
        # A flight that a viewer or another sender changed is not reproducible: without digest.
        if record.invalid:
            record = replace(record, sha256=None)
        if self._watched is not None and self._watched.companion.touched:
            notes = (*record.notes, BY_HAND)
            record = replace(record, notes=notes, invalid=(*record.invalid, BY_HAND), sha256=None)
        return FlownEpisode(record, trajectory, latency)

    def _fingerprint(self) -> dict[str, str] | None:
        """Return the digest; None for real firmware, whose threads are scheduled by the host."""
        if not self._witnessed:
            return None
        return {"flight": self._digest.hexdigest(), **self._digest.lanes()}


class Judge:
    """Observer of one flight's true state. Call on the conductor's thread, or while it waits."""

    def __init__(
        self,
        supervisor: episode.EpisodeSupervisor | None,
        digest: FlightDigest,
        *,
        order: Callable[[episode.Order], None],
        judged: Callable[[Verdict], None] = lambda _: None,
    ) -> None:
        """Set the supervisor, None = no verdict, and the digest of the true trajectory.

        `order` receives orders to the companion, `judged` the verdict.
        """
        self.battery: float | None = None
        """Remaining battery at the verdict; None = no verdict yet."""
        self._supervisor = supervisor
        self._digest = digest
        self._order = order
        self._judged = judged
        self._crash = CrashDetector()

    @property
    def due_us(self) -> float:
        """Time of the next time-based order to the companion [µs]; inf = never."""
        return math.inf if self._supervisor is None else self._supervisor.due_us

    @property
    def hit(self) -> str | None:
        """First object that was hit; None = no collision."""
        return self._crash.hit

    def enter(self, phase: str, time_us: int) -> None:
        """Register that the companion enters a phase, at a simulated time [µs]."""
        if self._supervisor is None or phase != "navigating":
            return
        referee = self._supervisor.referee
        if referee.navigation_us is None:
            referee.start_navigation(time_us)

    def look(self, simulation: Simulation) -> None:
        """Process the true states of the newest ticks."""
        self._crash.look(simulation)
        truths, supervisor = simulation.truths, self._supervisor
        self._digest.extend("trajectory", truths.tobytes())
        if supervisor is not None:
            # Earlier ticks are relevant only if the flight may end at any of them.
            first = 0 if self._may_decide(supervisor.referee, truths) else -1
            for time_us, motion, _, charge in truths[first:].tolist():
                self._see(supervisor, TruthSample(time_us, motion[:3], self._crash.hit, charge))

    def _see(self, supervisor: episode.EpisodeSupervisor, sample: TruthSample) -> None:
        before = supervisor.verdict
        order = supervisor.see(sample)
        if before is None and supervisor.verdict is not None:
            self.battery = sample.battery_remaining
            self._judged(supervisor.verdict)
        if order is not None:
            self._order(order)

    def _may_decide(self, referee: Referee, truths: Record) -> bool:
        """Return True if the flight may end before the last of some ticks (n,)."""
        # A single tick is always judged on its own.
        if referee.verdict is not None or len(truths) < 2:
            return False
        last, task, began_us = truths[-1], referee.task, referee.navigation_us
        # Cheap necessary conditions; the referee decides tick by tick if one holds.
        if self._crash.hit is not None or last["charge"] <= 0.0:
            return True
        if began_us is None:
            return False
        if last["time_us"] - began_us >= task.time_limit_s * US_PER_S:
            return True
        # Horizontal distance: a lower bound if the goal has a height.
        away = truths["motion"][:, :2] - task.goal[:2]
        return bool((np.hypot(away[:, 0], away[:, 1]) < task.goal_radius_m).any())
