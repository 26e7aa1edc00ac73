"""One episode in lockstep: everything of it is made here, flown, and thrown away."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from airl_mav.arena.generate import generate
from airl_mav.flight.judge import Referee, Verdict
from airl_mav.flight.trajectory import Trajectory
from airl_mav.lockstep.digest import FlightDigest, WitnessedPolicy
from airl_mav.lockstep.judging import Judge
from airl_mav.lockstep.stage import Stage
from airl_mav.policy.actions import Policy
from airl_mav.rehearsal.episode import join_stamps, judged_record
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.rehearsal.supervisor import Order, Supervisor
from airl_mav.scenario.piloting import TRANSPORT_US
from airl_mav.scenario.resolved import ResolvedScenario
from companion.mission import MissionResult, check_camera, fly_mission
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.simulation import EpisodeSetup, Simulation


@dataclass
class Watching:
    """Who looks on. All calls come from the conductor's thread, or while it waits."""

    begin: Callable[[tuple[float, float]], None] = field(default=lambda _goal: None)
    """The episode begins; its goal (north, east) [m]."""
    phase: Callable[[str, int], None] = field(default=lambda _phase, _time_us: None)
    """The companion has entered a phase, at a simulated time [µs]."""
    text: Callable[[Message, int], None] = field(default=lambda _message, _time_us: None)
    """The autopilot said something, at a simulated time [µs]."""
    tick: Callable[[Simulation, str | None], None] = field(default=lambda _simulation, _hit: None)
    """A tick has been flown; what has been hit so far."""


def fly(
    resolved: ResolvedScenario,
    policy: Policy,
    index: int,
    seed: int,
    *,
    tlog: Path | None = None,
    watching: Watching | None = None,
) -> FlownEpisode:
    """Fly one episode; the same scenario, policy and seed give the same flight, bit by bit.

    Args:
        resolved: The scenario.
        policy: What decides, as it begins a flight.
        index: Number of the episode in its run.
        seed: Of arena, sensors, wind and latency.
        tlog: Where its MAVLink log goes; None: no log.
        watching: Who looks on.

    Raises:
        UsageError: The policy cannot use the camera; no arena can be made of the seed.
        LockstepError: The companion hangs, or broke.
    """
    return _Flight(resolved, policy, seed, watching or Watching()).fly(index, tlog)


class _Flight:
    """The parts of one flight."""

    def __init__(
        self, resolved: ResolvedScenario, policy: Policy, seed: int, watching: Watching
    ) -> None:
        self._resolved, self._policy, self._seed = resolved, policy, seed
        self._watching = watching
        self._arena_seed = resolved.scenario.arena_seed_of(seed)
        self._arena = generate(
            resolved.arena,
            self._arena_seed,
            name=resolved.scenario.arena,
            vehicle_width_m=resolved.vehicle.body.width_m,
        )
        self._goal = (float(self._arena.goal[0]), float(self._arena.goal[1]))
        self._digest = FlightDigest()
        self._stop = threading.Event()
        self._supervisor = Supervisor(Referee(resolved.task(self._goal)), 0)
        self._judge = Judge(self._supervisor, self._digest, order=self._order, judged=self._decided)
        self._result: MissionResult | None = None

    def fly(self, index: int, tlog: Path | None) -> FlownEpisode:
        resolved = self._resolved
        setup = EpisodeSetup(resolved.vehicle, self._arena, self._seed, resolved.scenario)
        with Stage(
            transport_us=TRANSPORT_US, digest=self._digest, speed=resolved.speed
        ) as self._stage:
            self._stage.firmware.on_tick = self._look
            self._stage.firmware.on_message = self._hear
            simulation = self._stage.run(setup, self._program, tlog=tlog, begun=self._begun)
            return self._flown(index, simulation)

    def _begun(self, started_us: int) -> None:
        self._supervisor.started_us = started_us
        self._watching.begin(self._goal)

    # --- the companion's thread

    def _program(self) -> None:
        resolved, stage = self._resolved, self._stage
        check_camera(self._policy, stage.camera, self._stop)
        self._result = fly_mission(
            stage.link,
            stage.camera,
            WitnessedPolicy(self._policy, self._digest),
            self._goal,
            stage.clock,
            self._stop,
            stage.abandon,
            self._announce,
            pilot_settings=resolved.companion_pilot,
            watchdog_settings=resolved.watchdog,
            guard=stage.clock,
            latency=resolved.latency_sampler(self._seed, native=False),
        )

    def _announce(self, phase: str) -> None:
        now_us = self._stage.clock.time_us()
        self._watching.phase(phase, now_us)
        self._judge.enter(phase, now_us)

    # --- the conductor's thread

    def _look(self, simulation: Simulation) -> None:
        """Take the true state after a tick."""
        self._judge.look(simulation)
        self._watching.tick(simulation, self._judge.hit)

    def _order(self, order: Order) -> None:
        if order is Order.ABANDON:
            self._stage.abandon.set()
        self._stop.set()

    def _decided(self, verdict: Verdict) -> None:
        self._watching.phase(verdict.outcome.value, verdict.time_us)

    def _hear(self, message: Message) -> None:
        self._watching.text(message, self._stage.conductor.clock.time_us())

    def _flown(self, index: int, simulation: Simulation) -> FlownEpisode:
        result = self._result
        assert result is not None  # noqa: S101 (nothing broke)
        referee = self._supervisor.referee
        battery = self._judge.battery
        if referee.verdict is None:
            battery = simulation.plant.battery_remaining
            referee.abort(simulation.time_us, result.reason)
        arrays = simulation.arrays()
        parts = {
            name: {key.partition("/")[2]: v for key, v in arrays.items() if key.startswith(name)}
            for name in ("trajectory/", "setpoints/")
        }
        trajectory = Trajectory.from_arrays(parts["trajectory/"])
        setpoints = parts["setpoints/"]
        self._digest.add_setpoints(setpoints)
        latency = {key: v for key, v in arrays.items() if key.startswith("estimate/")}
        latency |= join_stamps(result.log.columns(), setpoints, np.zeros((0, 2), np.int64))
        record = judged_record(
            referee,
            trajectory,
            referee.navigation_us,
            index=index,
            seed=self._seed,
            arena=self._resolved.scenario.arena,
            arena_seed=self._arena_seed,
            goal=self._goal,
            started_us=self._supervisor.started_us,
            computer_watts=self._resolved.computer.watts,
            wall_s=None,
            slipped_us=0,
            battery_remaining=battery,
            notes=result.notes,
            sha256={"flight": self._digest.hexdigest(), **self._digest.lanes()},
        )
        return FlownEpisode(record, trajectory, latency)
