"""Faults in words: `gps off at 8s for 5s`, `motor2 weak 60% at offboard+2s`.

    FAULT  = PART KIND [AMOUNT] [at WHEN] [for TIME]
    AMOUNT = NUMBER[,NUMBER,NUMBER][ ][UNIT]
    WHEN   = TIME | PHASE | PHASE+TIME
    TIME   = NUMBER s | NUMBER ms

A part or kind may be written as in the right-hand column of `PART_WORDS` and `KIND_WORDS`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from airl_mav.faults.kinds import KINDS, MOTORS, Amount, Part, Phase, kind_of, kinds_of

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
"""Other words for kinds; only where the part has no kind of that very name."""

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_AMOUNT = re.compile(rf"({_NUMBER}(?:,{_NUMBER})*)(.*)")
_TIME = re.compile(rf"({_NUMBER})(ms|s)")
_MS_PER_S = 1000.0


def read_fault(text: str) -> dict[str, Any]:
    """Return the fields of a fault that is written in words.

    Raises:
        ValueError: It cannot be read; one line that says where, and what is accepted.
    """
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
        word, said, clauses = clauses[0], clauses[1:2], clauses[2:]
        if word not in ("at", "for") or not said:
            raise ValueError(f"{text!r}: {word!r}: accepted: at TIME, at PHASE+TIME, for TIME")
        more = _when(said[0], text) if word == "at" else {"for_s": _time(said[0], text)}
        if set(more) & set(fields):
            raise ValueError(f"{text!r}: {word!r} stands twice")
        fields |= more
    return fields


def fault_text(fields: Mapping[str, Any]) -> str:
    """Return a fault in words that `read_fault` reads as the same fields."""
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
    """Return an amount in its own unit, or in the one in which six digits say it exactly."""
    for unit, factor in [(amount.unit, 1.0), *amount.units.items()]:
        text = ",".join(f"{v / factor:g}" for v in values) + unit
        if _amount(text, amount, text) == list(values):
            return text
    return _numbers(values) + amount.unit


def _numbers(values: Sequence[float]) -> str:
    """Return numbers as short as they can be read back exactly."""
    return ",".join(f"{v:g}" if float(f"{v:g}") == v else repr(v) for v in values)


def _amount(said: str, amount: Amount, text: str) -> list[float]:
    found = _AMOUNT.fullmatch(said)
    if found is None or found[2] not in amount.units:
        accepted = ", ".join(unit or "no unit" for unit in amount.units)
        raise ValueError(
            f"{text!r}: {said!r}: accepted: {amount.accepted}, written with {accepted}"
        )
    factor = amount.units[found[2]]
    numbers = [float(number) for number in found[1].split(",")]
    if factor == 1.0:
        return numbers
    # Rounded to what a person wrote: 95 * 0.01 is not 0.95.
    return [float(f"{number * factor:.15g}") for number in numbers]


def _when(said: str, text: str) -> dict[str, Any]:
    phase, _, later = said.partition("+")
    if phase in PHASES:
        return {"phase": phase, "at_s": _time(later, text) if later else 0.0}
    if _TIME.fullmatch(said) is None:
        raise ValueError(
            f"{text!r}: at {said!r}: accepted: a time as 8s or 500ms, or a phase"
            f" ({', '.join(PHASES)}), also with a time as hold+2s"
        )
    return {"at_s": _time(said, text)}


def _time(said: str, text: str) -> float:
    found = _TIME.fullmatch(said)
    if found is None or not math.isfinite(float(found[1])):
        raise ValueError(f"{text!r}: {said!r}: accepted: a time as 8s or 500ms")
    return float(found[1]) / (_MS_PER_S if found[2] == "ms" else 1.0)
