"""One fault of a flight: what fails, how, how much, from when and for how long."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import Field, field_validator, model_validator

from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, optional, quantity
from airl_mav.faults.kinds import KINDS, LINKS, Kind, Part, Phase, fault_text, kinds_of, read_fault

LONGEST_S = 100_000.0


class Fault(ProfileModel):
    """A fault, as a table of a scenario file: `[[faults]]`, or in words, as `gps off at 8s for 5s`.

    Raises ValueError if the words, or the fields together, describe no fault (as pydantic has it).
    """

    part: Part = Field(description="what fails")
    kind: str = Field(description="how it fails; each part has kinds of its own")
    value: tuple[float, ...] = Field(
        default=(), description="how much, in the unit of the kind: one number, or three"
    )
    phase: Phase | None = optional(
        "phase of the flight that sets it off when it begins for the first time; by"
        " default the start of the episode"
    )
    at_s: float = quantity(
        "simulated time from the start of the episode, or of the phase, until it begins",
        "s",
        ge=0,
        le=LONGEST_S,
        default=0.0,
    )
    for_s: float | None = quantity(
        "how long it lasts, in simulated time; by default to the end of the flight",
        "s",
        gt=0,
        le=LONGEST_S,
        default=None,
    )

    @model_validator(mode="before")
    @classmethod
    def _of_words(cls, data: Any) -> Any:
        """Accept a fault that is written in words."""
        return read_fault(data) if isinstance(data, str) else data

    @field_validator("value", mode="before")
    @classmethod
    def _of_one_number(cls, value: Any) -> Any:
        """Accept one number where a list of one is meant."""
        return (value,) if isinstance(value, int | float) else value

    @model_validator(mode="after")
    def _is_a_fault(self) -> Fault:
        if (self.part, self.kind) not in KINDS:
            known = ", ".join(kinds_of(self.part))
            raise ValueError(f"kind {self.kind!r} of {self.part}: accepted: {known}")
        name, about = f"{self.part} {self.kind}", self.about
        amount = about.amount
        if amount is None and self.value:
            raise ValueError(f"value of {name}: it has no amount")
        if amount is not None:
            numbers = self.value
            if len(numbers) != amount.width or not all(
                math.isfinite(v) and amount.low <= v <= amount.high for v in numbers
            ):
                given = ",".join(f"{v:g}" for v in numbers) or "none"
                raise ValueError(
                    f"value of {name}, {amount.meaning}, {given}: accepted: {amount.accepted}"
                )
        if self.for_s is not None and not about.lasts:
            raise ValueError(f"for_s of {name}: it happens once, without a duration")
        if self.for_s is None and about.needs_duration:
            raise ValueError(f"for_s of {name}: missing; it has a duration")
        return self

    @property
    def about(self) -> Kind:
        """What the table says of it."""
        return KINDS[self.part, self.kind]

    @property
    def for_good(self) -> bool:
        """Whether nothing comes after it in a flight: a process that does not go on."""
        return self.kind == "killed" or (self.kind == "stopped" and self.for_s is None)

    @property
    def amount(self) -> float:
        """The one number of its value. Raises ValueError where it has none, or three."""
        (number,) = self.value
        return number

    def __str__(self) -> str:
        """Return it in words that read as the same fault."""
        told: Mapping[str, Any] = self.model_dump()
        return fault_text(told)


def link_fails(faults: Iterable[Fault]) -> bool:
    """Return whether any of these is a fault of the link between companion and firmware."""
    return any(fault.part in LINKS for fault in faults)


# --- faults that the batch twin can fly; its flights begin where the policy takes over

TWIN = "gym"
"""The batch twin's rung of the fidelity ladder."""


def check_twin(faults: Sequence[Fault], *, pipelined: bool = False) -> None:
    """Raise FieldError for a fault that the twin cannot fly, with decisions `pipelined` or not."""
    for fault in faults:
        levels = fault.about.levels
        if TWIN not in levels:
            raise FieldError("faults", str(fault), f"at level {' or '.join(levels)}")
        if not _in_flight(fault):
            raise FieldError("faults", str(fault), "at offboard, or offboard+TIME, at level gym")
        if pipelined and fault.kind == "delay":
            accepted = "with decisions sequential, or at level lockstep or sitl"
            raise FieldError("faults", str(fault), accepted)
    late = [fault for fault in faults if (fault.part, fault.kind) == ("camera", "delay")]
    if len(late) > 1:
        raise FieldError("faults", str(late[1]), "one delay of the camera at level gym")


def _in_flight(fault: Fault) -> bool:
    """Return whether it begins in the flight, or has acted since before it.

    What ends before the policy takes over was never there. Neither was the picture of the ground.
    """
    from_the_start = fault.phase is None and not fault.at_s and fault.for_s is None
    return fault.phase == "offboard" or (from_the_start and fault.kind != "stuck")
