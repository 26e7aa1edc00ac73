from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.latency.stages import decision_series, stage_samples
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
