"""The batch twin's decision loop: against a fleet flown by hand, tick by tick, and the pilot."""

from __future__ import annotations

import math
import threading
from itertools import accumulate, count
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import Frame, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.clock import SimClock
from airl_mav.core.errors import UsageError
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.draws import BLOCK, DelayDraws
from airl_mav.envs.fleet import Fleet, FlightStatus, Rules, hover, new_fleet, vehicle_of
from airl_mav.envs.fleet_step import advance
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.latency.injection import choose_injection, parse_latency
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Kinematics, Observation
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import PilotSettings, WatchdogSettings
from companion.frame_source import ReceivedFrame
from companion.link_interface import Setpoint, VehicleStatus
from companion.pilot import Pilot
from companion.watchdog import Watchdog

QUAD = load_vehicle("quad")
VEHICLE = vehicle_of(QUAD, px4_release().flown_values(QUAD.parameters).__getitem__)
TRUE_STATE = {"navigation_noise": 0.0}
TICK_US = 4000
PERIOD_US = 33_333
"""Frame period of the quad's camera [µs], 30 Hz."""


def spec_with(**knobs: object) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({"randomisation": TRUE_STATE} | knobs)


def rounded(time_us: float) -> int:
    """Whole ticks, halves up."""
    return math.floor(time_us / TICK_US + 0.5)


class ByHand:
    """One vehicle, advanced tick by tick, with an independent computation of event times."""

    def __init__(self, arena_name: str, seed: int) -> None:
        spec = load_profile("arenas", arena_name, ArenaSpec)
        self.arena = generate(spec, seed, name=arena_name, vehicle_width_m=QUAD.body.width_m)
        self.batch = batch_of([self.arena])
        self.fleet: Fleet = new_fleet(1)
        hover(self.fleet, 0, 2.5, VEHICLE)
        self.poses = [self._pose()]
        self.tick = 0

    def _pose(self) -> tuple[np.ndarray, np.ndarray]:
        return self.fleet.position[0].copy(), self.fleet.quaternion[0].copy()

    def until(self, tick: int) -> None:
        while self.tick < tick:
            advance(
                self.fleet,
                self.batch,
                np.array([1]),
                VEHICLE,
                Rules(3.0, 120_000_000),
                None,
            )
            self.tick += 1
            self.poses.append(self._pose())

    def send(self, setpoint: list[float]) -> None:
        self.fleet.setpoint[0] = setpoint
        self.fleet.repeat_us[0] = self.tick * TICK_US

    def decide(
        self,
        command: list[float],
        t2_us: int,
        link_us: int,
        hold_us: int,
        hover_us: int | None = None,
    ) -> None:
        """Fly one decision that is taken now."""
        seen_us = self.tick * TICK_US
        sent = rounded(seen_us + t2_us)
        accepted = rounded(seen_us + t2_us + link_us)
        if hover_us is not None and rounded(seen_us + hover_us + link_us) < accepted:
            stop = rounded(seen_us + hover_us + link_us)
            for tick in sorted({stop, sent}):
                self.until(min(tick, accepted))
                if tick == stop:
                    self.send([0.0] * 4)
                if tick == sent:
                    position = self.fleet.position[0].copy()
        else:
            self.until(sent)
            position = self.fleet.position[0].copy()
        self.until(accepted)
        down = min(max(0.5 * (-2.5 - position[2]), -1.0), 1.0)
        forward, right, turn = command
        self.send([forward, right, down, turn])
        self.until(sent + hold_us // TICK_US)


COMMANDS = [
    [3.0, 0.0, 0.3],
    [2.0, 1.0, -0.8],
    [0.0, -1.5, 0.0],
    [4.0, 0.0, -0.4],
    [1.0, 0.5, 1.0],
    [-1.0, 0.0, 0.0],
]


@pytest.mark.parametrize("hover_ms", [None, 0.0, 60.0, 300.0, 10_000.0])
@pytest.mark.parametrize(
    ("native_ms", "link_ms"),
    [(0.0, 0.0), (1.0, 4.0), (118.7, 3.0), (250.0, 0.0), (333.0, 150.0), (58.0, 90.0)],
)
def test_setpoints_change_at_the_very_tick(
    native_ms: float, link_ms: float, hover_ms: float | None
) -> None:
    """t2 on the last setpoint, the link on top, the hold from when it was sent; and hover-after."""
    spec = spec_with(
        arena="no-obstacles",
        delay={"native_ms": native_ms, "link_ms": link_ms, "transport_ms": 5.0},
        episode={
            "hold_s": 0.4,
            "hover_after_s": None if hover_ms is None else hover_ms / 1000.0,
        },
    )
    navigation, hand = Navigation(spec, 1), ByHand("no-obstacles", 6)
    navigation.begin([0], [6])
    for command in COMMANDS:
        navigation.fly(np.array([command]))
        hand.decide(
            command,
            round(native_ms * 1000),
            round(link_ms * 1000),
            400_000,
            None if hover_ms is None else round(hover_ms * 1000),
        )
        truth, flights = navigation.truth(), navigation.flights()
        assert flights.time_s[0] == hand.tick * TICK_US / 1e6
        assert np.array_equal(truth.position, hand.fleet.position)
        assert np.array_equal(truth.velocity, hand.fleet.velocity)
        assert np.array_equal(truth.quaternion, hand.fleet.quaternion)
        assert flights.energy_j[0] == pytest.approx(hand.fleet.energy[0], rel=1e-12)
        assert flights.distance_m[0] == pytest.approx(hand.fleet.distance[0], rel=1e-12)
        assert flights.verdict[0] == FlightStatus.FLYING


def test_hovering_after_the_hold_costs_way_and_persisting_does_not() -> None:
    """A decision of one second: AirSim's semantics stop the vehicle, PX4's keep it going."""
    flown = {}
    for hover_s in (None, 0.06):
        spec = spec_with(
            arena="no-obstacles",
            delay={"native_ms": 1000.0},
            episode={"hold_s": 0.5, "hover_after_s": hover_s},
        )
        navigation = Navigation(spec, 1)
        navigation.begin([0], [1])
        for _ in range(6):
            navigation.fly(np.array([[3.0, 0.0, 0.0]]))
        flown[hover_s] = navigation.truth().position[0, 0]
    assert flown[None] == pytest.approx(3.0 * 8.0, abs=2.0)
    assert flown[0.06] < 0.6 * flown[None]


def draws_of(seed: int, n: int) -> list[int]:
    injection = choose_injection(load_computer("ras-pi-4"), "template-7x32")
    sampler = injection.sampler(np.random.default_rng(seed))
    assert sampler is not None
    return [sampler.sample_us() for _ in range(n)]


def taken(draws: DelayDraws, decision: np.ndarray) -> np.ndarray:
    """Return t2 (n,) of each slot's decision, counted from 0, one after the other."""
    draws.draw(decision)
    return draws.block[np.arange(len(decision)), decision % BLOCK]


def test_latencies_are_those_that_the_companion_draws() -> None:
    """... of every slot for itself, past the blocks they are drawn in, and after a new start."""
    injection = choose_injection(load_computer("ras-pi-4"), "template-7x32")
    draws = DelayDraws(3, [injection], 1000)
    decision = np.zeros(3, np.int64)
    found: list[list[int]] = [[], [], []]
    for i, seed in enumerate((4, 5, 6)):
        draws.begin(i, seed)
    for k in range(2 * BLOCK + 5):
        if k == 7:
            draws.begin(1, 8)
            decision[1], found[1] = 0, []
        for i, latency in enumerate(taken(draws, decision)):
            found[i].append(int(latency))
        decision += 1
    assert found[0] == draws_of(4, 2 * BLOCK + 5)
    assert found[1] == draws_of(8, 2 * BLOCK + 5 - 7)
    assert found[2] == draws_of(6, 2 * BLOCK + 5)
    assert len(set(found[0])) > 60


def test_a_flight_takes_the_drawn_latencies_and_the_holds() -> None:
    spec = spec_with(
        arena="no-obstacles",
        delay={"computer": "ras-pi-4", "workload": "template-7x32", "link_ms": 30.0},
    )
    navigation = Navigation(spec, 2)
    navigation.begin([0, 1], [21, 22])
    latencies = [draws_of(21, 40), draws_of(22, 40)]
    ends = [list(accumulate(rounded(t2) * TICK_US + 500_000 for t2 in each)) for each in latencies]
    for k in range(40):
        navigation.fly(np.zeros((2, 3)))
        assert navigation.flights().time_s.tolist() == [ends[0][k] / 1e6, ends[1][k] / 1e6]


class StillLink:
    """Flight controller of a vehicle at rest."""

    connected = True

    def kinematics(self) -> Kinematics:
        return Kinematics(np.array([0.0, 0.0, -2.5]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Stands."""

    def leave_offboard(self) -> None:
        """Stands."""

    def status(self) -> VehicleStatus:
        return VehicleStatus(armed=True, offboard=True, mode="offboard")

    def release(self) -> None:
        """Stands."""


class Eyes:
    """A camera that always has a new frame, at once."""

    def __init__(self, clock: SimClock) -> None:
        self._clock, self._sequence = clock, count()

    def latest(self) -> ReceivedFrame | None:
        lens = Intrinsics.from_fov(8, 6, 1.5)
        now_us = self._clock.time_us()
        frame = Frame(next(self._sequence), now_us, np.zeros((6, 8), np.uint16), lens)
        return ReceivedFrame(frame, now_us)

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        return self.latest()


TRACE = "lognormal:300ms,40ms"


@pytest.mark.parametrize("sources", [(TRACE,), (TRACE, "150ms", "workstation/template-5x32")])
def test_latencies_go_on_from_a_saved_state(sources: tuple[str, ...], tmp_path: Path) -> None:
    """Replayed traces remember where they are; in the middle of a block, and of an episode."""
    file = tmp_path / "trace.txt"
    file.write_text("\n".join(str(100 + k) for k in range(97)))
    injections = [parse_latency(source) for source in (*sources, str(file))]

    def fresh() -> DelayDraws:
        return DelayDraws(4, injections, 1000)

    first, second = fresh(), fresh()
    for i, seed in enumerate((3, 1, 4)):  # the fourth slot never begins
        first.begin(i, seed)
    decision = np.zeros(4, np.int64)
    for _ in range(BLOCK + 9):
        taken(first, decision)
        decision += 1
    second.set_state(first.get_state())
    for _ in range(3 * BLOCK):
        assert np.array_equal(taken(first, decision)[:3], taken(second, decision)[:3])
        decision += 1


def test_of_several_sources_each_episode_draws_one() -> None:
    draws = DelayDraws(300, [parse_latency("100ms"), parse_latency("200ms")], 1000)
    for i in range(300):
        draws.begin(i, 1_000_000 + i)
    first = taken(draws, np.zeros(300, np.int64))
    assert set(first.tolist()) == {100_000, 200_000}
    # 300 fair coins: five standard deviations.
    assert abs(np.count_nonzero(first == 100_000) - 150) < 5 * 8.7
    for k in range(1, 70):
        assert np.array_equal(taken(draws, np.full(300, k)), first)


def test_another_draw_is_another_sequence_of_the_same_distribution() -> None:
    injection = parse_latency(TRACE)
    found = []
    for draw in (0, 0, 1):
        draws = DelayDraws(1, [injection], 1000, draw=draw)
        draws.begin(0, 5)
        found.append([int(taken(draws, np.array([k]))[0]) for k in range(2000)])
    assert found[0] == found[1]
    assert not set(found[0][:20]) & set(found[2][:20])
    assert scipy.stats.ks_2samp(found[0], found[2]).pvalue > 1e-4


def test_one_arena_for_all_episodes() -> None:
    navigation = Navigation(spec_of(None, {"arena": "static-obstacles"}), 2, arena_seed=77)
    navigation.begin([0, 1], [1, 2])
    first, second = navigation.arenas
    assert first is not None and second is not None
    alone = Navigation(spec_with(arena="static-obstacles"), 1)
    alone.begin([0], [77])
    assert alone.arenas[0] is not None
    for arena in (first, second):
        assert np.array_equal(arena.goal, alone.arenas[0].goal)
        assert np.array_equal(arena.obstacles.center, alone.arenas[0].obstacles.center)
    # Random draws during the flight differ between episodes.
    truth, told = navigation.truth(), navigation.kinematics()
    assert np.array_equal(truth.position[0], truth.position[1])
    assert not np.array_equal(told.velocity[0], told.velocity[1])


def test_decides_when_the_pilot_decides() -> None:
    """The companion's own loop, on the same draws: only the rounding to ticks may differ."""
    clock, stop, n = SimClock(), threading.Event(), 30
    seen: list[Observation] = []

    class Decide:
        def act(self, observation: Observation) -> Action:
            seen.append(observation)
            if len(seen) == n:
                stop.set()
            return Action(0.0, 0.0, 0.0)

    injection = choose_injection(load_computer("ras-pi-4"), "template-5x32")
    link = StillLink()
    pilot = Pilot(
        *(link, Eyes(clock), Decide(), Watchdog(link, clock, WatchdogSettings()), clock),
        PilotSettings(hold_s=0.5),
        latency=injection.sampler(np.random.default_rng(3)),
    )
    pilot.fly((1000.0, 0.0), stop)
    starts = pilot.log.columns()["infer_start_us"]
    navigation = Navigation(
        spec_with(
            arena="no-obstacles",
            delay={"computer": "ras-pi-4", "workload": "template-5x32", "link_ms": 60.0},
        ),
        1,
    )
    navigation.begin([0], [3])
    assert len(starts) == n - 1
    for k, start in enumerate(starts):
        assert abs(navigation.flights().time_s[0] * 1e6 - start) <= k * TICK_US / 2
        navigation.fly(np.zeros((1, 3)))


@pytest.mark.parametrize(("transport_ms", "link_ms"), [(0.0, 0.0), (5.0, 4.0), (170.0, 90.0)])
def test_the_image_is_that_of_the_newest_decoded_frame(transport_ms: float, link_ms: float) -> None:
    """Frames at 30 Hz in any phase; rendered here from where the vehicle was when it was taken."""
    seed, transport_us = 9, round(transport_ms * 1000)
    spec = spec_with(
        arena="dynamic-obstacles",
        delay={"transport_ms": transport_ms, "link_ms": link_ms, "native_ms": 47.3},
    )
    navigation, hand = Navigation(spec, 1), ByHand("dynamic-obstacles", seed)
    navigation.begin([0], [seed])
    camera = QUAD.camera
    mount = Mount((camera.forward_m, 0.0, -camera.up_m), math.radians(camera.pitch_up_deg))

    def expected(tick: int) -> np.ndarray:
        position, quaternion = camera_pose(*hand.poses[tick], mount)
        centers = hand.arena.centers_at(tick * TICK_US)
        depth = render(
            hand.arena, centers, Intrinsics.of(camera), camera.range_m, position, quaternion
        )
        return depth_to_z16(depth)

    phase = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(11,))).random()
    first_us = -int(phase * PERIOD_US)
    assert np.array_equal(navigation.see().depth_mm[0], expected(0))
    ages = set()
    for command in COMMANDS:
        navigation.fly(np.array([command]))
        hand.decide(command, 47_300, round(link_ms * 1000), 500_000)
        now_us = hand.tick * TICK_US
        captured = [
            us for k in range(10_000) if (us := first_us + k * PERIOD_US) + transport_us <= now_us
        ]
        age = rounded(now_us - captured[-1])
        ages.add(age)
        image = expected(hand.tick - age)
        assert np.array_equal(navigation.see().depth_mm[0], image)
        # The comparison detects wrong ages: one tick changes the image.
        assert not np.array_equal(expected(hand.tick - age - 1), image)
    assert len(ages) > 1
    assert min(ages) >= transport_us // TICK_US
    assert max(ages) <= rounded(transport_us + PERIOD_US)


def test_observes_its_own_state_and_the_goal_in_the_heading_frame() -> None:
    navigation = Navigation(spec_with(arena="no-obstacles"), 1)
    navigation.begin([0], [5])
    for _ in range(4):
        navigation.fly(np.array([[2.0, 1.0, 0.5]]))
    truth, seen = navigation.truth(), navigation.see()
    arena = navigation.arenas[0]
    assert arena is not None
    w, x, y, z = truth.quaternion[0]
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert yaw == pytest.approx(1.0, abs=0.1)  # 0.5 rad/s, 2 s
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    assert seen.goal[0] == pytest.approx(turn @ (arena.goal - truth.position[0, :2]))
    assert seen.velocity[0, :2] == pytest.approx(turn @ truth.velocity[0, :2])
    encoded = navigation.observe()
    assert encoded["velocity"][0] == pytest.approx(seen.velocity[0] / 5.0)
    distance = float(np.hypot(*seen.goal[0]))
    assert encoded["goal"][0] == pytest.approx([*seen.goal[0] / distance, distance / 20.0])
    assert navigation.flights().goal_distance_m[0] == pytest.approx(distance)


def test_telemetry_carries_the_estimator_s_error() -> None:
    """Gauss-Markov, worked out here from the seed's numbers, past a block of them."""
    table = QUAD.estimation
    assert table is not None
    sd = np.array(
        [table.position_horizontal_m] * 2
        + [table.position_vertical_m]
        + [table.velocity_horizontal_m_s] * 2
        + [table.velocity_vertical_m_s]
    )
    time_s = np.array(
        [table.position_horizontal_time_s] * 2
        + [table.position_vertical_time_s]
        + [table.velocity_horizontal_time_s] * 2
        + [table.velocity_vertical_time_s]
    )
    spec = EnvironmentSpec(arena="no-obstacles", delay={"native_ms": 100.0})
    navigation = Navigation(spec, 2)
    navigation.begin([0, 1], [30, 31])
    for seed, slot in ((30, 0), (31, 1)):
        navigation.begin([0, 1], [30, 31])
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(12,)))
        normals = rng.standard_normal((100, 9))
        error = sd * normals[0, :6]
        for k in range(2 * BLOCK + 3):
            truth, told = navigation.truth(), navigation.kinematics()
            assert told.position[slot] - truth.position[slot] == pytest.approx(error[:3])
            assert told.velocity[slot] - truth.velocity[slot] == pytest.approx(error[3:6])
            assert np.array_equal(navigation.kinematics().quaternion, told.quaternion)
            navigation.fly(np.zeros((2, 3)))
            kept = np.exp(-0.6 / time_s)
            error = kept * error + sd * np.sqrt(1 - kept**2) * normals[k + 1, :6]
    turned = np.abs(told.quaternion - truth.quaternion).max()
    assert 0.0 < turned < 0.02


def test_the_held_altitude_is_the_one_that_telemetry_tells() -> None:
    """A barometer's error of a tenth of a metre is flown, as in the rehearsal."""
    navigation = Navigation(EnvironmentSpec(arena="no-obstacles"), 8)
    navigation.begin(range(8), range(8))
    for _ in range(25):
        navigation.fly(np.zeros((8, 3)))
    error = navigation.kinematics().position[:, 2] - navigation.truth().position[:, 2]
    height = -navigation.truth().position[:, 2]
    assert np.abs(error).max() > 0.05
    assert height == pytest.approx(2.5 + error, abs=0.03)


@pytest.mark.parametrize(
    ("without", "flies"),
    [
        (TRUE_STATE, True),
        ({"estimation": False}, False),
        # Decisions without drift of the errors compile separately.
        pytest.param({"estimation": False}, True, marks=pytest.mark.nightly),
    ],
)
def test_without_estimation_telemetry_is_the_truth(without: dict[str, object], flies: bool) -> None:
    navigation = Navigation(spec_with(arena="no-obstacles", randomisation=without), 2)
    navigation.begin([0, 1], [1, 2])
    if flies:
        navigation.fly(np.ones((2, 3)))
    truth, told = navigation.truth(), navigation.kinematics()
    assert np.array_equal(truth.position, told.position)
    assert np.array_equal(truth.velocity, told.velocity)
    assert np.array_equal(truth.quaternion, told.quaternion)


def test_what_it_returns_is_not_what_it_flies() -> None:
    """Write into returned arrays and check that the vehicle does not move."""
    navigation, other = (Navigation(spec_with(arena="no-obstacles"), 1) for _ in range(2))
    for each in (navigation, other):
        each.begin([0], [1])
        each.fly(np.ones((1, 3)))
    for array in (
        *(navigation.truth().position, navigation.kinematics().quaternion),
        *(navigation.flights().verdict, navigation.flights().energy_j),
        *navigation.observe().values(),
    ):
        array[...] = 7
    for each in (navigation, other):
        each.fly(np.ones((1, 3)))
    assert np.array_equal(navigation.truth().position, other.truth().position)
    assert np.array_equal(navigation.observe()["depth"], other.observe()["depth"])


def test_an_ended_flight_stays_as_it_ended() -> None:
    navigation = Navigation(spec_with(episode={"time_limit_s": 1.2}), 1)
    navigation.begin([0], [4])
    for _ in range(5):
        navigation.fly(np.array([[2.0, 0.0, 0.0]]))
    flights, where = navigation.flights(), navigation.truth().position
    assert flights.verdict[0] == FlightStatus.TIMEOUT
    assert flights.time_s[0] == 1.2
    navigation.fly(np.array([[2.0, 0.0, 0.0]]))
    assert np.array_equal(navigation.truth().position, where)
    assert navigation.flights().time_s[0] == 1.2


@pytest.mark.parametrize(("mass", "sag_m"), [(0.0, 1e-3), (0.15, 0.5)])
def test_begins_in_a_hover_that_stays_where_it_is(mass: float, sag_m: float) -> None:
    """Check that the vehicle does not drift without a command; another mass sags and recovers."""
    spec = spec_with(
        arena="no-obstacles", randomisation={"mass": mass, "thrust": mass, **TRUE_STATE}
    )
    navigation = Navigation(spec, 6)
    navigation.begin(range(6), range(6))
    assert np.array_equal(navigation.truth().quaternion, np.tile([1.0, 0.0, 0.0, 0.0], (6, 1)))
    for _ in range(30):
        navigation.fly(np.zeros((6, 3)))
        off = navigation.truth().position - [0.0, 0.0, -2.5]
        assert np.abs(off[:, :2]).max() < 1e-3
        assert np.abs(off[:, 2]).max() < sag_m
    assert np.abs(off[:, 2]).max() < 0.05


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"episode": {"hold_s": 0.04}}, "accepted: value >= 0.042333 s"),
        ({"delay": {"link_ms": 480.0}}, "accepted: value >= 0.518333 s"),
        ({"delay": {"transport_ms": 463.0}}, "accepted: value >= 0.500333 s"),
    ],
)
def test_a_hold_must_leave_time_for_setpoint_and_frame(
    knobs: dict[str, object], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        Navigation(spec_with(**knobs), 1)


def test_zones_and_seeds_are_checked() -> None:
    navigation = Navigation(spec_with(), 2)
    with pytest.raises(UsageError, match="zone 3: accepted: 0 <= value <= 2"):
        navigation.begin([0], [1], 3)
    with pytest.raises(UsageError, match="seed = -1"):
        navigation.begin([0], [-1])


def test_states_of_the_decisions_before_are_kept_with_their_images() -> None:
    """Check each vehicle's states since its episode began, as reported with estimation errors."""
    knobs = {"arena": "static-obstacles", "frames": 3, "layout": "scan"}
    navigation = Navigation(spec_of(None, {**knobs, "randomisation": {"estimation": True}}), 2)
    navigation.begin([0, 1], [3, 4])
    told: list[tuple[np.ndarray, Kinematics]] = []
    for _ in range(4):
        seen = navigation.see()
        told.insert(0, (seen.image.copy(), seen.states[0]))
        for k, (image, state) in enumerate(told[1:3]):
            np.testing.assert_array_equal(seen.earlier[k], image)
            np.testing.assert_array_equal(seen.states[k + 1].position, state.position)
            np.testing.assert_array_equal(seen.states[k + 1].quaternion, state.quaternion)
        assert len(seen.states) == 3
        navigation.fly(np.tile([2.0, 0.0, 0.3], (2, 1)))
    navigation.begin([1], [9])
    seen = navigation.see()
    assert not seen.earlier[0][1].any()
    assert seen.earlier[0][0].any()


def test_nothing_moves_before_the_first_episode() -> None:
    """There is no arena yet: a kernel that moved obstacles would write beyond its arrays."""
    navigation = Navigation(EnvironmentSpec(arena="dynamic-obstacles"), 50)
    assert len(navigation.whole_truth().arenas.center) == 0
