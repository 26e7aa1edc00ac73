"""Hostile files, depth frames and answers of a PX4: refused in one line, or taken.

`scripts/fuzz_inputs.py --seconds 600` is the long run.
"""

from __future__ import annotations

import pytest
from fuzz_inputs import (
    ANSWER_S,
    READERS,
    answers,
    be_connected_to,
    meet_hostile_px4,
    read_damaged_file,
    see_hostile_frames,
)

FILES = 12
"""Damaged files of each kind."""


@pytest.mark.parametrize("kind", READERS)
def test_a_damaged_file_is_read_or_refused_in_one_line(kind: str) -> None:
    came = {read_damaged_file(number, kind) for number in range(FILES)}
    assert f"{kind} refused" in came  # Corruption is detected.


def test_a_companion_decides_on_sound_frames_alone() -> None:
    for number in range(12):  # All lenses, of one camera and of two.
        refused = int(see_hostile_frames(number).split()[0])
        assert 5 < refused < 50


@pytest.mark.parametrize("number", range(12))
def test_a_broken_px4_ends_the_flight_with_its_error(number: int) -> None:
    said = meet_hostile_px4(number)
    assert said.startswith("lost after") or said == "all samples answered"


def test_a_sound_px4_is_answered_to() -> None:
    assert ANSWER_S > 0.0
    assert be_connected_to([*answers(3), b""]).startswith("lost after 3")


def test_a_connection_that_ends_after_any_byte_of_an_answer() -> None:
    whole = answers(2)
    for cut in range(0, len(whole[1]), 7):
        assert be_connected_to([whole[0], whole[1][:cut]]) == "lost after 1 answers"


@pytest.mark.nightly
def test_a_connection_that_ends_after_every_byte() -> None:
    whole = answers(2)
    for cut in range(len(whole[0])):
        # Before the first answer its end may be seen one sample later.
        said = be_connected_to([whole[0][:cut]])
        assert said in ("lost after 0 answers", "all samples answered")
    for cut in range(len(whole[1])):
        assert be_connected_to([whole[0], whole[1][:cut]]) == "lost after 1 answers"
