"""Faults of a flight: table of parts, kinds and amounts; schedule and text format.

A fault is a part and a kind: `gps off`, `motor2 weak`. Each kind defines its amount's meaning, unit
and range, and the fidelity levels that support the fault.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from airl_mav.core.constants import GRAVITY_M_S2, TICK_US, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, optional, quantity

Part = Literal[
    "accel",
    "gyro",
    "mag",
    "baro",
    "gps",
    "vision",
    "rangefinder",
    "flow",
    "motor1",
    "motor2",
    "motor3",
    "motor4",
    "battery",
    "wind",
    "camera",
    "link",
    "uplink",
    "downlink",
    "companion",
    "firmware",
]
"""Part that fails. Motors use PX4's order: 1 front right, 2 rear left, 3 front left, 4 rear right.
`uplink` is from the companion to the flight controller, `downlink` the reverse, `link` both.
`companion` and `firmware` are the processes of a rehearsal."""

Phase = Literal["ground", "climb", "hold", "offboard", "mission", "return", "landing"]
"""Flight phase that can trigger a fault, by the flight controller's mode."""

SENSORS: tuple[Part, ...] = (
    *("accel", "gyro", "mag", "baro", "gps"),
    *("vision", "rangefinder", "flow"),
)
MOTORS: tuple[Part, ...] = ("motor1", "motor2", "motor3", "motor4")
LINKS: tuple[Part, ...] = ("link", "uplink", "downlink")
PROCESSES: tuple[Part, ...] = ("companion", "firmware")

ANY_LEVEL = ("gym", "lockstep", "sitl")
WITH_FIRMWARE = ("lockstep", "sitl")
"""Levels with firmware; the vectorized simulator lacks these parts."""
WITH_PROCESSES = ("sitl",)
"""Levels where the firmware is a separate process."""

_SECONDS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3}
_SHARE: Mapping[str, float] = {"": 1.0, "%": 0.01}
_TIMES: Mapping[str, float] = {"": 1.0, "x": 1.0}


@dataclass(frozen=True)
class Amount:
    """Amount of a fault: one number, or several along the axes."""

    meaning: str
    unit: str
    """Stored unit of the numbers; "" = no unit."""
    low: float
    high: float
    """Minimum and maximum."""
    units: Mapping[str, float]
    """Accepted units, each with its factor to the stored unit."""
    width: int = 1
    """Number of values: 1, 2 or 3."""

    @property
    def accepted(self) -> str:
        """Return the accepted range as text: "three numbers, -100 <= value <= 100 m"."""
        limits = f"{self.low:g} <= value <= {self.high:g}" + (f" {self.unit}" if self.unit else "")
        counts = {1: "", 2: "two numbers, ", 3: "three numbers, "}
        return f"{counts[self.width]}{limits}"


@dataclass(frozen=True)
class Kind:
    """Failure mode of a part."""

    meaning: str
    amount: Amount | None = None
    """Amount; None: no amount."""
    lasts: bool = True
    """True if it can have a duration; False: it happens once and stays."""
    needs_duration: bool = False
    levels: tuple[str, ...] = WITH_FIRMWARE
    """Fidelity levels at which it acts."""


@dataclass(frozen=True)
class _Sensor:
    """Units and bounds of a sensor's faults."""

    unit: str
    bias: float
    """Maximum bias."""
    units: Mapping[str, float]
    width: int = 3
    off: str = "it measures nothing any more"
    bias_meaning: str = "is added to what it measures"
    more: Mapping[str, Kind] = field(default_factory=dict)


_IMU_OFF = "its last sample is repeated: flight controllers count time by its samples"
_METRES = {"m": 1.0}

_DRIFT = {
    "drift": Kind(
        "the position drifts away from the true one, and is right again at the end",
        Amount("velocity, north, east, down", "m/s", -100.0, 100.0, {"m/s": 1.0}, 3),
    )
}

_SENSORS: Mapping[Part, _Sensor] = {
    "accel": _Sensor("m/s2", 100.0, {"m/s2": 1.0, "g": GRAVITY_M_S2}, off=_IMU_OFF),
    "gyro": _Sensor("rad/s", 35.0, {"rad/s": 1.0, "deg/s": math.pi / 180.0}, off=_IMU_OFF),
    "mag": _Sensor("gauss", 10.0, {"gauss": 1.0, "uT": 0.01}),
    "baro": _Sensor("hPa", 500.0, {"hPa": 1.0, "Pa": 0.01}, width=1),
    "gps": _Sensor(
        "m",
        100_000.0,
        _METRES,
        bias_meaning="is added to the position, north, east, down: a jump",
        more=_DRIFT,
    ),
    "vision": _Sensor(
        "m",
        100_000.0,
        _METRES,
        off="it tells no poses any more",
        bias_meaning="is added to the position, in the frame of the start: a jump that is not told",
        more=_DRIFT,
    ),
    "rangefinder": _Sensor(
        "m",
        1_000.0,
        _METRES,
        width=1,
        off="it tells no ranges any more",
        bias_meaning="is added to the range",
    ),
    "flow": _Sensor(
        "rad/s",
        35.0,
        {"rad/s": 1.0, "deg/s": math.pi / 180.0},
        width=2,
        off="it tells no optical flow any more",
        bias_meaning="is added to the flow about x and y",
    ),
}


def _sensor_kinds(part: Part, sensor: _Sensor) -> dict[tuple[Part, str], Kind]:
    bias = Amount(
        sensor.bias_meaning, sensor.unit, -sensor.bias, sensor.bias, sensor.units, sensor.width
    )
    kinds = {
        "off": Kind(sensor.off),
        "stuck": Kind("it repeats its last sample"),
        "noise": Kind(
            "white noise of this many times the standard deviation that it has",
            Amount("factor", "", 1.0, 1000.0, _TIMES),
        ),
        "bias": Kind("what it measures is off by this much", bias),
        "delay": Kind("its samples come later", Amount("by how much", "s", 0.0, 10.0, _SECONDS)),
        **sensor.more,
    }
    return {(part, kind): what for kind, what in kinds.items()}


_LINK_KINDS = {
    "delay": Kind("frames come later", Amount("by how much", "s", 0.0, 60.0, _SECONDS)),
    "jitter": Kind(
        "each frame comes later by a time of its own, uniform from 0; their order is kept",
        Amount("at most by how much", "s", 0.0, 60.0, _SECONDS),
    ),
    "loss": Kind("frames are lost", Amount("share of them", "", 0.0, 1.0, _SHARE)),
    "duplicate": Kind("frames come twice", Amount("share of them", "", 0.0, 1.0, _SHARE)),
    "reorder": Kind(
        "frames change places with the one after them",
        Amount("share of them", "", 0.0, 1.0, _SHARE),
    ),
    "cut": Kind("nothing gets through"),
}
_MOTOR_KINDS = {
    "off": Kind("it stops, whatever it is told"),
    "weak": Kind(
        "its thrust is less than it should be",
        Amount("share of the thrust that is left", "", 0.0, 1.0, _SHARE),
    ),
    "mismatch": Kind(
        "its thrust is more or less than the others' by a constant share, up to its greatest one:"
        " another propeller, a speed controller that is not calibrated",
        Amount("share that it has more; less where negative", "", -0.9, 1.0, _SHARE),
    ),
    "slow": Kind(
        "it changes its speed more slowly",
        Amount("factor of its time constant", "", 1.0, 100.0, _TIMES),
    ),
}
_OTHER_KINDS: dict[tuple[Part, str], Kind] = {
    ("battery", "off"): Kind("the power module reads an empty battery; the motors go on"),
    ("battery", "drop"): Kind(
        "charge is gone at once",
        Amount("share of a full battery", "", 0.0, 1.0, _SHARE),
        lasts=False,
    ),
    ("battery", "sag"): Kind(
        "the voltage that is read is lower",
        Amount("by how much, a cell", "V", 0.0, 5.0, {"V": 1.0}),
    ),
    ("wind", "gust"): Kind(
        "a discrete gust: up and down again as 1 - cos over its duration",
        Amount("greatest velocity, north, east, down", "m/s", -50.0, 50.0, {"m/s": 1.0}, 3),
        needs_duration=True,
        levels=ANY_LEVEL,
    ),
    ("wind", "step"): Kind(
        "more wind, at once",
        Amount("velocity, north, east, down", "m/s", -50.0, 50.0, {"m/s": 1.0}, 3),
        levels=ANY_LEVEL,
    ),
    ("camera", "off"): Kind("no frames"),
    ("camera", "stuck"): Kind("every frame shows the same picture", levels=ANY_LEVEL),
    ("camera", "noise"): Kind(
        "noise of the depth, growing with its square as of a stereo camera",
        Amount("sd at 10 m as a share", "", 0.0, 0.9, _SHARE),
        levels=ANY_LEVEL,
    ),
    ("camera", "delay"): Kind(
        "frames come later",
        Amount("by how much", "s", 0.0, 60.0, _SECONDS),
        levels=ANY_LEVEL,
    ),
    ("companion", "stopped"): Kind("it is suspended (SIGSTOP), and resumed at the end (SIGCONT)"),
    ("companion", "killed"): Kind("it ends at once (SIGKILL)", lasts=False),
    ("firmware", "stopped"): Kind(
        "flight controller and plant are suspended (SIGSTOP), and simulated time with them",
        levels=WITH_PROCESSES,
    ),
    ("firmware", "killed"): Kind("it ends at once (SIGKILL)", lasts=False, levels=WITH_PROCESSES),
}
KINDS: Mapping[tuple[Part, str], Kind] = {
    **{k: v for part, sensor in _SENSORS.items() for k, v in _sensor_kinds(part, sensor).items()},
    **{(part, kind): what for part in MOTORS for kind, what in _MOTOR_KINDS.items()},
    **_OTHER_KINDS,
    **{(part, kind): what for part in LINKS for kind, what in _LINK_KINDS.items()},
    # The vectorized simulator has delayed setpoints, but no telemetry or commands.
    ("uplink", "delay"): replace(_LINK_KINDS["delay"], levels=ANY_LEVEL),
}
"""All faults, by part and kind."""

NOISE_SEED = 1 << 32
"""Multiplied by a camera noise fault's number, from 1, and added to the episode's seed, so that its
noise differs from the healthy camera's."""


def kind_of(part: str, kind: str) -> Kind | None:
    """Return the entry of a fault; None for an unknown fault."""
    return next((what for known, what in KINDS.items() if known == (part, kind)), None)


def kinds_of(part: str) -> tuple[str, ...]:
    """Return the kinds of a part; empty for an unknown part."""
    return tuple(kind for known, kind in KINDS if known == part)


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

GYM = "gym"
"""Fidelity level of the vectorized simulator."""


def check_gym(faults: Sequence[Fault], *, pipelined: bool = False) -> None:
    """Raise FieldError for a fault that the vectorized simulator does not support."""
    for fault in faults:
        levels = fault.about.levels
        if GYM not in levels:
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
