"""`airl conformance`: check any flight controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field
from rich.console import Console

from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.progress import new_console
from airl_mav.rehearsal.signals import terminated_as_interrupted


class ConformanceOptions(BaseModel):
    """Fly any flight controller through checks and step responses: airl-firmware, PX4, ArduPilot.

    Works with SITL or a board. The vehicle takes off. A complete run needs 60 m to the north, 20 m
    to the east and 15 m above the take-off altitude; Ctrl-C lands. Exit status 1: a check failed.

    Examples:
        airl-firmware --arena open-field
        airl conformance --connect udpin://127.0.0.1:14540 --out result.json
    """

    connect: str = Field(
        default="udpin://127.0.0.1:14540",
        description="MAVSDK connection to the flight controller: udpin://HOST:PORT or"
        " serial://DEVICE:BAUD",
    )
    reference: str = Field(
        default="auto",
        description="stored step responses to compare with: auto (by the autopilot that is heard),"
        " px4, ardupilot, or a path to a .toml",
    )
    speed: float = Field(
        default=1.0,
        description="simulated seconds per wall second of the vehicle; 1 for a real one",
    )
    altitude_m: float = Field(
        default=10.0,
        description="take-off altitude, 8 to 100 m, with --steps-only from 2 m: PX4 comes down"
        " while it waits for setpoints",
    )
    repeat: int = Field(
        default=1,
        description="how often the steps are flown, 1 to 20: the table has the median; every other"
        " time they are mirrored, so that the vehicle comes back",
    )
    steps: tuple[str, ...] | None = Field(
        default=None,
        description="names of the steps to fly, as north-2 yaw-90 (docs/conformance.md); by default"
        " all",
    )
    skip_steps: bool = Field(default=False, description="fly no step responses")
    steps_only: bool = Field(
        default=False,
        description="check neither refusals nor frames, offboard loss or hold: fly the steps",
    )
    connect_timeout_s: float = Field(
        default=30.0,
        description="how long a flight controller is waited for, 1 to 3600 s of wall time",
    )
    out: Path | None = Field(
        default=None, description="write everything to this .json; by default nothing"
    )


OPTIONS = ConformanceOptions


def run(options: ConformanceOptions, console: Console | None = None) -> int:
    """Check a vehicle and print the result; return 0 if it conforms, else 1, or 130."""
    from airl_mav.addons.conformance.report import check_table, line_text, step_table
    from airl_mav.addons.conformance.run import check_conformance
    from airl_mav.addons.conformance.steps import STEP_NAMES

    console = console or new_console()
    if options.out is not None and not options.out.parent.is_dir():
        raise FieldError("out", str(options.out), problem=f"no folder {options.out.parent}")
    if options.skip_steps and (options.steps_only or options.steps):
        other = "--steps-only" if options.steps_only else "--steps"
        raise FieldError("skip_steps", accepted=f"without {other}")
    if options.steps == ():
        raise FieldError("steps", accepted="one name or more")
    steps: Any = () if options.skip_steps else options.steps or STEP_NAMES
    with terminated_as_interrupted():
        result = check_conformance(
            options.connect,
            reference=options.reference,
            speed=options.speed,
            altitude_m=options.altitude_m,
            steps=steps,
            repeat=options.repeat,
            steps_only=options.steps_only,
            connect_timeout_s=options.connect_timeout_s,
            progress=lambda line: console.print(line_text(line), soft_wrap=True),
        )
    if result.steps and result.reference is not None:
        console.print(step_table(result, result.reference))
    console.print(check_table(result))
    style = "bold green" if result.passed else "bold red"
    console.print(result.verdict, style=style, soft_wrap=True)
    if options.out is not None:
        result.write(options.out)
    if result.interrupted:
        return EXIT_INTERRUPTED
    return 0 if result.passed else EXIT_BROKEN
