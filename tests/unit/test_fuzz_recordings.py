"""Damaged recordings and meshes: refused in one line, or taken.

`scripts/fuzz_recordings.py --seconds 600` is the long run.
"""

from __future__ import annotations

import pytest
from fuzz_recordings import CASES, read_damaged

MESHES = 12


def test_a_damaged_mesh_is_refused_in_one_line_or_taken() -> None:
    came = {read_damaged("mesh", number) for number in range(MESHES)}
    assert "asset refused" in came  # Corruption is detected.


@pytest.mark.nightly
@pytest.mark.timeout(1_200)
@pytest.mark.parametrize("what", [what for what in CASES if what != "mesh"])
def test_a_damaged_recording_is_refused_in_one_line_or_taken(what: str) -> None:
    came = {read_damaged(what, number) for number in range(20)}
    assert any(each.endswith("refused") for each in came)
