"""All rows. A service adds the module with its own."""

from __future__ import annotations

from tests.support.px4_walk import commands, files, messages, missions, parameters
from tests.support.px4_walk.row import Row

ROWS: tuple[Row, ...] = (
    *parameters.ROWS,
    *messages.ROWS,
    *files.ROWS,
    *commands.ROWS,
    *missions.ROWS,
)
"""In the order in which they are made."""
