"""A made-up run with the shape of a real one: for the tests of the run folder and the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.core.machine import code_now
from airl_mav.core.resource_use import ProcessUse
from airl_mav.flight.episode_record import EpisodeRecord, Part, Setup
from airl_mav.flight.judge import Outcome, Referee, Task, TruthSample
from airl_mav.flight.trajectory import Trajectory, measure_quality
from airl_mav.latency.injection import choose_injection
from airl_mav.latency.stamps import DecisionLog
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from tests.support.recording import TestRecorder, record_tick

TICK_US = 20_000
TAKEOFF_US = 5_000_000
CRUISE_ALTITUDE_M = 2.0
WATTS = 1.7


def demo_setup() -> Setup:
    return Setup(
        level="sitl",
        vehicle=Part("quad", "Iris-class quadcopter, X configuration, 1.5 kg"),
        arena=Part("static-obstacles", "5 to 10 standing obstacles in 50 x 50 m"),
        policy=Part("scout", "25 discrete actions, 32 x 24 depth"),
        computer=Part("ras-pi-4", "Raspberry Pi 4 (the paper's onboard computer)"),
        computer_watts=WATTS,
        injection=choose_injection(load_computer("ras-pi-4"), "template-5x32"),
        speed=1.0,
        between_commands="persist",
    )


def demo_arena(seed: int, profile: str = "static-obstacles") -> Arena:
    spec = load_profile("arenas", profile, ArenaSpec)
    return generate(spec, seed, name=profile, vehicle_width_m=0.55)


def demo_use(index: int) -> ProcessUse:
    watts = 4.0 + index if index != 1 else None
    return ProcessUse(20.0, 2.0 + index, (90 + index) << 20, "begin", watts, "INA monitor: VDD_IN")


def demo_episode(
    index: int, arena: Arena, *, time_limit_s: float = 40.0
) -> tuple[EpisodeRecord, Trajectory, dict[str, np.ndarray]]:
    """Fly a lagging, wobbling point to the goal, past or into the obstacles."""
    rng = np.random.default_rng(1000 + index)
    started_us = index * 100_000_000
    navigation_us = started_us + TAKEOFF_US
    referee = Referee(Task((float(arena.goal[0]), float(arena.goal[1])), 2.0, time_limit_s))
    recorder, log = TestRecorder(), DecisionLog(capacity=8)
    position, velocity, command = np.zeros(3), np.zeros(3), np.zeros(3)
    decide_us, charge, now, setpoints = navigation_us, 0.9, started_us, []
    while referee.verdict is None:
        if now == navigation_us:
            referee.start_navigation(now)
        if now < navigation_us:
            command = np.array([0.0, 0.0, -1.2 if position[2] > -CRUISE_ALTITUDE_M else 0.0])
        elif now >= decide_us:
            bearing = np.arctan2(*(arena.goal - position[:2])[::-1]) + rng.normal(0.0, 0.5)
            speed = rng.uniform(1.0, 5.0)
            command = np.array([speed * np.cos(bearing), speed * np.sin(bearing), 0.0])
            t2 = int(rng.lognormal(np.log(396e3), 0.05))
            capture = now - int(rng.uniform(1e3, 33e3))
            stamps = np.cumsum([capture, rng.gamma(4, 400), 900, t2, 40]).astype(int)
            a, b, c, d, e = (int(stamp) for stamp in stamps)
            north, east, down = (float(v) for v in command)
            log.record(a, b, c, d, e, e + 500_000, (north, east, down, 0.0))
            link, control = int(rng.gamma(2, 90)), int(rng.uniform(0, 8e3))
            setpoints.append((stamps[-1] + link, stamps[-1] + link + control))
            decide_us = int(stamps[-1]) + 500_000
        change = (command - velocity) / 0.45 + rng.normal(0.0, 0.3, 3)
        velocity = velocity + change * 0.02
        position = position + velocity * 0.02
        now += TICK_US
        power = 430.0 + 9.0 * abs(change[2]) + 4.0 * np.hypot(*change[:2])
        charge -= power * 0.02 / (14.8 * 5.2 * 3600)
        x, y, z = position
        sample = TruthSample(now, (x, y, z), _hit(arena, position, now - started_us), charge)
        ended = referee.observe(sample)
        record_tick(
            recorder, now, position, velocity, [1.0, 0.0, 0.0, 0.0], power, keep=ended is not None
        )
    # A recording continues until the vehicle has landed, away from its path.
    for _ in range(50):
        now, position = now + TICK_US, position + np.array([0.1, -0.1, 0.02])
        record_tick(recorder, now, position, [5.0, -5.0, 1.0], [1.0, 0.0, 0.0, 0.0], 430.0)
    trajectory = recorder.trajectory()
    verdict = referee.verdict
    record = EpisodeRecord(
        index=index,
        seed=7 + index,
        arena=arena.name,
        arena_seed=arena.seed,
        outcome=verdict.outcome,
        reason=verdict.reason,
        goal=referee.task.goal,
        goal_radius_m=2.0,
        time_limit_s=time_limit_s,
        started_us=started_us,
        navigation_us=navigation_us,
        ended_us=verdict.time_us,
        wall_s=(verdict.time_us - started_us) / 1e6 + 0.002,
        slipped_us=0 if index else 8_000,
        battery_remaining=charge,
        quality=measure_quality(
            trajectory,
            navigation_us,
            verdict.time_us,
            WATTS,
            decisions={**log.columns(), "motor_us": np.array(setpoints, np.int64)[:, 1]},
            hold_s=0.5,
        ),
        notes=("watchdog: a decision was 620 ms late",) if index == 2 else (),
        companion_use=demo_use(index),
        code=code_now(),
    )
    accepted = np.array(setpoints, np.int64).reshape(-1, 2)
    if index == 1:
        accepted[0] = -1
    ticks = (verdict.time_us - started_us) // 4_000
    latency = {
        **log.columns(),
        "accepted_us": accepted[:, 0],
        "motor_us": accepted[:, 1],
        "tick_lateness_us": (rng.gamma(1.5, 60.0, ticks) + 40).astype(np.int64),
    }
    return record, trajectory, latency


def _hit(arena: Arena, position: np.ndarray, since_us: int) -> str | None:
    if position[2] > -0.3:
        return None
    near = np.linalg.norm(arena.centers_at(since_us)[:, :2] - position[:2], axis=1)
    hits = np.flatnonzero(near < arena.obstacles.half_size[:, 0] + 0.2)
    return f"obstacle {hits[0]}" if hits.size else None


def write_demo_run(
    path: Path, episodes: int = 4, profile: str = "static-obstacles"
) -> tuple[RunFolder, dict[int, Arena]]:
    """Write a run of a few flights; return it with its arenas."""
    arenas = {index: demo_arena(index + 1, profile) for index in range(episodes)}
    config = {"seed": 7, "episodes": episodes, "arena": profile, "companion": {"hold_s": 0.5}}
    folder = RunFolder.create(
        path, "demo", config, setup=demo_setup(), seeds=range(7, 7 + episodes)
    )
    for index, arena in arenas.items():
        limit_s = 12.0 if index == 3 else 40.0
        folder.save_episodes([FlownEpisode(*demo_episode(index, arena, time_limit_s=limit_s))])
    folder.close()
    return folder, arenas


OUTCOMES_SEEN = {Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT}
