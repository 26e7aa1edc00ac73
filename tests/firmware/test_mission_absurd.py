"""Missions of in-range but absurd values: every stored mission can be flown without harm."""

from __future__ import annotations

import math
import random

from pymavlink.dialects.v20 import common as dialect

from firmware_sim.addons.missions.items import NavCommand, PlanFrame, belongs, parse
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem
from tests.support.mission_kit import FakeFlight

MISSIONS = 250
VALUES = (0.0, 1.0, -1.0, 2.0, 3.0, 65_535.0, 1e30, -1e30, math.nan, math.inf, -math.inf)
LATITUDES = (47.4, 90.0, -90.0, 0.0, 1e30, math.nan, math.inf)


def absurd_item(rng: random.Random) -> PlanItem | None:
    """Return an item as an upload stores it; None = refused."""
    params = [rng.choice(VALUES) for _ in range(4)]
    message = dialect.MAVLink_mission_item_message(
        1,
        1,
        0,
        rng.choice((PlanFrame.GLOBAL, PlanFrame.MISSION, PlanFrame.GLOBAL_RELATIVE_ALT)),
        rng.choice(tuple(NavCommand)),
        0,
        int(rng.random() < 0.9),
        *params,
        rng.choice(LATITUDES),
        rng.choice((8.5, 180.0, -1e30)),
        rng.choice(VALUES),
    )
    item = parse(message)
    return item if isinstance(item, PlanItem) and belongs(item, MissionType.MISSION) else None


def test_what_is_flown_to_is_always_a_place() -> None:
    rng, ran = random.Random(0), 0
    for _ in range(MISSIONS):
        items = [item for item in (absurd_item(rng) for _ in range(12)) if item is not None]
        flight = FakeFlight(*items)
        landed = rng.random() < 0.5
        flight.now = flight.now._replace(position=(0.0, 0.0, -10.0), landed=landed)
        flight.start()
        ran += flight.plans.valid
        for _ in range(10):
            if rng.random() < 0.5:
                flight.arrive(landed=rng.random() < 0.2)
            else:
                flight.be((rng.uniform(-50.0, 50.0), 0.0, -rng.uniform(0.0, 20.0)), seconds=0.2)
            triplet = flight.executor.triplet
            assert all(map(math.isfinite, triplet.target)), items
            assert triplet.next is None or all(map(math.isfinite, triplet.next)), items
    assert ran > MISSIONS // 20  # enough of them are not rejected
