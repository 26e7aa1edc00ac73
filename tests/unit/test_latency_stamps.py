from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.latency.stamps import NO_STAMP, STAMPS, DecisionLog

TIMES = st.integers(min_value=-1, max_value=2**62)
SETPOINTS = st.tuples(*[st.floats(width=32)] * 4)


@given(
    st.integers(1, 5),
    st.lists(st.tuples(*[TIMES] * len(STAMPS), SETPOINTS), max_size=30),
)
def test_what_goes_in_comes_out(capacity: int, rows: list[tuple[Any, ...]]) -> None:
    log = DecisionLog(capacity)
    for row in rows:
        log.record(*row)
    columns = log.columns()
    assert len(log) == len(rows)
    for i, name in enumerate(STAMPS):
        assert columns[name].dtype == np.int64
        assert columns[name].tolist() == [row[i] for row in rows]
    expected = np.array([row[-1] for row in rows], np.float32).reshape(-1, 4)
    assert columns["setpoint"].dtype == np.float32
    assert np.array_equal(columns["setpoint"], expected, equal_nan=True)


def test_columns_are_copies() -> None:
    log = DecisionLog(2)
    log.record(1, 2, 3, 4, 5, 6, (1.0, 0.0, 0.0, float("nan")))
    before = log.columns()
    log.record(NO_STAMP, 7, 8, 9, 10, 11, (2.0, 0.0, 0.0, 0.0))
    assert before["capture_us"].tolist() == [1]
    before["capture_us"][:] = 0
    assert log.columns()["capture_us"].tolist() == [1, NO_STAMP]
    assert len(log) == 2


def test_no_room_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="capacity=0"):
        DecisionLog(0)


def test_the_log_needs_nothing_but_numpy() -> None:
    code = (
        "import sys, json, airl_mav.latency.stamps as m;"
        "tops = {name.partition('.')[0] for name in sys.modules};"
        "print(json.dumps(sorted(tops - set(sys.stdlib_module_names))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name for name in json.loads(done.stdout) if not name.startswith("_")}
    heavy = {"scipy", "matplotlib", "numba", "pydantic", "pybullet", "torch", "mavsdk"}
    assert {"airl_mav", "numpy"} <= loaded
    assert not heavy & loaded
