"""A real MAVSDK's calls at the real airl-firmware, answered as by a real PX4 1.16."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.flight.test_mavsdk_firmware import client
from tests.support.px4_walk.row import answered
from tests.support.px4_walk.rows import ROWS
from tests.support.px4_walk.vehicle import Vehicle

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]

SPEED = 2.0


def walk(folder: Path, *, slow: bool) -> list[str]:
    """Make all calls of one kind; return what differs from PX4."""
    with client(folder, speed=SPEED) as c:
        c.ready()
        vehicle = Vehicle(c.companion)
        answers = [answered(row, vehicle) for row in ROWS if row.slow is slow]
    return [
        f"{answer.row.name}: PX4 {answer.row.expected[0]}, here {answer.outcome} {answer.value}"
        for answer in answers
        if not answer.agrees
    ]


def test_every_call_is_answered_as_by_px4(tmp_path: Path) -> None:
    assert walk(tmp_path, slow=False) == []


@pytest.mark.nightly
def test_what_px4_does_not_answer_is_not_answered_here_either(tmp_path: Path) -> None:
    assert walk(tmp_path, slow=True) == []


def test_the_rows_have_names_of_their_own() -> None:
    names = [row.name for row in ROWS]
    assert len(names) == len(set(names))
