from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from airl_mav.latency.stages import FENCE_SAMPLES, decision_series, fence, stage_samples
from airl_mav.latency.stamps import NO_STAMP

COLUMNS = (
    "capture_us",
    "decoded_us",
    "infer_start_us",
    "action_ready_us",
    "sent_us",
    "held_until_us",
    "accepted_us",
    "motor_us",
)


@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.floats(0.0, 0.6))
def test_a_series_holds_what_the_samples_hold(seed: int, n: int, missing: float) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.integers(1, 50_000, (n, len(COLUMNS)))
    rows = np.cumsum(steps.ravel()).reshape(n, len(COLUMNS))
    rows[rng.random(rows.shape) < missing] = NO_STAMP
    stamps = {name: rows[:, k] for k, name in enumerate(COLUMNS) if rng.random() > 0.1}
    series, samples = decision_series(stamps), stage_samples(stamps)
    assert series.keys() == samples.keys()
    for key, durations in series.items():
        assert len(durations) == (n if stamps else 0)
        assert durations[durations != NO_STAMP].tolist() == samples[key].tolist()


def test_the_fence_is_tukeys() -> None:
    rng = np.random.default_rng(5)
    values = rng.lognormal(12.0, 0.1, 4000).astype(np.int64)
    values[[7, 1000]] = 10 * values.max()
    found = fence(values)
    assert found is not None
    limit = np.quantile(values, 0.75) + 3.0 * stats.iqr(values)
    assert found.limit_us == pytest.approx(limit)
    assert found.beyond == np.count_nonzero(values > limit)
    assert found.marks(values)[[7, 1000]].all()
    assert found.marks(values).sum() == found.beyond


def test_two_kinds_of_decisions_are_no_outliers() -> None:
    values = np.array([4_000] * 80 + [8_000] * 20)
    found = fence(values)
    assert found is not None
    assert found.second_kind
    assert not found.marks(values).any()
    rare = fence(np.array([4_000] * 97 + [8_000] * 3))
    assert rare is not None
    assert rare.beyond == 3
    assert not rare.second_kind


def test_few_or_equal_durations_have_no_outliers() -> None:
    assert fence(np.arange(FENCE_SAMPLES - 1)) is None
    same = fence(np.full(100, 5_000))
    assert same is not None
    assert same.beyond == 0
