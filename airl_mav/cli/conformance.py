"""`airl conformance`: check any flight controller."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from airl_mav.cli.common import EXIT_BROKEN, EXIT_INTERRUPTED
from airl_mav.core.errors import UsageError


@dataclass(frozen=True)
class Conformance:
    """Fly any flight controller through checks and step responses: airl-firmware, PX4, ArduPilot.

    SITL or a board. It takes off. Once through it needs 60 m to the north, 20 m to the east and
    15 m above the take-off altitude; Ctrl-C lands. Exit status 1: a check failed.

    Examples:
      airl-firmware --arena open-field
      airl conformance --connect udpin://127.0.0.1:14540 --out result.json
    """

    connect: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection to the flight controller: udpin://HOST:PORT or serial://DEVICE:BAUD."""

    reference: str = "auto"
    """Stored step responses to compare with: auto (by the autopilot that is heard), px4,
    ardupilot, or a path to a .toml."""

    speed: float = 1.0
    """Simulated seconds per wall second of the vehicle; 1 for a real one."""

    altitude: float = 10.0
    """Take-off altitude, 8 to 100 m, with --steps-only from 2 m: PX4 comes down while it waits for
    setpoints."""

    repeat: int = 1
    """How often the steps are flown, 1 to 20: the table has the median. Every other time they are
    mirrored, so that the vehicle comes back."""

    steps: tuple[str, ...] | None = None
    """Names of the steps to fly, as north-2 yaw-90 (docs/conformance.md). None: all."""

    skip_steps: bool = False
    """Fly no step responses."""

    steps_only: bool = False
    """Check neither refusals nor frames, offboard loss or hold: fly the steps."""

    connect_timeout: float = 30.0
    """How long a flight controller is waited for, 1 to 3600 s of wall time."""

    out: Path | None = None
    """Write everything to this .json. None: nothing."""


def run(command: Conformance, console: Console | None = None) -> int:
    """Check a vehicle and print the result.

    Args:
        command: The options.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 it conforms, 1 a check failed or a figure lies outside its tolerance, 130
        Ctrl-C, after landing.

    Raises:
        UsageError: As `check_conformance`, or --out cannot be written.
    """
    from airl_mav.conformance.report import check_table, line_text, step_table
    from airl_mav.conformance.run import check_conformance
    from airl_mav.conformance.steps import STEP_NAMES

    console = console or Console()
    if command.out is not None and not command.out.parent.is_dir():
        raise UsageError(f"--out {command.out}: no folder {command.out.parent}")
    if command.skip_steps and (command.steps_only or command.steps):
        other = "--steps-only" if command.steps_only else "--steps"
        raise UsageError(f"--skip-steps: accepted: without {other}")
    if command.steps == ():
        raise UsageError("--steps: accepted: one name or more")
    steps: Any = () if command.skip_steps else command.steps or STEP_NAMES
    with _sigterm_as_ctrl_c():
        result = check_conformance(
            command.connect,
            reference=command.reference,
            speed=command.speed,
            altitude_m=command.altitude,
            steps=steps,
            repeat=command.repeat,
            steps_only=command.steps_only,
            connect_timeout_s=command.connect_timeout,
            progress=lambda line: console.print(line_text(line), soft_wrap=True),
        )
    if result.steps and result.reference is not None:
        console.print(step_table(result, result.reference))
    console.print(check_table(result))
    style = "bold green" if result.passed else "bold red"
    console.print(result.verdict, style=style, markup=False, soft_wrap=True)
    if command.out is not None:
        result.write(command.out)
    if result.interrupted:
        return EXIT_INTERRUPTED
    return 0 if result.passed else EXIT_BROKEN


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM land the vehicle too."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old)
