from __future__ import annotations

import json
from dataclasses import replace

import pytest

from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from tests.support.run_demo import demo_arena, demo_episode


@pytest.fixture(scope="module")
def record() -> EpisodeRecord:
    return demo_episode(2, demo_arena(3))[0]


def test_a_line_reads_back_as_it_was(record: EpisodeRecord) -> None:
    for version in (
        record,
        replace(record, quality=None, navigation_us=None, wall_s=None, battery_remaining=None),
        replace(record, outcome=Outcome.ABORTED, reason='a "line"\nbreak, ü', notes=()),
    ):
        line = version.to_json()
        assert "\n" not in line
        assert EpisodeRecord.from_json(line) == version


def test_the_line_is_plain_json(record: EpisodeRecord) -> None:
    data = json.loads(record.to_json())
    assert data["schema"] == 1
    assert data["outcome"] == record.outcome.value
    assert record.quality is not None
    assert data["quality"]["distance_m"] == record.quality.distance_m


def test_no_nan_is_written(record: EpisodeRecord) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        replace(record, battery_remaining=float("nan")).to_json()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 99}, "schema = 99: accepted: 1"),
        ({"outcome": "won"}, "outcome = 'won'"),
        ({"goal": [1.0]}, "goal"),
        ({"seed": "many"}, "seed = 'many'"),
    ],
)
def test_a_foreign_line_is_refused(record: EpisodeRecord, change: dict, message: str) -> None:
    data = {**json.loads(record.to_json()), **change}
    with pytest.raises(ValueError, match=r"accepted|=") as error:
        EpisodeRecord.from_json(json.dumps(data))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("line", ["", "{", "[]", "3"])
def test_what_is_no_record_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"not JSON|schema = None"):
        EpisodeRecord.from_json(line)
