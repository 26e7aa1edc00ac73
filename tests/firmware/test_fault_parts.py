"""Failing sensors, motors, batteries, wind, camera and links, in simulated time."""

from __future__ import annotations

import gc
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from airl_mav.camera.frame import Frame
from airl_mav.core.clock import SimClock
from airl_mav.core.frames import HOME, geodetic_to_local
from airl_mav.faults import Fault
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.addons.fault_injection.failing_link import FailingEndpoint
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.commander import CommanderState
from firmware_sim.fault_timeline import FaultTimeline
from firmware_sim.interfaces import ActuatorControls, SensorSample
from firmware_sim.mavlink.codec import Encoder, dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import flight, quad


class Witness:
    """Flies nothing, and keeps what it is given. Implements `FlightController`."""

    rate_hz = 250
    internals = None
    body_by = None

    def __init__(self, motor: float = 0.0) -> None:
        self.on_message: Callable[[OperatorText], None] | None = None
        self.flight = CommanderState()
        self.samples: list[SensorSample] = []
        self.motors = (motor, motor, motor, motor)

    def step(self, sample: SensorSample) -> ActuatorControls:
        self.samples.append(sample)
        return ActuatorControls(sample.time_us, self.motors, armed=True)

    def use_truth(self, truth: Any) -> None:
        pass

    def close(self) -> None:
        pass


def witnessed(
    *faults: str, seconds: float = 3.0, motors: float = 0.0, seed: int = 1
) -> tuple[list[SensorSample], Simulation]:
    """Return what a flight controller is given, on the ground, and the simulation."""
    witness = Witness(motors)
    setup = EpisodeSetup(quad(), None, seed, Aircraft.model_validate({"faults": faults}))
    simulation = Simulation(setup, start_us=0, clock=SimClock(), autopilot=witness)
    for _ in range(round(250 * seconds)):
        simulation.tick()
    simulation.close()
    return witness.samples, simulation


def between(samples: list[SensorSample], name: str, begin_s: float, end_s: float) -> list[Any]:
    return [
        getattr(sample, name)
        for sample in samples
        if begin_s <= sample.time_us / 1e6 < end_s and getattr(sample, name) is not None
    ]


HEALTHY, _ = witnessed()


@pytest.mark.parametrize(
    ("part", "name"), [("mag", "mag"), ("baro", "pressure_hpa"), ("gps", "gps")]
)
def test_a_sensor_that_is_off_measures_nothing_and_comes_back(part: str, name: str) -> None:
    samples, simulation = witnessed(f"{part} off at 1s for 1s")
    assert between(samples, name, 1.0, 2.0) == []
    for begin_s in (0.0, 2.0):
        now = between(samples, name, begin_s, begin_s + 1.0)
        assert len(now) == len(between(HEALTHY, name, begin_s, begin_s + 1.0)) > 0
    # The others measure what they always do: faults draw from streams of their own.
    assert all(np.array_equal(a.gyro, b.gyro) for a, b in zip(samples, HEALTHY, strict=True))
    assert simulation.faults is not None
    assert [(a.from_us, a.to_us) for a in simulation.faults.acted(simulation.time_us)] == [
        (1_000_000, 2_000_000)
    ]


@pytest.mark.parametrize("kind", ["off", "stuck"])
@pytest.mark.parametrize("name", ["accel", "gyro"])
def test_an_inertial_sensor_repeats_its_last_sample(name: str, kind: str) -> None:
    samples, _ = witnessed(f"{name} {kind} at 1s for 1s")
    during = between(samples, name, 1.0, 2.0)
    assert len(during) == 250
    assert all(np.array_equal(value, during[0]) for value in during)
    assert not np.array_equal(between(samples, name, 2.0, 3.0)[0], during[0])


@pytest.mark.parametrize(
    ("part", "name"), [("mag", "mag"), ("baro", "pressure_hpa"), ("gps", "gps")]
)
def test_a_slow_sensor_that_is_stuck_keeps_its_rate(part: str, name: str) -> None:
    samples, _ = witnessed(f"{part} stuck at 1s")
    during = between(samples, name, 1.0, 3.0)
    assert len(during) == len(between(HEALTHY, name, 1.0, 3.0))
    assert all(value is during[0] for value in during)


@pytest.mark.parametrize("part", ["accel", "gyro", "mag", "baro"])
def test_noise_is_that_many_times_the_sensor_s_own(part: str) -> None:
    name = {"baro": "pressure_hpa"}.get(part, part)
    samples, _ = witnessed(f"{part} noise 4x at 1s")
    now = np.std(np.diff(between(samples, name, 1.0, 3.0), axis=0))
    own = np.std(np.diff(between(HEALTHY, name, 1.0, 3.0), axis=0))
    assert 3.0 < now / own < 5.0


def north_m(fixes: list[Any]) -> np.ndarray:
    return np.array([geodetic_to_local(fix.position, HOME)[0] for fix in fixes])


def test_biases_are_added() -> None:
    samples, _ = witnessed("baro bias 2hPa at 1s", "gyro bias 1,0,0rad/s at 1s")
    for name, offset in (("pressure_hpa", 2.0), ("gyro", (1.0, 0.0, 0.0))):
        now, own = between(samples, name, 1.0, 2.0), between(HEALTHY, name, 1.0, 2.0)
        np.testing.assert_allclose(np.subtract(now, own), np.broadcast_to(offset, np.shape(now)))


def test_a_position_jumps_or_drifts() -> None:
    samples, _ = witnessed("gps bias 20,0,0m at 1s for 500ms", "gps drift 2,0,0m/s at 2s")
    own = north_m(between(HEALTHY, "gps", 0.0, 3.0))
    moved = north_m(between(samples, "gps", 0.0, 3.0)) - own
    times = np.array([s.time_us / 1e6 for s in HEALTHY if s.gps is not None])
    expected = np.where((times >= 1.0) & (times < 1.5), 20.0, np.maximum(0.0, 2.0 * (times - 2.0)))
    np.testing.assert_allclose(moved, expected, atol=1e-3)


def test_samples_come_late() -> None:
    samples, _ = witnessed("gps delay 300ms at 1s", "gyro delay 40ms at 1s")
    late = [s.time_us for s in samples if s.gps is not None and s.time_us >= 1_300_000]
    assert late[0] == 1_300_000
    fixes = {id(s.gps): s.time_us for s in samples if s.gps is not None}
    assert len(fixes) == len([s for s in HEALTHY if s.gps is not None]) - 3
    for index in range(300, 700):
        np.testing.assert_array_equal(samples[index].gyro, HEALTHY[index - 10].gyro)


def test_the_same_seed_fails_the_same_way_and_another_does_not() -> None:
    one, other = ([s.gyro for s in witnessed("gyro noise 9x", seconds=0.5)[0]] for _ in range(2))
    np.testing.assert_array_equal(one, other)
    third = [s.gyro for s in witnessed("gyro noise 9x", seconds=0.5, seed=2)[0]]
    assert not np.array_equal(one, third)


# --- motors, battery, wind


def test_a_motor_that_is_off_or_weak_gives_less_thrust() -> None:
    """Weak by half on all four is half the force on the body."""
    forces = []
    for faults in ((), tuple(f"motor{n} weak 50%" for n in (1, 2, 3, 4))):
        samples, _ = witnessed(*faults, seconds=1.0, motors=1.0)
        forces.append(-np.mean([s.accel[2] for s in samples[100:150]]))
    assert forces[1] / forces[0] == pytest.approx(0.5, abs=0.06)


def test_a_motor_that_stops_rolls_the_vehicle_over() -> None:
    with flight(faults=("motor1 off at hold",)) as rig:
        rig.arm()
        rig.ap.takeoff(3.0)
        rig.run(10.0)
        assert any(hit.speed_m_s > 2.0 for hit in rig.sim.plant.collisions)


def test_a_battery_drops_sags_or_reads_empty() -> None:
    samples, simulation = witnessed("battery drop 40% at 1s", "battery sag 0.5V at 2s")
    assert simulation.plant.battery_remaining == pytest.approx(0.6, abs=0.01)
    cells = quad().battery.cells
    before, sagging = samples[499].battery.voltage_v, samples[501].battery.voltage_v
    assert before - sagging == pytest.approx(0.5 * cells, abs=1e-3)
    samples, simulation = witnessed("battery off at 1s for 1s")
    assert samples[300].battery.remaining == 0.0
    assert samples[600].battery.remaining > 0.9
    assert simulation.plant.battery_remaining > 0.9


def test_a_gust_pushes_and_ends() -> None:
    north: list[float] = []
    with flight(faults=("wind gust 10,0,0m/s at hold+1s for 2s",)) as rig:
        rig.take_off(settle_s=0.0)
        rig.run(7.0, lambda: north.append(rig.truth.position.item(0)))
    assert max(north) > 0.3
    assert abs(north[-1]) < 0.5 * max(north)


# --- a run-time injection goes the same way


def test_an_injected_fault_acts_from_now_on_until_it_is_cleared() -> None:
    timeline = FaultTimeline((), 1, 0)
    timeline.update(5_000_000, CommanderState())
    timeline.inject(Fault.model_validate("gps off"))
    assert [each.fault.part for each in timeline.acting("gps")] == ["gps"]
    timeline.update(7_000_000, CommanderState())
    timeline.clear("gps")
    assert timeline.acting("gps") == []
    assert [(a.fault, a.from_us, a.to_us) for a in timeline.acted(9_000_000)] == [
        ("gps off at 5s for 2s", 5_000_000, 7_000_000)
    ]


# --- the link

SETPOINT = dialect.MAVLink_set_position_target_local_ned_message
HEARTBEAT = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def link_of(*faults: str, conducted: bool = False) -> tuple[FailingEndpoint, Any, Any]:
    """Return a failing link, its healthy endpoint, and a function that sets the time [µs]."""
    inner, clock = MemoryEndpoint(), SimClock()
    endpoint = FailingEndpoint(inner, clock, conducted=conducted)
    timeline = FaultTimeline([Fault.model_validate(text) for text in faults], 1, 0)
    endpoint.begin(timeline)

    def at(time_us: int) -> None:
        clock.sleep_until(time_us)
        timeline.update(time_us, CommanderState())

    return endpoint, inner, at


def test_a_delayed_link_keeps_order_in_both_directions() -> None:
    endpoint, inner, at = link_of("uplink delay 100ms at 0s", "downlink delay 40ms at 0s")
    for tick in range(50):
        at(4000 * tick)
        inner.inbox.append(b"up%d" % tick)
        expected = [b"up%d" % (tick - 25)] if tick >= 25 else []
        assert endpoint.receive() == expected
        endpoint.send_streams([b"down%d" % tick])
    assert inner.take() == [b"down%d" % tick for tick in range(40)]


def test_a_client_that_is_gone_is_forgotten_and_its_lane_is_nobody_else_s() -> None:
    endpoint, inner, at = link_of("downlink loss 50% at 0s")
    at(0)

    def heard() -> list[bytes]:
        """Send a new client 100 frames; return what reaches it."""
        sender = endpoint.towards(None)
        assert sender is not None
        sender.send_streams([b"%d" % number for number in range(100)])
        return list(inner.take())

    first, second = heard(), heard()
    assert 30 < len(first) < 70
    assert first != second, "each lane has randomness of its own"
    for _ in range(50):
        heard()
    gc.collect()
    assert len(endpoint._senders) == 1, "the endpoint itself"
    endpoint.towards(None)
    assert len(endpoint._generators) <= 2


def test_a_link_that_is_cut_passes_nothing_and_then_all() -> None:
    endpoint, inner, at = link_of("link cut at 1s for 1s")
    passed = []
    for second in range(4):
        at(second * 1_000_000)
        inner.inbox.append(b"%d" % second)
        endpoint.send(b"answer")
        passed.append((endpoint.receive(), inner.take()))
    nothing: tuple[list[bytes], list[bytes]] = ([], [])
    assert passed == [([b"0"], [b"answer"]), nothing, ([b"2"], [b"answer"]), ([b"3"], [b"answer"])]


@pytest.mark.parametrize(
    ("fault", "least", "most"),
    [("loss 25%", 700, 800), ("duplicate 25%", 1200, 1300), ("reorder 25%", 999, 1000)],
)
def test_shares_of_frames(fault: str, least: int, most: int) -> None:
    endpoint, inner, at = link_of(f"uplink {fault}")
    at(0)
    inner.inbox.extend(b"%d" % n for n in range(1000))
    frames = [int(chunk) for chunk in endpoint.receive()]
    assert least <= len(frames) <= most
    moved = sum(a > b for a, b in pairwise(frames))
    assert (moved > 100) is fault.startswith("reorder")


def test_in_lockstep_commands_pass_and_take_along_what_was_sent_before() -> None:
    endpoint, inner, at = link_of("uplink delay 1s", conducted=True)
    encoder = Encoder(245, 190)
    setpoint = encoder.pack(SETPOINT(0, 1, 1, 8, 0, *(0.0,) * 11))
    command = encoder.pack(dialect.MAVLink_command_long_message(1, 1, 400, 0, *(0.0,) * 7))
    at(0)
    inner.inbox.append(setpoint)
    assert endpoint.receive() == []
    inner.inbox.append(command)
    assert endpoint.receive() == [setpoint, command]


# --- the camera


def frames_of(
    *faults: str, vehicle: VehicleProfile | None = None, **sensors: float
) -> list[tuple[int, Frame]]:
    """Return the frames of two seconds in a small arena, each with the time at which it came."""
    from airl_mav.arena.generate import generate
    from airl_mav.profiles.arena import ArenaSpec
    from airl_mav.profiles.loading import load_profile

    spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    arena = generate(spec, 3, name="static-obstacles", vehicle_width_m=0.4, zone=None)
    asked = Aircraft.model_validate({"faults": faults, "sensors": sensors})
    setup = EpisodeSetup(vehicle or quad(), arena, 1, asked)
    simulation = Simulation(setup, start_us=0, clock=SimClock(), autopilot=Witness())
    frames: list[tuple[int, Frame]] = []
    for _ in range(500):
        simulation.capture_due(
            simulation.time_us, lambda frame: frames.append((simulation.time_us, frame))
        )
        simulation.tick()
    simulation.close()
    return frames


def test_a_camera_is_off_late_stuck_or_noisy() -> None:
    healthy = frames_of()
    off = frames_of("camera off at 1s")
    assert all(time_us <= 1_000_000 for time_us, _ in off)
    late = frames_of("camera delay 200ms at 1s")
    slow = [t - f.capture_time_us for t, f in late if f.capture_time_us > 1_000_000]
    assert 200_000 <= min(slow) <= max(slow) < 204_000
    noisy = frames_of("camera noise 20% at 1s")
    stuck = frames_of("camera stuck at 500ms")
    for (time_us, was), (_, now), (_, held) in zip(healthy, noisy, stuck, strict=True):
        assert np.array_equal(was.depth_mm, now.depth_mm) is (time_us <= 1_000_000)
        assert held.capture_time_us == was.capture_time_us
    assert len({frame.depth_mm.tobytes() for time_us, frame in stuck if time_us > 500_000}) == 1


def test_pictures_that_fail_are_the_main_camera_s() -> None:
    rig: dict[str, Any] = {"vehicle": load_vehicle("quad-rig"), "depth_noise": 0.1}
    healthy = frames_of(**rig)
    noisy, stuck = (frames_of(f"camera {kind} at 500ms", **rig) for kind in ("noise 20%", "stuck"))
    held, mains, sides = set(), set(), set()
    for (time_us, was), (_, worse), (_, still) in zip(healthy, noisy, stuck, strict=True):
        if time_us <= 500_000:
            continue
        assert not np.array_equal(was.depth_mm, worse.depth_mm)
        for name, each in was.further.items():
            assert np.array_equal(each.image, worse.further[name].image)
            assert np.array_equal(each.image, still.further[name].image)
        held.add(still.depth_mm.tobytes())
        mains.add(was.depth_mm.tobytes())
        sides.add(was.further["left"].image.tobytes())
    assert len(held) == 1
    assert len(mains) == len(sides) > 40
    assert not [f for t, f in frames_of("camera off at 1s", **rig) if t > 1_000_000]
