"""Runs a program that must not outlive who started it.

Used as `python -m firmware_sim.external.process.parent_death PROGRAM ARGUMENT...`.

Standard input is the leash. When it ends (its holder died, however), the program and all that it
started is ended. Neither PX4 nor ArduPilot notices by itself that nobody simulates for it any more.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

GRACE_S = 2.0
"""How long the program may take to end when told to [wall s]."""


def main() -> None:
    """Run the command line's program until it ends, or the leash does; exit with its status."""
    # A group of its own: signals meant for the holder pass it by, and it can be ended whole.
    program = subprocess.Popen(  # noqa: S603 - a list of words, no shell
        sys.argv[1:], stdin=subprocess.DEVNULL, start_new_session=True
    )
    threading.Thread(target=_end_with_leash, args=(program,), daemon=True).start()
    code = program.wait()
    _signal(program.pid, signal.SIGKILL)
    sys.exit(code if code >= 0 else 128 - code)


def _end_with_leash(program: subprocess.Popen[bytes]) -> None:
    while os.read(0, 4096):
        pass
    _signal(program.pid, signal.SIGTERM)
    try:
        program.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        _signal(program.pid, signal.SIGKILL)


def _signal(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        return


if __name__ == "__main__":
    main()
