from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.latency.stages import SHOWN_STAGES, STAGES, pool, stage_samples
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.rehearsal.episode import SAME_WITHIN, UNMATCHED, match_setpoints, stamps_of

CHAIN = ("t1", "wait", "t2", "send", "link", "control")


def stamps(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """n decisions whose stamps follow each other."""
    names = [STAGES[0].start, *[stage.end for stage in STAGES[: len(CHAIN)]]]
    steps = rng.integers(0, 400_000, (n, len(names)))
    times = np.cumsum(steps, axis=1) + np.arange(n)[:, None] * 5_000_000
    columns = {name: times[:, i] for i, name in enumerate(names)}
    columns["held_until_us"] = columns["sent_us"] + 500_000
    return columns


def test_the_stages_follow_each_other_and_add_up_to_end_to_end() -> None:
    samples = stage_samples(stamps(50, np.random.default_rng(1)))
    total = sum(samples[key] for key in CHAIN)
    assert np.array_equal(total, samples["end_to_end"])
    assert np.array_equal(samples["setpoint_to_motor"], samples["link"] + samples["control"])
    assert set(samples["t3"].tolist()) == {500_000}


def test_each_stage_by_hand() -> None:
    samples = stage_samples(
        {
            "capture_us": np.array([100, 1_100]),
            "decoded_us": np.array([103, 1_104]),
            "infer_start_us": np.array([110, 1_110]),
            "action_ready_us": np.array([150, 1_170]),
            "sent_us": np.array([151, 1_172]),
            "held_until_us": np.array([651, 1_672]),
            "accepted_us": np.array([160, 1_180]),
            "motor_us": np.array([164, 1_188]),
        }
    )
    assert {key: value.tolist() for key, value in samples.items()} == {
        "t1": [3, 4],
        "wait": [7, 6],
        "t2": [40, 60],
        "send": [1, 2],
        "link": [9, 8],
        "control": [4, 8],
        "end_to_end": [64, 88],
        "setpoint_to_motor": [13, 16],
        "t3": [500, 500],
        "period": [1_021],
    }


def test_a_missing_stamp_takes_only_its_own_stages() -> None:
    columns = stamps(4, np.random.default_rng(2))
    whole = stage_samples(columns)
    columns["accepted_us"] = columns["accepted_us"].copy()
    columns["accepted_us"][1] = NO_STAMP
    samples = stage_samples(columns)
    assert np.array_equal(samples["link"], np.delete(whole["link"], 1))
    assert np.array_equal(samples["control"], np.delete(whole["control"], 1))
    assert np.array_equal(samples["t2"], whole["t2"])


def test_a_missing_column_is_no_sample() -> None:
    columns = stamps(4, np.random.default_rng(3))
    del columns["motor_us"]
    samples = stage_samples(columns)
    assert len(samples["control"]) == len(samples["end_to_end"]) == 0
    assert len(samples["link"]) == 4
    assert all(len(values) == 0 for values in stage_samples({}).values())


def test_pooling_never_measures_across_episodes() -> None:
    rng = np.random.default_rng(4)
    parts = [stage_samples(stamps(n, rng)) for n in (3, 1, 5)]
    pooled = pool(parts)
    assert len(pooled["period"]) == 2 + 0 + 4
    assert len(pooled["t2"]) == 9
    assert all(len(values) == 0 for values in pool([]).values())
    assert {stage.key for stage in SHOWN_STAGES} < set(pooled)


def flight_of_setpoints(
    rng: np.random.Generator, n: int, values: np.ndarray, loss: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Send n setpoints as MAVSDK does: at once and then at 20 Hz, each copy delayed or lost.

    Returns sending times, acceptance times, accepted rows, and the true first copy (or -1).
    """
    sent = np.cumsum(rng.integers(200_000, 900_000, n))
    copies = []
    for i in range(n):
        end = sent[i + 1] if i + 1 < n else sent[i] + 700_000
        for at in range(int(sent[i]), int(end) - 20_000, 50_000):
            if rng.random() >= loss:
                copies.append((at + int(rng.integers(50, 15_000)), i))
    copies.sort()
    accepted = np.array([at for at, _ in copies], np.int64)
    owner = np.array([i for _, i in copies], np.int64)
    truth = np.array([np.append(np.flatnonzero(owner == i), UNMATCHED)[0] for i in range(n)])
    return sent, accepted, values[owner], truth


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.sampled_from([0.0, 0.3, 0.9]))
def test_the_first_copy_is_found_among_the_resends(seed: int, n: int, loss: float) -> None:
    rng = np.random.default_rng(seed)
    # Few distinct values: neighbours are often equal, as with a policy that repeats an action.
    values = rng.integers(0, 3, (n, 4)).astype(np.float32)
    sent, accepted, rows, truth = flight_of_setpoints(rng, n, values, loss)
    found = match_setpoints(sent, values, accepted, rows)
    assert found.tolist() == truth.tolist()
    times = stamps_of(found, accepted)
    assert np.array_equal(times == NO_STAMP, truth == UNMATCHED)
    assert np.all(times[truth >= 0] >= sent[truth >= 0])


def test_an_unused_field_and_lost_last_bits_still_match() -> None:
    value = np.array([[1.0, -0.0, np.nan, np.deg2rad(108.0)]], np.float32)
    received = value.copy()
    received[0, 1] = 0.0
    received[0, 3] = np.nextafter(received[0, 3], np.float32(9.0))
    assert match_setpoints([10], value, [12], received).tolist() == [0]
    received[0, 0] += 3 * SAME_WITHIN
    assert match_setpoints([10], value, [12], received).tolist() == [UNMATCHED]


def test_copies_before_the_sending_or_after_the_next_do_not_count() -> None:
    rows = np.zeros((3, 4), np.float32)
    values = np.array([[0, 0, 0, 0], [1, 0, 0, 0]], np.float32)
    assert match_setpoints([100, 200], values, [99, 200, 250], rows).tolist() == [-1, -1]
    assert match_setpoints([100, 200], values, [100, 200, 250], rows).tolist() == [0, -1]


def test_nothing_sent_or_nothing_accepted() -> None:
    empty = np.zeros((0, 4), np.float32)
    assert match_setpoints([], empty, [5], np.zeros((1, 4))).tolist() == []
    assert match_setpoints([5], np.zeros((1, 4)), [], empty).tolist() == [UNMATCHED]
    assert stamps_of([UNMATCHED], []).tolist() == [NO_STAMP]


def test_inputs_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="2 sending times for 1 setpoints"):
        match_setpoints([1, 2], np.zeros((1, 4)), [], np.zeros((0, 4)))
    with pytest.raises(ValueError, match="go back"):
        match_setpoints([2, 1], np.zeros((2, 4)), [], np.zeros((0, 4)))
