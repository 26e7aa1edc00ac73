"""Commands that send the vehicle somewhere, the pilot's sticks, and a target to follow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.core.frames import local_to_geodetic
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import (
    ManualControl,
    OrbitRequest,
    Reposition,
    Source,
    Sticks,
)
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.mavlink.codec import dialect
from tests.support.kinematic_autopilot import ORIGIN
from tests.support.mavlink_clients import Rig, text_of

NAN = math.nan
THERE = local_to_geodetic(np.array([20.0, -10.0, 0.0]), ORIGIN)
PLACE = round(THERE.latitude_deg * 1e7), round(THERE.longitude_deg * 1e7)
REPOSITION, CHANGE_ALTITUDE, CHANGE_SPEED, ORBIT = 192, 186, 178, 34


@pytest.fixture
def rig() -> Rig:
    return Rig()


def command_int(
    rig: Rig, number: int, frame: int, four: tuple[float, ...], x: int, y: int, z: float
) -> int:
    rig.client.send(dialect.MAVLink_command_int_message(1, 1, frame, number, 0, 0, *four, x, y, z))
    rig.bench.tick()
    return rig.acknowledged(number)[0]


@pytest.mark.parametrize("frame", [0, 3, 5, 6])
def test_reposition_in_whichever_frame(rig: Rig, frame: int) -> None:
    """PX4 takes every altitude as above sea level; MAVSDK's do_orbit relies on it."""
    altitude = ORIGIN.altitude_m + 7.0
    four = (3.0, 1.0, 0.0, 1.5)
    assert command_int(rig, REPOSITION, frame, four, *PLACE, altitude) == Result.ACCEPTED
    (request,) = rig.autopilot.requests
    assert isinstance(request, Reposition)
    assert request.place.position == pytest.approx((20.0, -10.0, -7.0), abs=0.02)
    assert (request.place.yaw, request.speed_m_s) == (1.5, 3.0)
    assert rig.autopilot.mode is Mode.HOLD


def test_what_a_reposition_leaves_open(rig: Rig) -> None:
    nowhere = 2**31 - 1
    four = (-1.0, 1.0, 0.0, NAN)
    assert command_int(rig, REPOSITION, 0, four, nowhere, nowhere, 500.0) == Result.ACCEPTED
    (request,) = rig.autopilot.requests
    assert isinstance(request, Reposition)
    np.testing.assert_allclose(request.place.position, (NAN, NAN, ORIGIN.altitude_m - 500.0))
    assert math.isnan(request.place.yaw)
    assert math.isnan(request.speed_m_s)
    assert rig.command(REPOSITION, -1, 1, 0, NAN, NAN, NAN, NAN)[0] == Result.ACCEPTED
    assert rig.autopilot.requests[1:] == [None], "nothing at all: hold"
    assert rig.command(REPOSITION, 0, 0)[0] == Result.UNSUPPORTED, "no change of mode"
    assert rig.command(CHANGE_ALTITUDE, 510.0)[0] == Result.ACCEPTED
    request = rig.autopilot.requests[-1]
    assert isinstance(request, Reposition)
    assert request.place.position[2] == pytest.approx(ORIGIN.altitude_m - 510.0)


def test_speeds_and_regions_of_interest(rig: Rig) -> None:
    assert rig.command(CHANGE_SPEED, 1, 2.5)[0] == Result.ACCEPTED
    for params in ((0, 2.5), (1, -1.0), (1, NAN)):  # air speed, no change
        assert rig.command(CHANGE_SPEED, *params)[0] == Result.ACCEPTED
    assert rig.autopilot.commands == ["speed 2.5"]
    for number in (195, 197, 201):
        assert rig.command(number)[0] == Result.ACCEPTED


def test_orbits(rig: Rig) -> None:
    where = THERE.latitude_deg, THERE.longitude_deg, ORIGIN.altitude_m + 9.0
    assert rig.command(ORBIT, -8.0, 3.0, 3.0, NAN, *where)[0] == Result.ACCEPTED
    assert rig.command(ORBIT, NAN, NAN, NAN, NAN, NAN, NAN, NAN)[0] == Result.ACCEPTED
    given, nothing = rig.autopilot.requests
    assert isinstance(given, OrbitRequest)
    assert given.centre == pytest.approx((20.0, -10.0, -9.0), abs=1.0)
    assert (given.radius_m, given.speed_m_s, given.facing) == (-8.0, 3.0, 3)
    assert isinstance(nothing, OrbitRequest)
    assert np.isnan([*nothing.centre, nothing.radius_m, nothing.speed_m_s]).all()
    assert nothing.facing is None


def test_sticks(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_manual_control_message(1, 1000, -500, 750, 100, 0))
    rig.client.send(dialect.MAVLink_manual_control_message(1, 32767, 0, -1, 0, 0))
    rig.client.send(dialect.MAVLink_manual_control_message(9, 1000, 0, 0, 0, 0))
    channels = (1750, 1250, 2000, 1500, 0, 0, 0, 0)
    rig.client.send(dialect.MAVLink_rc_channels_override_message(1, 1, *channels))
    rig.client.send(dialect.MAVLink_rc_channels_override_message(1, 1, 1500, 0, *channels[2:]))
    rig.bench.tick()
    first, odd, radio = rig.autopilot.sticks
    assert first[:2] == (Sticks(-0.5, 1.0, 0.5, 0.1), Source.JOYSTICK)
    assert odd[0] == Sticks(0.0, 0.0, 0.0, 0.0), "what is out of range counts as centred"
    assert radio[:2] == (Sticks(0.5, 0.5, 1.0, 0.0), Source.RADIO)
    assert not [text for text in text_of(rig.client.received()) if "refused" in text]


def test_a_target_to_follow(rig: Rig) -> None:
    rest = ([0.0] * 3, [1.0, 0.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3, 0)
    for capabilities in (1, 3):
        rig.client.send(
            dialect.MAVLink_follow_target_message(
                0, capabilities, *PLACE, ORIGIN.altitude_m + 2.0, [1.0, 2.0, 0.0], *rest
            )
        )
    rig.bench.tick()
    still, moving = rig.autopilot.followed
    assert still.position == pytest.approx((20.0, -10.0, -2.0), abs=0.02)
    assert (still.velocity, moving.velocity) == ((0.0, 0.0, 0.0), (1.0, 2.0, 0.0))


@pytest.mark.parametrize(("mode", "taken"), [(0, "R"), (1, "J"), (2, "J"), (3, "J"), (4, "")])
def test_the_source_that_counts(mode: int, taken: str) -> None:
    """COM_RC_IN_MODE; with both allowed the first stays, until it falls silent."""
    control = ManualControl(Parameters({"COM_RC_IN_MODE": mode}).value)
    right, left = Sticks(1.0, 0.0, 0.0, 0.0), Sticks(-1.0, 0.0, 0.0, 0.0)
    control.offer(right, Source.JOYSTICK, 1_000_000)
    control.offer(left, Source.RADIO, 1_100_000)
    assert control.sticks(1_200_000) == {"R": left, "J": right, "": None}[taken]
    assert control.sticks(1_700_000) is None, "COM_RC_LOSS_T"
    control.offer(left, Source.RADIO, 2_000_000)
    falls_back = {0: left, 1: None, 2: left, 3: None, 4: None}
    assert control.sticks(2_000_000) == falls_back[mode]


def test_sticks_that_lie_still_do_not_move() -> None:
    control = ManualControl(Parameters({}).value)
    deflected = Sticks(0.9, 0.0, -1.0, 0.0)
    moves = [control.offer(deflected, Source.JOYSTICK, t * 40_000) for t in range(50)]
    assert not any(moves)
    nudged = deflected._replace(roll=0.8)
    assert not control.offer(nudged, Source.JOYSTICK, 50 * 40_000)
    assert control.offer(deflected._replace(roll=0.0), Source.JOYSTICK, 51 * 40_000)
