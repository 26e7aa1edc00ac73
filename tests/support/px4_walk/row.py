"""One call and PX4's answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.support.px4_walk.vehicle import RefusedError, Vehicle

OK = "ok"
"""The call succeeds."""


@dataclass(frozen=True)
class Row:
    """A call, with the outcome that a real PX4 has."""

    area: str
    call: str
    make: Callable[[Vehicle], Any]
    """Makes the call and returns what it returns; raises what MAVSDK raises."""
    expected: tuple[str, ...] = (OK,)
    """Outcomes that agree: `OK`, or names of MAVSDK's results. The first is PX4's."""
    check: Callable[[Any], bool] | None = None
    """Check of the returned value."""
    slow: bool = False
    """True if the call takes seconds of wall time, on a real PX4 too: MAVSDK waits."""

    @property
    def name(self) -> str:
        """Area and call."""
        return f"{self.area}: {self.call}"


@dataclass(frozen=True)
class Answer:
    """Answer of a vehicle to a row."""

    row: Row
    outcome: str
    value: Any = None

    @property
    def agrees(self) -> bool:
        """True if the answer matches PX4's."""
        if self.outcome not in self.row.expected:
            return False
        return self.outcome != OK or self.row.check is None or self.row.check(self.value)


def answered(row: Row, vehicle: Vehicle) -> Answer:
    """Make a row's call."""
    try:
        return Answer(row, OK, row.make(vehicle))
    except RefusedError as refused:
        return Answer(row, refused.outcome)
    except Exception as error:  # MAVSDK's errors have one class for each plugin
        return Answer(row, str(error).split(";")[0].strip() or type(error).__name__)
