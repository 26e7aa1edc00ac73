"""Faults in the vectorized simulator: against the plant, in lockstep, and closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.decision import frame_age_us
from airl_mav.envs.draws import Winds
from airl_mav.envs.evaluation import Trace
from airl_mav.envs.faults import gusts, gym_faults
from airl_mav.envs.fleet import hover, new_fleet
from airl_mav.envs.fleet_step import advance
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import spec_of
from airl_mav.experiments.gym_flier import GymFlier
from airl_mav.faults import Fault, check_gym
from airl_mav.profiles.vehicle import WindSettings
from airl_mav.rehearsal.run_folder import RunFolder
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.addons.fault_injection.failing_parts import gust_at
from firmware_sim.fault_timeline import Acting
from tests.learning.test_fleet import ENDLESS, OPEN, VEHICLE, PlantPilot, command
from tests.support.blown import fly_blown

FORWARD = np.array([[2.0, 0.0, 0.3]])
PERIOD_US = 33_333


def fault(words: str) -> Fault:
    return Fault.model_validate(words)


def navigation(*faults: str, trace: Trace | None = None, n: int = 1, **knobs: object) -> Navigation:
    spec = spec_of(
        None, {"arena": "static-obstacles", "randomisation": {"navigation_noise": 0.0}, **knobs}
    )
    return Navigation(spec, n, trace=trace, faults=[fault(words) for words in faults])


def test_twin_and_plant_fly_through_the_same_gust() -> None:
    asked = [fault("wind gust 4,-3,1m/s at offboard+1s for 2s"), fault("wind step 0,2,0m/s")]
    natural = WindSettings(north_m_s=-1.0, gust_m_s=1.0)
    acting = [
        Acting(0, asked[0], US_PER_S, 3 * US_PER_S),
        Acting(1, asked[1], 0, 1 << 62),
    ]
    pilot = PlantPilot(60.0, seed=3, aircraft=Aircraft(wind=natural))
    blowing = pilot.plant.wind

    class Gusty:
        def step(self) -> np.ndarray:
            now = [each for each in acting if each.since_us <= pilot.time_us < each.until_us]
            return blowing.step() + gust_at(now, pilot.time_us)

    pilot.plant.wind = Gusty()
    fleet, arenas, winds = new_fleet(1), batch_of([OPEN]), Winds(1, natural, asked)
    assert winds.begin(0, 3).tolist() == [-1.0, 2.0, 0.0]
    hover(fleet, 0, 60.0, VEHICLE)

    for setpoint in np.random.default_rng(1).uniform(-2, 2, (5, 4)):
        command(fleet, 0, setpoint)
        pilot.fly(setpoint, 250)
        fly_blown(
            winds, fleet, 250, lambda n: advance(fleet, arenas, n, VEHICLE, ENDLESS, winds.air)
        )
    assert np.abs(fleet.position[0] - pilot.plant.truth().position).max() < 1e-6
    pilot.plant.close()


def test_a_gust_rises_and_falls_as_one_minus_the_cosine() -> None:
    (gust,) = gym_faults([fault("wind gust 6,0,0m/s at offboard+1s for 4s")], "wind")
    north = gusts([gust], 0, 1500)[:, 0]
    time_s = TICK_US / US_PER_S * np.arange(1500)
    inside = (time_s >= 1.0) & (time_s < 5.0)
    expected = np.where(inside, 3.0 * (1.0 - np.cos(2.0 * np.pi * (time_s - 1.0) / 4.0)), 0.0)
    np.testing.assert_allclose(north, expected, atol=1e-9)


@pytest.mark.parametrize("words", ["at offboard+1s for 1s", "at offboard+700ms", ""])
def test_late_frames_come_in_order(words: str) -> None:
    """Check that frames never overtake, as with `failing_parts.FailingCamera`."""
    cameras = navigation(f"camera delay 250ms {words}").cameras
    cameras.begin(0, 5)
    failing = cameras._late[0]
    captures = int(cameras._first_us[0]) + PERIOD_US * np.arange(-60, 120)
    arrivals = captures + cameras.times.transport_us + np.where(failing.at(captures), 250_000, 0)
    arrivals = np.maximum.accumulate(arrivals)
    ages = set()
    for now_us in range(0, 3 * US_PER_S, 7 * TICK_US):
        newest = captures[arrivals <= now_us].max()
        age_us = frame_age_us(cameras.times, 0, now_us)
        assert age_us == now_us - newest
        ages.add(age_us // 100_000)
    assert max(ages) >= 2


def test_a_late_frame_is_stamped_late_and_shows_what_was() -> None:
    trace, plain = Trace(1), Trace(1)
    for flown, *faults in ((trace, "camera delay 200ms at offboard+1s"), (plain,)):
        twin = navigation(*faults, trace=flown)
        twin.begin([0], [4])
        for _ in range(5):
            twin.fly(FORWARD)
    late, usual = trace.latency(0), plain.latency(0)
    took = (late["decoded_us"] - late["capture_us"])[1:]  # the frame of the start is there at once
    assert set(np.diff(np.unique(took))) == {200_000}
    later = (
        late["infer_start_us"]
        - late["capture_us"]
        - (usual["infer_start_us"] - usual["capture_us"])
    )
    assert later[-1] == pytest.approx(200_000, abs=PERIOD_US)
    assert np.array_equal(late["sent_us"], usual["sent_us"])


def test_a_stuck_camera_shows_the_first_frame_of_the_fault() -> None:
    words = "camera stuck at offboard+1s for 1500ms"
    trace = Trace(1)
    twin, twin_too = navigation(words, trace=trace), navigation()
    pictures: list[np.ndarray] = []
    healthy: list[np.ndarray] = []
    times = []
    for each in (twin, twin_too):
        each.begin([0], [4])
    for _ in range(8):
        for each, seen in ((twin, pictures), (twin_too, healthy)):
            each.fly(FORWARD)
            seen.append(each.cameras.image[0].copy())
        times.append(int(twin._decision.seen.time_us[0]))
    stuck = [1_000_000 <= time_us < 2_500_000 for time_us in times]
    frozen = twin.cameras._frozen[0][0]
    taken_us = twin.cameras._freeze_us[0][0]
    assert 1_000_000 <= taken_us < 1_000_000 + PERIOD_US
    for picture, usual, held in zip(pictures, healthy, stuck, strict=True):
        assert np.array_equal(picture, frozen if held else usual)
        assert held == (not np.array_equal(picture, usual))
    assert 2 <= sum(stuck) < 6


def test_a_noisy_camera_is_as_noisy_as_asked_and_the_same_again() -> None:
    images = []
    for words in ((), ("camera noise 20%",), ("camera noise 20%",)):
        twin = navigation(*words)
        twin.begin([0], [4])
        twin.fly(FORWARD)
        images.append(twin.cameras.image[0].astype(float))
    plain, noisy, again = images
    assert np.array_equal(noisy, again)
    seen = plain > 0
    sd = np.std((noisy - plain)[seen] / (0.2 * plain[seen] ** 2 / 10_000.0))
    assert sd == pytest.approx(1.0, abs=0.1)


def test_setpoints_arrive_later_over_a_slow_uplink() -> None:
    trace = Trace(1)
    twin = navigation("uplink delay 120ms at offboard+1s for 2s", trace=trace)
    twin.begin([0], [4])
    for _ in range(8):
        twin.fly(FORWARD)
    stamps = trace.latency(0)
    sent, took = stamps["sent_us"], stamps["motor_us"] - stamps["sent_us"]
    slow = (sent >= US_PER_S) & (sent < 3 * US_PER_S)
    assert slow.any() and not slow.all()
    assert set(took[slow] - took[~slow][0]) == {120_000}
    assert len(set(took[~slow])) == 1
    # The very motion, too: nothing of the new setpoint before it arrives.
    path = trace.trajectory(0)
    assert len(path.time_us) > 100


@pytest.mark.parametrize(
    ("words", "accepted"),
    [
        ("gps off at offboard", "at level lockstep or sitl"),
        ("motor1 weak 50% at offboard", "at level lockstep or sitl"),
        ("camera off at offboard", "at level lockstep or sitl"),
        ("link delay 100ms at offboard", "at level lockstep or sitl"),
        ("wind step 3,0,0m/s at 8s", "at offboard, or offboard[+]TIME"),
        ("wind step 3,0,0m/s at hold", "at offboard, or offboard[+]TIME"),
        ("wind step 3,0,0m/s for 8s", "at offboard, or offboard[+]TIME"),
        ("camera stuck", "at offboard, or offboard[+]TIME"),
        ("firmware stopped", "at level sitl"),
    ],
)
def test_what_the_twin_cannot_fly_is_refused(words: str, accepted: str) -> None:
    with pytest.raises(FieldError, match=accepted):
        resolve(Scenario.model_validate({"level": "gym", "faults": [words]}))


def test_delays_that_no_decision_of_the_twin_waits_for_are_refused() -> None:
    late = [fault("camera delay 100ms at offboard")]
    with pytest.raises(FieldError, match="with decisions sequential"):
        check_gym(late, pipelined=True)
    with pytest.raises(FieldError, match="one delay of the camera"):
        check_gym(late * 2)
    with pytest.raises(UsageError, match="what faults delay"):
        navigation("camera delay 600ms at offboard")


def test_a_run_of_the_twin_tells_its_faults(tmp_path: Path) -> None:
    words = ("wind gust 5,0,0m/s at offboard+500ms for 1s", "camera noise 10%")
    asked = resolve(
        Scenario.model_validate(
            {"level": "gym", "episodes": 2, "slots": 2, "faults": words, "time_limit_s": 5.0}
        )
    )
    fly = GymFlier(asked).start(RunFolder(tmp_path), lambda: False)
    for flown in fly(asked.left()):
        told = [(each.fault, each.from_us, each.to_us) for each in flown.record.faults]
        assert told[0] == ("camera noise 0.1", 0, flown.record.ended_us)
        assert told[1] == (words[0].replace("500ms", "0.5s"), 500_000, 1_500_000)
