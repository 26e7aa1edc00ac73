"""One episode in one process among thousands: repeatable to the last bit, and nothing is left."""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.files import save_arrays
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import WindSettings
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.interfaces import ActuatorControls, SensorSample
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import Rig, flight, quad, velocity_setpoint

GUSTY = WindSettings(north_m_s=1.0, gust_m_s=1.0)


def arena(name: str, seed: int = 3) -> Arena:
    spec = load_profile("arenas", name, ArenaSpec)
    return generate(spec, seed, name=name, vehicle_width_m=quad().body.width_m)


def add(digest: Any, values: Any) -> None:
    """Take in every bit of numbers, arrays and tuples of them."""
    if isinstance(values, tuple):
        for value in values:
            add(digest, value)
    elif isinstance(values, np.ndarray):
        digest.update(values.tobytes())
    else:
        digest.update(repr(values).encode())


def digest_of_a_flight(seed: int) -> str:
    """Take off among moving obstacles in gusts, fly into something; digest all there is."""
    digest = hashlib.sha256()
    rig = Rig(seed, arena=arena("crowded"), wind=GUSTY)
    step = rig.ap.step

    def noted(sample: SensorSample) -> ActuatorControls:
        add(digest, sample)
        controls = step(sample)
        add(digest, controls)
        return controls

    rig.step_through(noted)
    frames: list[Frame] = []
    rig.take_off(2.5, settle_s=0.0)
    rig.go_offboard(velocity_setpoint(5.0, 1.0, 0.0))
    rig.run(12.0, lambda: rig.sim.capture_due(rig.sim.time_us, frames.append))
    assert rig.sim.plant.collisions, "the walls are 50 m apart"
    add(digest, tuple(rig.sim.plant.collisions))
    add(digest, rig.truth)
    for name, values in sorted(rig.sim.arrays().items()):
        add(digest, (name, values))
    for frame in frames:
        digest.update(frame.to_bytes())
    assert len(frames) > 100
    rig.close()
    return digest.hexdigest()


@pytest.mark.nightly
def test_a_seed_is_a_flight_whatever_else_was_flown_before() -> None:
    first = digest_of_a_flight(5)
    others = [Rig(seed, arena=arena("dynamic-obstacles")) for seed in range(4)]
    for i, other in enumerate(others):
        other.run(0.1 * (i + 1))
    others[1].close()
    others[2].close()
    assert digest_of_a_flight(6) != first
    assert digest_of_a_flight(5) == first  # between worlds that are still open
    for other in (others[0], others[3]):
        other.run(0.1)
        other.close()
    assert digest_of_a_flight(5) == first


@pytest.mark.nightly
def test_a_seed_is_a_flight_in_every_process() -> None:
    code = "from tests.firmware import test_simulation as t; print(t.digest_of_a_flight(5))"
    root = Path(__file__).parents[2]
    # Another order of sets and dictionaries of strings than in this process, for all we know.
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": f"{root}", "PYTHONHASHSEED": "1"},
        stdout=subprocess.PIPE,
        check=True,
    )
    assert run.stdout.decode().split()[-1] == digest_of_a_flight(5)


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts by /proc")
def test_fifteen_episodes_leave_nothing_behind() -> None:
    place = arena("crowded")

    def episode(seed: int) -> None:
        simulation = Simulation(EpisodeSetup(quad(), place, seed), start_us=0, clock=SimClock())
        for _ in range(100):
            simulation.tick()
            simulation.capture_due(simulation.time_us, lambda _: None)
        simulation.arrays()
        simulation.close()
        # Otherwise uncollected garbage decides the size of the process.
        del simulation
        gc.collect()

    def held() -> tuple[int, int, int]:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        kib = pages * os.sysconf("SC_PAGE_SIZE") // 1024
        fds, threads = (len(list(Path(f"/proc/self/{of}").iterdir())) for of in ("fd", "task"))
        return fds, threads, kib

    for seed in range(8):
        episode(seed)
    fds, threads, kib = held()
    for seed in range(15):
        episode(seed)
    after = held()
    assert after[:2] == (fds, threads)
    assert after[2] - kib < 3000  # a physics server has 28 MB


# --- what is recorded


def test_the_file_has_the_arrays(tmp_path: Path) -> None:
    rig = Rig(1)
    rig.take_off(2.5, settle_s=0.0)
    rig.go_offboard(velocity_setpoint(1.0, 0.0, 0.0))
    rig.run(1.0)
    arrays = rig.sim.arrays()
    save_arrays(tmp_path / "episode.npz", arrays)
    rig.close()
    with np.load(tmp_path / "episode.npz") as file:
        assert set(file.files) == set(arrays)
        for name, values in arrays.items():
            assert file[name].dtype == values.dtype
            np.testing.assert_array_equal(file[name], values)
    n = len(arrays["setpoints/accepted_us"])
    assert n == 20  # at 20 Hz, the first at once; the last has not reached the motors
    assert arrays["setpoints/setpoint"].shape == (n, 4)


def test_what_is_recorded_is_what_was() -> None:
    """Truth and estimate at 50 Hz; all the energy that was drawn, to the last tick."""
    rig = Rig(2)
    energy, truths, estimates = [], {}, {}

    def look() -> None:
        energy.append(rig.truth.power_w)
        truths[rig.sim.time_us] = rig.truth
        if rig.ap.estimator.aligned:  # the tick after the last sample at rest begins with that
            estimate = rig.ap.state().estimate
            estimates[estimate.time_us] = estimate

    rig.run(3.0, look)
    rig.arm()
    rig.ap.takeoff(2.5)
    begun = rig.sim.time_us
    rig.run(5.0, look)
    arrays = rig.sim.arrays()
    rig.close()
    flown = Trajectory.from_arrays(
        {k.split("/")[1]: v for k, v in arrays.items() if k.startswith("trajectory/")}
    )
    assert set(np.diff(flown.time_us)) == {20_000}
    seen = [i for i, t in enumerate(flown.time_us) if t in truths]
    assert len(seen) > 350
    for i in seen:
        truth = truths[flown.time_us[i]]
        np.testing.assert_array_equal(flown.position[i], truth.position)
        np.testing.assert_array_equal(flown.velocity[i], truth.velocity)
        np.testing.assert_array_equal(flown.quaternion[i], truth.quaternion)
    # Whole samples after the take-off's first: each is the mean over its five ticks.
    ticks = np.array([truths[t].power_w for t in sorted(truths) if t > begun])
    first = int(np.searchsorted(flown.time_us, begun, side="right"))
    skip = int(flown.time_us[first] - begun) // TICK_US
    means = ticks[skip : skip + (len(ticks) - skip) // 5 * 5].reshape(-1, 5).mean(axis=1)
    np.testing.assert_allclose(flown.power_w[first + 1 :], means, rtol=1e-12)
    assert np.ptp(means) > 50.0
    found = [i for i, t in enumerate(arrays["estimate/time_us"]) if t in estimates]
    assert len(found) > 350
    for i in found:
        estimate = estimates[arrays["estimate/time_us"][i]]
        np.testing.assert_array_equal(arrays["estimate/position"][i], estimate.position)
        np.testing.assert_array_equal(arrays["estimate/velocity"][i], estimate.velocity)
        np.testing.assert_array_equal(arrays["estimate/quaternion"][i], estimate.quaternion)


def test_on_the_ground_a_setpoint_is_taken_in_the_tick_after_it() -> None:
    clock = SimClock()
    simulation = Simulation(EpisodeSetup(quad(), None, 1), start_us=0, clock=clock)
    autopilot = simulation.autopilot
    assert isinstance(autopilot, BuiltinAutopilot)
    for i in range(6):
        if i in (1, 3):
            setpoint = velocity_setpoint(float(i), 0.0, 0.0)._replace(wire=(i, 0.0, 0.0, 0.0))
            autopilot.offer_setpoint(setpoint, clock.time_us())
            autopilot.offer_setpoint(setpoint, clock.time_us() + 1)
        clock.advance(TICK_US)
        simulation.tick()
    autopilot.offer_setpoint(velocity_setpoint(9.0, 0.0, 0.0), clock.time_us())
    arrays = simulation.arrays()
    simulation.close()
    assert arrays["setpoints/accepted_us"].tolist() == [4000, 4001, 12_000, 12_001]
    assert arrays["setpoints/motor_us"].tolist() == [8000, 8000, 16_000, 16_000]
    assert arrays["setpoints/setpoint"][:, 0].tolist() == [1, 1, 3, 3]


@pytest.mark.parametrize("ticks", [100, 101])
def test_in_flight_a_setpoint_is_stamped_when_the_motors_first_differ(ticks: int) -> None:
    """Against the same flight without it: whichever of two ticks the position loop runs in."""
    motors: list[list[tuple[float, float, float, float]]] = []
    flown: list[int] = []
    for north in (0.0, 2.0):
        with flight(3) as rig:
            rig.take_off(4.0, settle_s=1.0)
            rig.go_offboard(velocity_setpoint(0.0, 0.0, 0.0))
            rig.stream(None)
            for _ in range(ticks):
                rig.tick()
            recorder = rig.sim.recorder
            assert recorder is not None
            before = len(recorder.setpoints.arrays()["motor_us"])
            rig.ap.offer_setpoint(velocity_setpoint(north, 0.0, 0.0), rig.sim.time_us)
            rows, pending = [], []
            for _ in range(10):
                rig.tick()
                rows.append(rig.ap.state().motors)
                pending.append(len(recorder.setpoints.arrays()["motor_us"]) == before)
            motors.append(rows)
            flown.append(pending.index(False))
    differ = [a != b for a, b in zip(*motors, strict=True)].index(True)
    assert differ in (2, 3)
    assert flown == [differ, differ]


# --- camera


@pytest.mark.parametrize("start_us", [0, 1_000_000_000 + 3 * TICK_US])
def test_frames_are_taken_at_the_camera_s_rate(start_us: int) -> None:
    place = arena("static-obstacles")
    vehicle = quad()
    rate_hz = vehicle.camera.rate_hz
    simulation = Simulation(EpisodeSetup(vehicle, place, 1), start_us=start_us, clock=SimClock())
    frames: list[Frame] = []
    for _ in range(2 * US_PER_S // TICK_US):
        simulation.capture_due(simulation.time_us, frames.append)
        simulation.capture_due(simulation.time_us, frames.append)  # never twice
        simulation.tick()
    simulation.close()
    times = np.array([frame.capture_time_us for frame in frames]) - start_us
    periods = np.arange(round(2.0 * rate_hz)) * US_PER_S / rate_hz
    np.testing.assert_array_equal(times, np.ceil(periods / TICK_US) * TICK_US)
    assert [frame.sequence for frame in frames] == list(range(len(frames)))


def test_an_endless_floor_has_no_camera() -> None:
    simulation = Simulation(EpisodeSetup(quad(), None, 1), start_us=0, clock=SimClock())
    for _ in range(100):
        simulation.tick()
        simulation.capture_due(simulation.time_us, lambda _: pytest.fail("a frame of nothing"))
    simulation.close()
