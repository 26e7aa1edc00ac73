"""Paths and stamps of the batch twin, against a tick-by-tick recording of the same flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.envs.evaluation import EpisodeResult, SinglePilots, Trace, fly_seeds
from airl_mav.envs.fleet import Fleet, FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import Delay, EnvironmentSpec, EpisodeRules
from airl_mav.flight.trajectory import SAMPLE_US, Trajectory
from airl_mav.latency.stages import stage_samples
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.policy.actions import Action
from airl_mav.policy.greedy import GreedyPolicy
from airl_mav.policy.observation import Observation
from tests.support.recording import TestRecorder, record_tick

SEEDS = range(1, 13)


def spec(arena: str = "static-obstacles", **changes: Any) -> EnvironmentSpec:
    size = {"image_width_px": 64, "image_height_px": 48}
    return EnvironmentSpec(arena=arena, **(size | changes))


def pilots() -> SinglePilots:
    return SinglePilots(GreedyPolicy, 5.0)


@dataclass
class Kept:
    """A flight and its trace."""

    flown: EpisodeResult
    path: Trajectory
    latency: dict[str, np.ndarray]


def fly(
    environment: EnvironmentSpec, seeds: Sequence[int], slots: int, trace: Trace | None = None
) -> dict[int, Kept]:
    trace = trace or Trace(slots)
    navigation = Navigation(environment, slots, trace=trace)
    return {
        flown.seed: Kept(flown, trace.trajectory(slot), trace.latency(slot))
        for slot, flown in fly_seeds(navigation, pilots(), seeds)
    }


@pytest.mark.parametrize("arena", ["static-obstacles", "dynamic-obstacles"])
def test_a_traced_flight_is_the_same_flight(arena: str) -> None:
    environment = spec(arena, delay=Delay(computer="ras-pi-4", workload="template-5x32"))
    plain = Navigation(environment, 4)
    ends = {}
    for slot, flown in fly_seeds(plain, pilots(), SEEDS):
        ends[flown.seed] = flown, plain.truth().position[slot]
    for seed, kept in fly(environment, SEEDS, 4).items():
        flown, position = ends[seed]
        one, other = kept.flown, flown
        assert (one.verdict, one.flight_time_s, one.decisions) == (
            other.verdict,
            other.flight_time_s,
            other.decisions,
        )
        # The order of a sum differs: each step's length and energy is added up in parts.
        assert one.distance_m == pytest.approx(other.distance_m, rel=1e-12)
        assert one.energy_j == pytest.approx(other.energy_j, rel=1e-12)
        assert np.array_equal(kept.path.position[-1], position)


class TickByTick(Trace):
    """Flies single ticks and hands each to the plant's own recorder."""

    def __init__(self) -> None:
        super().__init__(1)
        self.recorder = TestRecorder()
        self.poses: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._energy_j = 0.0

    def begin(self, i: int, fleet: Fleet) -> None:
        super().begin(i, fleet)
        self._add(fleet, 0.0)

    def next_us(self, fleet: Fleet) -> np.ndarray:
        return fleet.time_us + TICK_US

    def sample(self, fleet: Fleet) -> None:
        if int(fleet.time_us[0]) not in self.poses:
            energy_j = float(fleet.energy[0])
            self._add(fleet, (energy_j - self._energy_j) * US_PER_S / TICK_US)
            self._energy_j = energy_j

    def _add(self, fleet: Fleet, power_w: float) -> None:
        state = fleet.position[0].copy(), fleet.velocity[0].copy(), fleet.quaternion[0].copy()
        ended = bool(fleet.verdict[0] != FlightStatus.FLYING)
        time_us = int(fleet.time_us[0])
        record_tick(self.recorder, time_us, *state, power_w, keep=ended)
        self.poses[time_us] = state[0], state[2]


@pytest.mark.parametrize("seed", [3, 9, 32])
def test_the_path_is_what_the_plants_recorder_keeps(seed: int) -> None:
    reference = TickByTick()
    fly(spec(), [seed], 1, reference)
    path, wanted = fly(spec(), [seed], 1)[seed].path, reference.recorder.trajectory()
    assert np.array_equal(path.time_us, wanted.time_us)
    assert len(path) > 256 or seed != 9, "long enough that the tables have to grow"
    for name in ("position", "velocity", "quaternion"):
        assert np.array_equal(getattr(path, name), getattr(wanted, name)), name
    assert path.power_w[1:] == pytest.approx(wanted.power_w[1:], rel=1e-9)
    assert path.power_w[0] == path.power_w[1]


def test_rows_lie_20_ms_apart_and_the_last_is_the_end() -> None:
    for kept in fly(spec(), SEEDS, 5).values():
        steps = np.diff(kept.path.time_us)
        assert kept.path.time_us[0] == 0
        assert np.all(steps[:-1] == SAMPLE_US)
        assert kept.path.time_us[-1] == round(kept.flown.flight_time_s * US_PER_S)
        spent = np.sum(kept.path.power_w[1:] * steps / US_PER_S)
        assert spent == pytest.approx(kept.flown.energy_j, rel=1e-9)
        flown = np.linalg.norm(np.diff(kept.path.position, axis=0), axis=1).sum()
        # Chords of 20 ms are hardly shorter than the arcs.
        assert 0.999 * kept.flown.distance_m < flown <= kept.flown.distance_m


def test_a_slot_forgets_its_flight_before_the_next() -> None:
    alone = {seed: fly(spec(), [seed], 1)[seed] for seed in SEEDS}
    for seed, kept in fly(spec(), SEEDS, 3).items():
        for name, array in kept.path.arrays().items():
            assert np.array_equal(array, getattr(alone[seed].path, name)), name
        for name, array in kept.latency.items():
            assert np.array_equal(array, alone[seed].latency[name]), name
        assert len(kept.latency["sent_us"]) == kept.flown.decisions


def test_stamps_add_up_to_what_the_model_was_told() -> None:
    environment = spec(delay=Delay(native_ms=30.0, transport_ms=12.0, link_ms=8.0))
    kept = fly(environment, [9], 1)[9]
    stamps = kept.latency
    went_on = stamps["held_until_us"][:-1]
    assert np.array_equal(stamps["infer_start_us"][1:], went_on)
    stages = stage_samples(stamps)
    assert set(stages["t2"].tolist()) == {30_000}
    assert set(stages["setpoint_to_motor"].tolist()) == {8_000}
    assert set(stages["t1"][1:].tolist()) == {12_000}
    # 32 ms: t2 in whole ticks.
    assert set(stages["period"].tolist()) == {532_000}
    period_us = 1e6 / 30.0
    wait = stages["wait"][1:]
    assert np.all((wait >= -TICK_US) & (wait <= period_us + TICK_US))
    total = stages["t1"] + stages["wait"] + stages["t2"]
    motor = stamps["motor_us"] != NO_STAMP
    assert np.array_equal(total[motor] + 8_000, stages["end_to_end"])


def test_what_comes_after_the_end_has_no_stamp() -> None:
    seen = 0
    delay = Delay(native_ms=300.0)
    for kept in fly(spec(delay=delay), SEEDS, 12).values():
        end = kept.path.time_us[-1]
        for name, stamps in kept.latency.items():
            if name != "setpoint":
                assert np.all(stamps <= end), name
                assert np.all(stamps[:-1] != NO_STAMP), name
        sent, held = kept.latency["sent_us"][-1], kept.latency["held_until_us"][-1]
        if kept.latency["infer_start_us"][-1] + 300_000 > end:
            assert sent == held == kept.latency["motor_us"][-1] == NO_STAMP
            seen += 1
        else:
            assert held == end
    assert seen, "no flight ended while it was thinking: the test tests nothing"


def test_the_frame_was_taken_where_its_stamp_says() -> None:
    """Every image that is decided on is rendered again at the pose of its capture stamp."""
    images = []

    class Watching:
        def __init__(self) -> None:
            self._policy = GreedyPolicy()

        def act(self, seen: Observation) -> Action:
            images.append(seen.depth_mm.copy())
            return self._policy.act(seen)

    trace = TickByTick()
    navigation = Navigation(spec(), 1, trace=trace)
    ((slot, _),) = fly_seeds(navigation, SinglePilots(Watching, 5.0), [8])
    captures = trace.latency(slot)["capture_us"]
    arena = generate(navigation.arena_spec, 8, name="again", vehicle_width_m=0.55)
    camera = navigation.camera
    mount = Mount((camera.forward_m, 0.0, -camera.up_m), np.deg2rad(camera.pitch_up_deg))
    assert len(images) == len(captures) > 10
    for capture_us, image in zip(captures, images, strict=True):
        pose = camera_pose(*trace.poses[int(capture_us)], mount)
        depth = render(
            arena, arena.centers_at(int(capture_us)), navigation.intrinsics, camera.range_m, *pose
        )
        assert np.array_equal(depth_to_z16(depth), image)


def test_setpoints_are_what_was_commanded() -> None:
    class Circle:
        def act(self, seen: Observation) -> Action:
            return Action(1.0, -0.5, 0.25)

    trace = Trace(1)
    rules = EpisodeRules(time_limit_s=3.0)
    navigation = Navigation(spec("no-obstacles", episode=rules), 1, trace=trace)
    ((slot, flown),) = fly_seeds(navigation, SinglePilots(Circle, 5.0), [1])
    setpoints = trace.latency(slot)["setpoint"]
    assert flown.verdict is FlightStatus.TIMEOUT
    assert setpoints.dtype == np.float32
    assert np.all(setpoints[:, [0, 1, 3]] == np.array([1.0, -0.5, 0.25], np.float32))
