"""A firmware process: started, watched, and surely ended."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from firmware_sim.flight_controller import FirmwareLostError, FirmwareMissingError

GRACE_S = 5.0
"""How long the leash may take to end the process [wall s]."""

TAIL_LINES = 8
"""Lines of a dead process's log that are shown."""


@dataclass(frozen=True)
class Start:
    """How a program is started in a folder of its own."""

    argv: Sequence[str]
    """Program and arguments."""
    environment: Mapping[str, str]
    """Added to our own environment."""


class FirmwareChild:
    """One process of real firmware, on a leash: it ends with us, also when we are killed."""

    def __init__(self, name: str, start: Start, cwd: Path, log: Path) -> None:
        """Start it.

        Args:
            name: What it is called in messages: PX4.
            start: How.
            cwd: Its working directory.
            log: What it prints is appended here.

        Raises:
            FirmwareMissingError: The program is not there, or may not be run.
        """
        self.name = name
        self._log = log
        program = Path(start.argv[0])
        if not os.access(program, os.X_OK) or not program.is_file():
            raise FirmwareMissingError(f"{name}: {program}: no program that can be run")
        with log.open("ab") as file:
            self._start = file.tell()
            # A session of its own: Ctrl-C at the terminal is for us, who then end it in order.
            self._process = subprocess.Popen(  # noqa: S603 - a list of words, no shell
                [sys.executable, "-m", "firmware_sim.external.process.parent_death", *start.argv],
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=cwd,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **start.environment},
                start_new_session=True,
            )

    def check(self) -> None:
        """Raise FirmwareLostError when the process has ended."""
        code = self._process.poll()
        if code is not None:
            tail = self.tail()
            raise FirmwareLostError(
                f"{self.name} ended (exit status {code}); log: {self._log}"
                + (f"\n{tail}" if tail else "")
            )

    def tail(self) -> str:
        """Return the last lines that it printed."""
        with suppress(OSError):
            written = self._log.read_bytes()[self._start :]
            return "\n".join(written.decode(errors="replace").splitlines()[-TAIL_LINES:])
        return ""

    def stop(self) -> None:
        """End it; returns when it is gone. Harmless when called again."""
        process = self._process
        if process.stdin is not None:
            with suppress(BrokenPipeError):
                process.stdin.close()
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
