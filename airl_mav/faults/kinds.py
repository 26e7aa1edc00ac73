"""Table of all faults: parts, kinds and amounts.

A fault is a part and a kind: `gps off`, `motor2 weak`. Each kind defines its amount's meaning, unit
and range, and the fidelity levels that support the fault.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from airl_mav.core.constants import GRAVITY_M_S2

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
        return limits if self.width == 1 else f"three numbers, {limits}"


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
