"""`airl conformance`: one script against any flight controller."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any, cast

from rich.console import Console

from airl_mav.cli.common import EXIT_BROKEN, EXIT_INTERRUPTED, check_range
from airl_mav.cli.conformance_command import ConformanceCommand
from airl_mav.conformance.checks import Checklist
from airl_mav.conformance.reference import AUTO, load_reference
from airl_mav.conformance.report import as_data, check_table, line_text, step_table, verdict
from airl_mav.conformance.sequence import Examination, Findings, examine
from airl_mav.conformance.session import Session
from airl_mav.conformance.steps import STEP_NAMES, StepName
from airl_mav.conformance.transcript import Line, Transcript
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import UsageError
from airl_mav.core.files import write_json

STYLES = {"sent": "cyan", "heard": "", "check": "bold", "note": "dim"}


def run(command: ConformanceCommand, console: Console | None = None) -> int:
    """Examine a vehicle and say what came out.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 it conforms, 1 a check failed or a figure lies outside its tolerance, 130
        Ctrl-C, after landing.

    Raises:
        UsageError: The input cannot be used, or nobody is heard.
    """
    console = console or Console()
    asked = examination(command)

    def show(line: Line) -> None:
        console.print(
            line_text(line), style=STYLES[line.kind], markup=False, highlight=False, soft_wrap=True
        )

    transcript = Transcript(WallClock(command.speed), show)
    findings = Findings(Checklist(transcript))
    with closing(Session(command.connect, command.speed, transcript)) as session, _ended_gently():
        transcript.say("note", f"waiting for a flight controller on {command.connect}")
        session.connect(command.connect_timeout)
        examine(session, asked, findings)
        data = as_data(session, asked, findings)
    if findings.flown and findings.reference is not None:
        console.print(step_table(findings, findings.reference))
    console.print(check_table(findings.checklist.checks))
    passed = data["passed"]
    console.print(
        verdict(findings),
        style="bold green" if passed else "bold red",
        markup=False,
        soft_wrap=True,
    )
    if command.out is not None:
        try:
            write_json(command.out, data)
        except OSError as error:
            raise UsageError(f"--out {command.out}: {error.strerror}") from None
    if findings.interrupted:
        return EXIT_INTERRUPTED
    return 0 if passed else EXIT_BROKEN


def examination(command: ConformanceCommand) -> Examination:
    """Check the command and return what it asks for. Raises UsageError."""
    check_range("--speed", command.speed, 0.01, 100.0)
    check_range("--altitude", command.altitude, 2.0 if command.steps_only else 8.0, 100.0)
    check_range("--repeat", command.repeat, 1, 20)
    check_range("--connect-timeout", command.connect_timeout, 1.0, 3600.0)
    if command.out is not None and not command.out.parent.is_dir():
        raise UsageError(f"--out {command.out}: no folder {command.out.parent}")
    if command.reference != AUTO:
        load_reference(command.reference, 0)
    if command.skip_steps and (command.steps_only or command.steps):
        other = "--steps-only" if command.steps_only else "--steps"
        raise UsageError(f"--skip-steps: accepted: without {other}")
    return Examination(
        reference=command.reference,
        altitude_m=command.altitude,
        steps=() if command.skip_steps else _steps(command),
        repeat=command.repeat,
        behaviour=not command.steps_only,
    )


def _steps(command: ConformanceCommand) -> tuple[StepName, ...]:
    if command.steps is None:
        return STEP_NAMES
    for name in command.steps:
        if name not in STEP_NAMES:
            raise UsageError(f"--steps {name}: accepted: {', '.join(STEP_NAMES)}")
    if not command.steps:
        raise UsageError("--steps: accepted: one name or more")
    return cast(tuple[StepName, ...], command.steps)


@contextmanager
def _ended_gently() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does: land."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_signal: int, _frame: Any) -> None:
        raise KeyboardInterrupt

    old = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old)
