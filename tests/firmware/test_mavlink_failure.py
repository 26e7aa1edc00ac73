"""MAV_CMD_INJECT_FAILURE: PX4 1.16's answers, measured or from its code, and the faults."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from airl_mav.core.clock import SimClock
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import quad
from tests.support.mavlink_clients import RawClient

ACCEPTED, DENIED, UNSUPPORTED, SILENT = 0, 2, 3, None
GYRO, ACCEL, MAG, BARO, GPS, FLOW, VIO, DISTANCE, AIRSPEED = range(9)
BATTERY, MOTOR, SERVO, AVOIDANCE, RC, MAVLINK = range(100, 106)
OK, OFF, STUCK, GARBAGE, WRONG, SLOW, DELAYED, INTERMITTENT = range(8)


class Aloft:
    """The real autopilot and plant behind the real MAVLink server, in memory."""

    def __init__(self) -> None:
        setup = EpisodeSetup(quad(), None, 1, Aircraft())
        self.simulation = Simulation(setup, start_us=0, clock=SimClock())
        assert isinstance(self.simulation.autopilot, BuiltinAutopilot)
        self.autopilot = self.simulation.autopilot
        endpoint = MemoryEndpoint()
        self.server = MavlinkServer([onboard_link(endpoint)], self.autopilot, boot_unix_us=0)
        self.client = RawClient(endpoint)
        self.run(0.1)

    def run(self, seconds: float) -> None:
        for _ in range(round(250 * seconds)):
            self.server.receive(self.simulation.time_us)
            self.simulation.tick()
            self.server.send(self.simulation.time_us)

    def inject(self, unit: float, kind: float, instance: float = 0) -> int | None:
        """Return the answer; None = no answer."""
        self.client.received()
        self.client.command(dialect.MAV_CMD_INJECT_FAILURE, unit, kind, instance)
        self.run(0.008)
        acks = self.client.received("COMMAND_ACK")
        return acks[0].result if acks else None


@pytest.fixture
def aloft() -> Iterator[Aloft]:
    made = Aloft()
    yield made
    made.simulation.close()


ANSWERS = [
    *((unit, kind, ACCEPTED) for unit in (GYRO, ACCEL, MAG, BARO) for kind in (OK, OFF, STUCK)),
    *((unit, kind, UNSUPPORTED) for unit in (GYRO, ACCEL, MAG, BARO) for kind in (GARBAGE, SLOW)),
    (GPS, OFF, ACCEPTED),
    (GPS, OK, ACCEPTED),
    (GPS, STUCK, UNSUPPORTED),
    (AIRSPEED, WRONG, ACCEPTED),
    (VIO, OFF, ACCEPTED),
    (VIO, STUCK, UNSUPPORTED),
    (BATTERY, OFF, ACCEPTED),
    (BATTERY, STUCK, SILENT),
    (MOTOR, OFF, ACCEPTED),
    (MOTOR, WRONG, ACCEPTED),
    (MOTOR, STUCK, UNSUPPORTED),
    *((unit, OFF, SILENT) for unit in (FLOW, DISTANCE, SERVO, AVOIDANCE, RC, MAVLINK)),
    (999, OFF, SILENT),
    (float("nan"), OFF, SILENT),
]


def test_every_answer_is_px4_s(aloft: Aloft) -> None:
    assert [(u, k, aloft.inject(u, k)) for u, k, _ in ANSWERS[:-1]] == ANSWERS[:-1]
    assert aloft.inject(*ANSWERS[-1][:2]) is SILENT
    assert aloft.inject(BATTERY, OFF, 1) == UNSUPPORTED
    assert aloft.inject(MOTOR, OK, 9) == UNSUPPORTED
    aloft.autopilot.parameters.set("SYS_FAILURE_EN", 0)
    assert aloft.inject(GPS, OFF) == DENIED


def test_nothing_lies_in_between_until_something_is_injected(aloft: Aloft) -> None:
    fly = aloft.simulation._fly
    assert aloft.inject(GPS, OK) == ACCEPTED
    assert aloft.simulation.faults is None
    assert aloft.simulation._fly == fly


def test_what_is_injected_fails_until_it_is_ok_and_is_recorded(aloft: Aloft) -> None:
    aloft.run(1.0)
    seen: list[bool] = []
    for kind in (OFF, OK):
        aloft.inject(MAG, kind)
        stamps = []
        for _ in range(100):
            aloft.run(0.004)
            sample = aloft.autopilot.sample
            assert sample is not None
            stamps.append(sample.mag is not None)
        seen.append(any(stamps))
    assert seen == [False, True]
    arrays = aloft.simulation.arrays()
    assert arrays["faults/fault"][0].startswith("mag off at 1.1")
    assert arrays["faults/to_us"][0] - arrays["faults/from_us"][0] == pytest.approx(4e5, abs=2e4)


def test_a_motor_that_is_off_stops(aloft: Aloft) -> None:
    aloft.run(1.0)
    aloft.autopilot.arm(force=False)
    aloft.autopilot.takeoff(3.0)
    aloft.run(8.0)
    assert aloft.simulation.plant.position[2] < -1.0
    assert aloft.inject(MOTOR, OFF, 1) == ACCEPTED
    aloft.run(0.5)
    speeds = aloft.simulation.plant.rotor_speeds
    assert speeds[0] == pytest.approx(0.0, abs=1e-3)
    assert max(speeds[1:]) > 0.1
