"""Fault of a flight: part, kind, amount, start and duration."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

from pydantic import Field, field_validator, model_validator

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, optional, quantity
from airl_mav.faults.kinds import (
    KINDS,
    LINKS,
    MOTORS,
    Amount,
    Kind,
    Part,
    Phase,
    kind_of,
    kinds_of,
)

LONGEST_S = 100_000.0


class Fault(ProfileModel):
    """Fault as a table of a scenario file, `[[faults]]`, or as text: `gps off at 8s for 5s`.

    Raises pydantic's ValueError if the text, or the fields together, are no valid fault.
    """

    part: Part = Field(description="faulty part")
    kind: str = Field(description="kind of fault; each part has its kinds")
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
        """Accept a fault written as text."""
        return read_fault(data) if isinstance(data, str) else data

    @field_validator("value", mode="before")
    @classmethod
    def _of_one_number(cls, value: Any) -> Any:
        """Accept one number in place of a list of one."""
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
                listed = ",".join(f"{v:g}" for v in numbers) or "none"
                raise ValueError(
                    f"value of {name}, {amount.meaning}, {listed}: accepted: {amount.accepted}"
                )
        if self.for_s is not None and not about.lasts:
            raise ValueError(f"for_s of {name}: it happens once, without a duration")
        if self.for_s is None and about.needs_duration:
            raise ValueError(f"for_s of {name}: missing; it has a duration")
        return self

    @property
    def about(self) -> Kind:
        """Return the table entry of the fault."""
        return KINDS[self.part, self.kind]

    @property
    def for_good(self) -> bool:
        """Return True if the fault ends a process for the rest of the flight."""
        return self.kind == "killed" or (self.kind == "stopped" and self.for_s is None)

    @property
    def amount(self) -> float:
        """Return a single-number value. Raises ValueError for none or several."""
        (number,) = self.value
        return number

    def __str__(self) -> str:
        """Return the fault as text that parses into the same fault."""
        return fault_text(self.model_dump())


def link_fails(faults: Iterable[Fault]) -> bool:
    """Return True if any fault affects the link between companion and firmware."""
    return any(fault.part in LINKS for fault in faults)


# --- faults supported by the vectorized simulator; its flights begin at the policy's takeover

TWIN = "gym"
"""Fidelity level of the vectorized simulator."""


def check_twin(faults: Sequence[Fault], *, pipelined: bool = False) -> None:
    """Raise FieldError for a fault that the vectorized simulator does not support."""
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
    """Return True if it begins in the flight, or acts since before the flight.

    A fault that ends before the policy takes over has no effect, nor does a picture of the ground.
    """
    from_the_start = fault.phase is None and not fault.at_s and fault.for_s is None
    return fault.phase == "offboard" or (from_the_start and fault.kind != "stuck")


FOREVER_US = 1 << 62
"""End of a fault without an end [µs]."""


def window_us(fault: Fault, entered_us: Mapping[str, int]) -> tuple[int, int] | None:
    """Return start and end, excluded, of a fault [µs since the start of the episode].

    `entered_us` is the first start of each flight phase. Returns None before the fault's phase.
    """
    origin_us = 0 if fault.phase is None else entered_us.get(fault.phase)
    if origin_us is None:
        return None
    begin_us = origin_us + round(fault.at_s * US_PER_S)
    if fault.part == "firmware":
        return begin_us, begin_us + TICK_US  # Suspends simulated time too.
    if fault.for_s is None:
        return begin_us, FOREVER_US
    return begin_us, begin_us + max(1, round(fault.for_s * US_PER_S))


def active(
    faults: Sequence[Fault], time_us: int, entered_us: Mapping[str, int]
) -> dict[int, tuple[int, int]]:
    """Return start and end of the faults active at a time, by index; see `window_us`."""
    windows = ((i, window_us(fault, entered_us)) for i, fault in enumerate(faults))
    return {i: at for i, at in windows if at is not None and at[0] <= time_us < at[1]}


def next_change_us(faults: Sequence[Fault], time_us: int, entered_us: Mapping[str, int]) -> int:
    """Return the next start or end of a fault after a time, `FOREVER_US` for never [µs].

    Phases that have not begun are ignored.
    """
    edges = (
        edge
        for fault in faults
        if (at := window_us(fault, entered_us)) is not None
        for edge in at
        if edge > time_us
    )
    return min(edges, default=FOREVER_US)


def gust_share(elapsed_s: float, duration_s: float) -> float:
    """Return the strength of a discrete gust, 0 to 1, at a time after its start [s].

    (1 - cos(2 pi t / T)) / 2: up to its peak and down again (MIL-F-8785C, 3.7.1.3, discrete gusts).
    """
    if not 0.0 <= elapsed_s <= duration_s:
        return 0.0
    return 0.5 * (1.0 - math.cos(2.0 * math.pi * elapsed_s / duration_s))


# --- faults as text: `gps off at 8s for 5s`, `motor2 weak 60% at offboard+2s`
#
#     FAULT  = PART KIND [AMOUNT] [at WHEN] [for TIME]
#     AMOUNT = NUMBER[,NUMBER,NUMBER][ ][UNIT]
#     WHEN   = TIME | PHASE | PHASE+TIME
#     TIME   = NUMBER s | NUMBER ms

PARTS: tuple[str, ...] = get_args(Part)

PHASES: tuple[str, ...] = get_args(Phase)

KIND_WORDS = {
    "lost": "off",
    "loss": "off",
    "frozen": "stuck",
    "noisy": "noise",
    "biased": "bias",
    "jump": "bias",
    "delayed": "delay",
    "late": "delay",
}
"""Synonyms of kinds, used only if the part has no kind with this name."""

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"

_AMOUNT = re.compile(rf"({_NUMBER}(?:,{_NUMBER})*)(.*)")

_TIME = re.compile(rf"({_NUMBER})(ms|s)")

_MS_PER_S = 1000.0


def read_fault(text: str) -> dict[str, Any]:
    """Return the fields of a fault text. Raises ValueError with position and accepted words."""
    words = text.split()
    if len(words) > 1 and words[0] == "motor" and f"motor{words[1]}" in MOTORS:
        words = [f"motor{words[1]}", *words[2:]]
    if not words or words[0] not in PARTS:
        raise ValueError(f"{text!r}: no such part; accepted: {', '.join(PARTS)}")
    part = words[0]
    known = kinds_of(part)
    kind = words[1] if len(words) > 1 else ""
    kind = kind if kind in known else KIND_WORDS.get(kind, kind)
    about = kind_of(part, kind)
    if about is None:
        raise ValueError(f"{text!r}: no such fault of {part}; accepted: {', '.join(known)}")
    rest = words[2:]
    cut = next((i for i, word in enumerate(rest) if word in ("at", "for")), len(rest))
    fields: dict[str, Any] = {"part": part, "kind": kind}
    if cut:
        if about.amount is None:
            raise ValueError(f"{text!r}: {''.join(rest[:cut])!r}: {part} {kind} has no amount")
        fields["value"] = _amount("".join(rest[:cut]), about.amount, text)
    clauses = rest[cut:]
    while clauses:
        word, token, clauses = clauses[0], clauses[1:2], clauses[2:]
        if word not in ("at", "for") or not token:
            raise ValueError(f"{text!r}: {word!r}: accepted: at TIME, at PHASE+TIME, for TIME")
        more = _when(token[0], text) if word == "at" else {"for_s": _time(token[0], text)}
        if set(more) & set(fields):
            raise ValueError(f"{text!r}: {word!r} stands twice")
        fields |= more
    return fields


def fault_text(fields: Mapping[str, Any]) -> str:
    """Return a fault as text that `read_fault` parses into the same fields."""
    part, kind = fields["part"], fields["kind"]
    words = [part, kind]
    amount = KINDS[part, kind].amount
    if fields["value"] and amount is not None:
        words.append(_amount_text(fields["value"], amount))
    begins = f"{_numbers([fields['at_s']])}s"
    if fields["phase"] is not None:
        words += ["at", fields["phase"] + (f"+{begins}" if fields["at_s"] else "")]
    elif fields["at_s"]:
        words += ["at", begins]
    if fields["for_s"] is not None:
        words += ["for", f"{_numbers([fields['for_s']])}s"]
    return " ".join(words)


def _amount_text(values: Sequence[float], amount: Amount) -> str:
    """Return an amount in the stored unit, or in a unit in which six digits are exact."""
    for unit, factor in [(amount.unit, 1.0), *amount.units.items()]:
        text = ",".join(f"{v / factor:g}" for v in values) + unit
        if _amount(text, amount, text) == list(values):
            return text
    return _numbers(values) + amount.unit


def _numbers(values: Sequence[float]) -> str:
    """Return numbers in their shortest exact form."""
    return ",".join(f"{v:g}" if float(f"{v:g}") == v else repr(v) for v in values)


def _amount(token: str, amount: Amount, text: str) -> list[float]:
    found = _AMOUNT.fullmatch(token)
    if found is None or found[2] not in amount.units:
        accepted = ", ".join(unit or "no unit" for unit in amount.units)
        raise ValueError(
            f"{text!r}: {token!r}: accepted: {amount.accepted}, written with {accepted}"
        )
    factor = amount.units[found[2]]
    numbers = [float(number) for number in found[1].split(",")]
    if factor == 1.0:
        return numbers
    # Rounded to the written decimal: 95 * 0.01 is not 0.95.
    return [float(f"{number * factor:.15g}") for number in numbers]


def _when(token: str, text: str) -> dict[str, Any]:
    phase, _, later = token.partition("+")
    if phase in PHASES:
        return {"phase": phase, "at_s": _time(later, text) if later else 0.0}
    if _TIME.fullmatch(token) is None:
        raise ValueError(
            f"{text!r}: at {token!r}: accepted: a time as 8s or 500ms, or a phase"
            f" ({', '.join(PHASES)}), also with a time as hold+2s"
        )
    return {"at_s": _time(token, text)}


def _time(token: str, text: str) -> float:
    found = _TIME.fullmatch(token)
    if found is None or not math.isfinite(float(found[1])):
        raise ValueError(f"{text!r}: {token!r}: accepted: a time as 8s or 500ms")
    return float(found[1]) / (_MS_PER_S if found[2] == "ms" else 1.0)
