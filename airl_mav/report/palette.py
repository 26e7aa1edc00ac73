"""Colours and strokes of things that are drawn over each other, one each."""

from __future__ import annotations

from typing import NamedTuple


class Look(NamedTuple):
    """How one of several lines or bars is drawn."""

    colour: str
    dashes: str
    """A matplotlib line style: printed without colour, lines still differ."""


COLOURS = ("#2f7fc4", "#cf6a12", "#2c9a5b", "#a35bb8", "#c8435f", "#8d7b1c", "#1697a6", "#7d6b60")
"""Of middling lightness: legible on light and on dark paper."""

DASHES = ("-", "--", "-.", ":")


def look(index: int) -> Look:
    """Return the look of the thing with a number, from 0; 32 are different."""
    step = index // len(COLOURS)
    return Look(COLOURS[index % len(COLOURS)], DASHES[(index + step) % len(DASHES)])
