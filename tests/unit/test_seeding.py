"""Generators of a seed and a key are numpy's own."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.seeding import seeded

NUMBERS = st.one_of(st.integers(0, 2**32 - 1), st.integers(0, 2**70), st.sampled_from([0, 2**32]))


@given(NUMBERS, st.lists(NUMBERS, max_size=3))
def test_numpys_own(seed: int, key: list[int]) -> None:
    ours = seeded(seed, *key)
    theirs = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    assert ours.bit_generator.state == theirs.bit_generator.state
    assert ours.random() == theirs.random()


def test_one_can_be_copied() -> None:
    ours = seeded(7, 1)
    ours.random(5)
    assert deepcopy(ours).random() == ours.random()


@pytest.mark.parametrize("key", [(), (1,)])
def test_a_seed_is_not_negative(key: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="non-negative"):
        seeded(-1, *key)
