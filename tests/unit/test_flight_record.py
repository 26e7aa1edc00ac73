from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.files import append_lines, read_lines
from airl_mav.flight.episode_record import SCHEMA, EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Quality
from tests.support.run_demo import demo_arena, demo_episode

QUALITY_DEFAULTS = {field.name for field in fields(Quality) if field.default is None}


@pytest.fixture(scope="module")
def record() -> EpisodeRecord:
    return demo_episode(2, demo_arena(3))[0]


def test_lines_read_back_as_they_were(record: EpisodeRecord, tmp_path: Path) -> None:
    versions = [
        record,
        replace(record, quality=None, navigation_us=None, wall_s=None, battery_remaining=None),
        replace(record, outcome=Outcome.ABORTED, reason='a "line"\nbreak, ü', notes=()),
    ]
    path = tmp_path / "episodes.jsonl"
    append_lines(path, (version.as_data() for version in versions))
    lines = list(read_lines(path, SCHEMA))
    assert [EpisodeRecord.from_data(data, place) for place, data in lines] == versions
    assert [place for place, _ in lines] == [f"{path}:{number}" for number in (1, 2, 3)]


def test_the_line_is_plain_json(record: EpisodeRecord) -> None:
    data = json.loads(json.dumps(record.as_data()))
    assert data["schema"] == 1
    assert data["outcome"] == record.outcome.value
    assert record.quality is not None
    assert data["quality"]["distance_m"] == record.quality.distance_m


def test_a_line_of_an_older_run_lacks_what_it_was_recorded_without(record: EpisodeRecord) -> None:
    data = json.loads(json.dumps(record.as_data()))
    later = [name for name in data["quality"] if name in QUALITY_DEFAULTS]
    assert {"endurance_s", "deadline_misses", "command_step_max_m_s"} <= set(later)
    for name in later:
        del data["quality"][name]
    old = EpisodeRecord.from_data(data, "here")
    assert old.quality is not None
    assert {getattr(old.quality, name) for name in later} == {None}
    assert old.quality.energy_j == data["quality"]["energy_j"]


def test_no_nan_is_written(record: EpisodeRecord, tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    with pytest.raises(ValueError, match="JSON compliant"):
        append_lines(path, [replace(record, battery_remaining=float("nan")).as_data()])
    assert not path.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outcome": "won"}, "here: outcome = 'won'"),
        ({"goal": [1.0]}, "here: goal"),
        ({"seed": "many"}, "here: seed = 'many': accepted: a whole number"),
    ],
)
def test_a_foreign_line_is_refused(
    record: EpisodeRecord, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError) as error:
        EpisodeRecord.from_data({**record.as_data(), **change}, "here")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
