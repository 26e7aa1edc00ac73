"""Latency compensation and pipelined decisions: simulator against companion, and the benefit."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import Frame, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.clock import SimClock
from airl_mav.core.errors import UsageError
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.fleet import Rules, hover, new_fleet, vehicle_of
from airl_mav.envs.fleet_step import advance
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.latency.injection import FixedSampler
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Kinematics, Observation
from airl_mav.prediction import Compensator
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.comparison import show
from airl_mav.scenario.model import LevelName, PilotSettings, Scenario, WatchdogSettings
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.frame_source import ReceivedFrame
from companion.link_interface import BodyVelocity, Setpoint, VehicleStatus
from companion.pilot import Pilot
from companion.program import prepare
from companion.watchdog import Watchdog
from tests.support.command_line import airl
from tests.support.lockstep_kit import SEED, demo_scenario

QUAD = load_vehicle("quad")
VEHICLE = vehicle_of(QUAD, px4_release().flown_values(QUAD.parameters).__getitem__)
LENS = Intrinsics.of(QUAD.camera)
TICK_US, PERIOD_US = 4000, 33_333
ARENA, ARENA_SEED, ALTITUDE_M = "static-obstacles", 7, 2.5
FIRST = 100
"""Sequence number of the camera's first frame of a flight; there were some before."""
COMMANDS = [
    [3.0, 0.0, 0.3],
    [2.0, 1.0, -0.8],
    [0.0, -1.5, 0.0],
    [4.0, 0.0, -0.4],
    [1.0, 0.5, 1.0],
    [-1.0, 0.0, 0.0],
    [2.0, 0.0, 1.5],
]


# --- twin and companion


class World:
    """A vehicle that is flown tick by tick up to the pilot's clock: its link and its camera.

    Setpoints take `link_ticks` to be accepted, frames `transport_us` to be decoded.
    """

    connected = True

    def __init__(self, clock: SimClock, link_ticks: int, transport_us: int) -> None:
        spec = load_profile("arenas", ARENA, ArenaSpec)
        self.arena = generate(spec, ARENA_SEED, name=ARENA, vehicle_width_m=QUAD.body.width_m)
        self._batch = batch_of([self.arena])
        self._fleet = new_fleet(1)
        hover(self._fleet, 0, ALTITUDE_M, VEHICLE)
        self._clock, self._link_ticks, self._transport_us = clock, link_ticks, transport_us
        phase = np.random.default_rng(np.random.SeedSequence(ARENA_SEED, spawn_key=(11,))).random()
        self._first_us = -int(phase * PERIOD_US)
        self._tick = 0
        self._poses = [self._pose()]
        self._due: list[tuple[int, BodyVelocity]] = []
        camera = QUAD.camera
        self._mount = Mount(
            (camera.forward_m, 0.0, -camera.up_m), math.radians(camera.pitch_up_deg)
        )

    def _pose(self) -> tuple[np.ndarray, np.ndarray]:
        return self._fleet.position[0].copy(), self._fleet.quaternion[0].copy()

    def _catch_up(self) -> None:
        while self._tick * TICK_US < self._clock.time_us():
            self._accept()
            rules = Rules(3.0, 120_000_000)
            advance(self._fleet, self._batch, np.array([1]), VEHICLE, rules, None)
            self._tick += 1
            self._poses.append(self._pose())
        self._accept()

    def _accept(self) -> None:
        while self._due and self._due[0][0] <= self._tick:
            _, setpoint = self._due.pop(0)
            self._fleet.setpoint[0] = setpoint
            self._fleet.repeat_us[0] = self._tick * TICK_US

    def kinematics(self) -> Kinematics:
        self._catch_up()
        fleet = self._fleet
        return Kinematics(
            fleet.position[0].copy(), fleet.velocity[0].copy(), fleet.quaternion[0].copy()
        )

    def send_setpoint(self, setpoint: Setpoint) -> None:
        assert isinstance(setpoint, BodyVelocity)
        self._catch_up()
        self._due.append((self._tick + self._link_ticks, setpoint))
        self._accept()

    def leave_offboard(self) -> None:
        raise AssertionError("nothing is overdue")

    def status(self) -> VehicleStatus:
        return VehicleStatus(armed=True, offboard=True, mode="offboard")

    def release(self) -> None:
        raise AssertionError("nobody takes over")

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Return the newest frame once there is a newer one; time passes until then."""
        while True:
            self._catch_up()
            now_us = self._clock.time_us()
            newest = (now_us - self._transport_us - self._first_us) // PERIOD_US
            if FIRST + newest > newer_than_sequence:
                break
            self._clock.advance(TICK_US)
        captured_us = self._first_us + newest * PERIOD_US
        # Frames are taken at whole ticks, the very first one as the flight begins.
        age = min((now_us - captured_us + TICK_US // 2) // TICK_US, self._tick)
        tick = self._tick - (age if self._tick else 0)
        pose = camera_pose(*self._poses[tick], self._mount)
        centers = self.arena.centers_at(tick * TICK_US)
        depth = depth_to_z16(render(self.arena, centers, LENS, QUAD.camera.range_m, *pose))
        return ReceivedFrame(Frame(FIRST + newest, tick * TICK_US, depth, LENS), now_us)

    def latest(self) -> ReceivedFrame | None:
        return self.wait(-(10**9), 0.0)


def flown_by_the_pilot(
    t2_us: int, link_ticks: int, transport_us: int, decisions: Any
) -> tuple[list[Observation], np.ndarray]:
    """Return what the companion's pilot shows its policy, and when its decisions begin [µs]."""
    clock, stop = SimClock(), threading.Event()
    world = World(clock, link_ticks, transport_us)
    seen: list[Observation] = []

    class Scripted:
        def act(self, observation: Observation) -> Action:
            seen.append(observation)
            if len(seen) == len(COMMANDS):
                stop.set()
            return Action(*COMMANDS[len(seen) - 1])

    pilot = Pilot(
        *(world, world, Scripted(), Watchdog(world, clock, WatchdogSettings()), clock),
        PilotSettings(hold_s=0.5, altitude_m=ALTITUDE_M, decisions=decisions, compensate=True),
        latency=FixedSampler(t2_us),
        compensator=Compensator(1, QUAD, LENS),
    )
    goal = (float(world.arena.goal[0]), float(world.arena.goal[1]))
    assert pilot.fly(goal, stop) == "stopped"
    return seen, pilot.log.columns()["infer_start_us"]


@pytest.mark.parametrize(
    ("decisions", "t2_ticks", "link_ticks", "transport_ms"),
    [
        ("sequential", 99, 1, 5.0),
        ("sequential", 3, 20, 50.0),
        ("pipelined", 99, 1, 5.0),
        ("pipelined", 37, 1, 60.0),
        ("pipelined", 3, 20, 5.0),  # Up to three setpoints are in flight.
    ],
)
def test_twin_and_pilot_see_the_same(
    decisions: str, t2_ticks: int, link_ticks: int, transport_ms: float
) -> None:
    """The same images and states, bit by bit, at the same times: carried forward in both."""
    seen, starts = flown_by_the_pilot(
        t2_ticks * TICK_US, link_ticks, round(transport_ms * 1000), decisions
    )
    navigation = Navigation(
        EnvironmentSpec.model_validate(
            {
                "arena": ARENA,
                "randomisation": {"navigation_noise": 0.0},
                "delay": {
                    "native_ms": t2_ticks * 4.0,
                    "link_ms": link_ticks * 4.0,
                    "transport_ms": transport_ms,
                },
                "decisions": decisions,
                "compensate": True,
            }
        ),
        1,
    )
    navigation.begin([0], [ARENA_SEED])
    raw = []
    for k, command in enumerate(COMMANDS):
        twin = navigation.see().rows(0)
        if k < len(starts):
            assert navigation.flights().time_s[0] * 1e6 == starts[k]
        raw.append(np.array_equal(navigation.cameras.image[0], twin.depth_mm))
        assert np.array_equal(seen[k].depth_mm, twin.depth_mm)
        assert np.array_equal(seen[k].goal, twin.goal)
        assert np.array_equal(seen[k].velocity, twin.velocity)
        assert (seen[k].roll, seen[k].pitch, seen[k].yaw) == (twin.roll, twin.pitch, twin.yaw)
        navigation.fly(np.array([command]))
    # Once it flies, that is not what the camera has just seen.
    assert not raw[-1]


# --- pipelined


@pytest.mark.parametrize(("t2_ms", "link_ms"), [(396.0, 4.0), (150.0, 90.0), (1.0, 60.0)])
def test_pipelined_decisions_follow_each_other(t2_ms: float, link_ms: float) -> None:
    """Each begins when the one before is ready, or a frame has come that it had not seen."""
    spec = spec_of(
        None,
        {
            "arena": "no-obstacles",
            "delay": {"native_ms": t2_ms, "link_ms": link_ms},
            "decisions": "pipelined",
        },
    )
    navigation, captured_us = Navigation(spec, 3), np.full(3, -1)
    navigation.begin(range(3), (1, 2, 3))
    began_us = np.zeros(3)
    for k in range(12):
        before = captured_us
        navigation.fly(np.tile([3.0, 0.0, 0.5], (3, 1)))
        captured_us = navigation._decision.seen.time_us.copy()
        now_us = navigation.flights().time_s * 1e6
        lasted_us, began_us = now_us - began_us, now_us
        if t2_ms >= 40.0:
            assert (np.abs(lasted_us - 1e3 * t2_ms) <= TICK_US / 2).all()
        else:
            assert (lasted_us >= 1e3 * t2_ms).all()
            assert (lasted_us <= PERIOD_US + TICK_US).all()
        assert (captured_us > before).all() or k == 0
        # The newest that has been decoded.
        age_us = now_us - captured_us
        assert (age_us >= 5000 - TICK_US / 2).all()
        assert (age_us <= 5000 + PERIOD_US + TICK_US).all()


def test_pipelined_decisions_and_a_stop_after_the_hold_are_refused_in_one_line() -> None:
    asked: dict[str, Any] = {"decisions": "pipelined", "watchdog": {"hover_after_s": 0.06}}
    levels: tuple[LevelName, ...] = ("gym", "lockstep", "sitl")
    ways: list[Callable[[], object]] = [
        partial(resolve, Scenario(level=level, **asked)) for level in levels
    ]
    twin = {"decisions": "pipelined", "episode": {"hover_after_s": 0.06}}
    alone = StandAloneCompanion(policy="greedy", **asked)
    ways += [partial(spec_of, None, twin), partial(prepare, alone)]
    for refused in ways:
        with pytest.raises(UsageError, match=r"decisions.*pipelined.*hover_after_s") as caught:
            refused()
        assert "\n" not in f"{caught.value}"


# --- states


@pytest.mark.parametrize("decisions", ["sequential", "pipelined"])
def test_a_saved_environment_goes_on_bit_by_bit(decisions: str) -> None:
    spec = spec_of(
        None,
        {
            "arena": ARENA,
            "delay": {"latency": ["lognormal:150ms,60ms"], "link_ms": 20.0},
            "decisions": decisions,
            "compensate": True,
        },
    )
    rng = np.random.default_rng(1)
    first, second = Navigation(spec, 3), Navigation(spec, 3)
    first.begin(range(3), (5, 6, 7))
    for _ in range(4):
        first.fly(rng.uniform(-1.0, 3.0, (3, 3)))
    second.set_state(first.get_state())
    for _ in range(4):
        commands = rng.uniform(-1.0, 3.0, (3, 3))
        for each in (first, second):
            each.fly(commands)
        assert np.array_equal(first.see().depth_mm, second.see().depth_mm)
        assert np.array_equal(first.see().velocity, second.see().velocity)
        assert np.array_equal(first.truth().position, second.truth().position)


# --- what it reaches


def episodes_of(folder: Path) -> dict[int, dict[str, Any]]:
    """Return flights by seed, as a reader without this package sees them."""
    lines = map(json.loads, (folder / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in lines}


@pytest.mark.nightly  # As much is closed by test_hardware_gap_command.py.
def test_an_untrained_for_latency_costs_little_once_it_is_compensated(tmp_path: Path) -> None:
    """The paper's 396 ms: of 60 seeds `static-obstacles` loses few, and flies hardly longer."""
    words = ["static-obstacles", "--latencies", "11ms", "396ms", "--compensated"]
    words += ["--episodes", "60", "--seed", "700000", "--out", str(tmp_path)]
    with patch.object(show, "write_document", lambda _, folder: folder / "latency-sweep.html"):
        code, text = airl("latency-sweep", *words)
    assert code == 0
    assert "static-obstacles, compensated" in text
    names = ("11ms", "396ms", "-compensated-11ms", "-compensated-396ms")
    runs = [episodes_of(tmp_path / f"static-obstacles-{name}") for name in names]
    reached = [[e["outcome"] == "success" for e in run.values()] for run in runs]

    def longer(run: dict[int, Any], reference: dict[int, Any]) -> float:
        both = [s for s in run if run[s]["outcome"] == reference[s]["outcome"] == "success"]
        means = [
            np.mean([r[s]["quality"]["flight_time_s"] for s in both]) for r in (run, reference)
        ]
        return float(means[0] / means[1] - 1.0)

    assert longer(runs[1], runs[0]) > 0.3
    assert longer(runs[3], runs[0]) < 0.15
    assert abs(longer(runs[2], runs[0])) < 0.05
    assert np.mean(reached[3]) >= np.mean(reached[0]) - 0.05


@pytest.mark.nightly
def test_one_flight_in_lockstep_is_the_same_twice() -> None:
    """Through estimator, MAVLink and MAVSDK; pipelined, its decisions follow each other."""
    resolved = demo_scenario(latency="200ms", compensate=True, decisions="pipelined")
    flown = [fly(resolved, resolved.fresh_policy(SEED), 0, SEED) for _ in range(2)]
    first, second = (each.record.sha256 for each in flown)
    assert first is not None
    assert first == second
    stamps = flown[0].latency
    assert np.array_equal(stamps["infer_start_us"][1:], stamps["action_ready_us"][:-1])
    assert (np.diff(stamps["capture_us"]) > 0).all()


# --- the command line


@pytest.mark.parametrize(
    ("words", "between"),
    [
        ([], "persist"),
        (["--compensate"], "persist, latency compensated"),
        (["--no-compensate"], "persist"),
        (
            ["--decisions", "pipelined", "--compensate"],
            "persist, pipelined decisions, latency compensated",
        ),
    ],
)
def test_evaluate_flies_as_it_is_told(words: list[str], between: str, tmp_path: Path) -> None:
    asked = ["--level", "gym", "--episodes", "1", "--out", str(tmp_path / "out"), *words]
    code, _ = airl("evaluate", "static-obstacles", *asked)
    assert code == 0
    run = json.loads(next(tmp_path.rglob("run.json")).read_text())
    assert run["setup"]["between_commands"] == between
