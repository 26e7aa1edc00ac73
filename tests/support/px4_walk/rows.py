"""All rows. A service adds the module with its own."""

from __future__ import annotations

from tests.support.px4_walk import (
    commands,
    ending,
    files,
    flight,
    messages,
    missions,
    offboard,
    parameters,
    pilot,
    plans_flown,
)
from tests.support.px4_walk.row import Row

GROUND: tuple[Row, ...] = (
    *parameters.ROWS,
    *messages.ROWS,
    *files.ROWS,
    *commands.ROWS,
    *missions.ROWS,
)
"""Rows of a vehicle on the ground."""

FLIGHT: tuple[Row, ...] = (
    *flight.GROUND,
    *flight.CLIMB,
    *flight.AIR,
    *offboard.ROWS,
    *plans_flown.ROWS,
    *ending.FAILURES,
    *pilot.ROWS,
    *ending.ROWS,
)
"""A flight from arming to the end."""

ROWS = GROUND + FLIGHT
"""In the order in which they are made."""
