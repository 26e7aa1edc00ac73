"""Fields: declared once, and wrong input gets one line that names field, value and range."""

from __future__ import annotations

import copy
import math
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, ValidationError

from airl_mav.core.errors import FieldError, UsageError, shown
from airl_mav.core.fields import (
    ProfileModel,
    field_error,
    later_field,
    quantity,
    range_of,
    validated,
)


class Inner(ProfileModel):
    share: float = quantity("a share", "1", ge=0, le=1, default=0.5)
    limit_s: float | None = quantity("a limit", "s", gt=0, le=2**31, default=None)


class Outer(ProfileModel):
    seed: int = quantity("a seed", "1", ge=0, le=2**31)
    level: Literal["gym", "sitl"] = "gym"
    name: str = "x"
    inner: Inner = Field(default_factory=Inner)
    speed: Annotated[float, Field(gt=0, le=100)] | Literal["max"] = 1.0
    places: tuple[float, float] = (0.0, 0.0)


class Grown(Inner):
    kind: str = later_field("plain", "a kind")
    inner: Inner = later_field(Inner, "a table")
    turn_deg: float = quantity("a turn", "deg", ge=-180, le=180, default=0.0, later=True)


@pytest.mark.parametrize(
    ("data", "line"),
    [
        ({"seed": -1}, "seed -1: accepted: 0 <= value <= 2147483648"),
        ({"seed": 1.5}, "seed 1.5: accepted: 0 <= value <= 2147483648"),
        ({"seed": True}, "seed True: accepted: 0 <= value <= 2147483648"),
        ({"seed": "1"}, "seed '1': accepted: 0 <= value <= 2147483648"),
        ({"seed": 10**6000}, "seed a number of too many digits: accepted: 0 <= value <= 2**31"),
        ({}, "seed: missing"),
        ({"seed": 1, "sed": 1}, "sed: unknown field; did you mean 'seed'?"),
        ({"seed": 1, "q": 1}, "q: unknown field; fields: seed, level, name, inner, speed, places"),
        ({"seed": 1, "level": "hil"}, "level 'hil': accepted: 'gym' or 'sitl'"),
        ({"seed": 1, "name": 3}, "name 3: accepted: a text"),
        ({"seed": 1, "inner": 3}, "inner 3: accepted: a table with the fields share, limit_s"),
        ({"seed": 1, "inner": {"share": math.nan}}, "inner.share nan: accepted: 0 <= value <= 1"),
        ({"seed": 1, "inner": {"limit_s": 0.0}}, "inner.limit_s 0: accepted: 0 < value <= 2**31 s"),
        ({"seed": 1, "speed": 0.0}, "speed 0: accepted: 0 < value <= 100 or 'max'"),
        ({"seed": 1, "speed": "fast"}, "speed 'fast': accepted: 0 < value <= 100 or 'max'"),
        ({"seed": 1, "places": [1.0, "x"]}, "places.1 'x': accepted: a number"),
        ({"seed": -1, "level": "x"}, "seed -1: accepted: 0 <= value <= 2147483648 (and 1 more)"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value[:40],
)  # fmt: skip
def test_wrong_input_gets_one_line(data: dict[str, Any], line: str) -> None:
    with pytest.raises(FieldError) as caught:
        validated(Outer, data)
    assert str(caught.value) == line.replace("2**31", "2147483648")
    with pytest.raises(UsageError) as about_file:
        validated(Outer, data, "mine.toml")
    assert str(about_file.value).startswith("mine.toml: ")


def test_field_error_keeps_the_field_apart() -> None:
    with pytest.raises(ValidationError) as caught:
        Outer.model_validate({"seed": 1, "inner": {"share": 2.0}})
    error = field_error(caught.value, Outer)
    assert (error.field, error.value, error.accepted) == ("inner.share", 2.0, "0 <= value <= 1")
    assert error.line("--share") == "--share 2: accepted: 0 <= value <= 1"
    assert error.line(sign=" = ") == "inner.share = 2: accepted: 0 <= value <= 1"
    again = copy.copy(error)  # As a worker process sends it.
    assert (str(again), again.field) == (str(error), "inner.share")


def test_optional_numbers_take_none_and_whole_numbers() -> None:
    assert Inner(limit_s=None).limit_s is None
    assert Inner.model_validate({"limit_s": 3}).limit_s == 3.0
    assert range_of(Inner.model_fields["limit_s"]) == "0 < value <= 2147483648 s"


def test_fields_that_came_later_leave_dumps_as_they_were() -> None:
    assert Grown().model_dump_json() == Inner().model_dump_json()
    asked: dict[str, Any] = {"kind": "plain", "inner": {"share": 0.5}, "turn_deg": 0}
    assert Grown.model_validate(asked).model_dump() == Inner().model_dump()
    changed = Grown(kind="round", inner=Inner(share=0.25), turn_deg=1.0)
    assert Grown.model_validate_json(changed.model_dump_json()) == changed


def test_shown_values_are_short() -> None:
    assert shown(0.1) == "0.1"
    assert shown(1 / 3) == repr(1 / 3)
    assert len(shown("x" * 10**6)) <= 80
    assert len(shown([[i] * 100 for i in range(1000)])) <= 80
