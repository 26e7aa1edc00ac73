"""Process of a `first_start.CompileJob`: reads the job from standard input and runs it.

Writes a line of JSON for each compiled kernel, and at the end the source files of all its kernels,
including dependencies. Exits when its standard input is closed.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from airl_mav.core import kernels


class _Compiler(event.Listener):  # type: ignore[misc]
    """Listener that reports compiled kernels, without numba's own functions."""

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002
        """Report that a kernel is missing in the cache."""
        _write({"compiling": True})

    def on_end(self, event: event.Event) -> None:
        """Report a compiled kernel."""
        function = event.data["dispatcher"].py_func
        if function.__code__.co_filename in kernels.kernel_files:
            _write({"compiled": function.__qualname__})


def _write(line: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def _end_with_stdin() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def main() -> None:
    """Run one job."""
    # Not `sys.stdin`, whose lock the thread would hold at exit.
    request = b""
    while not request.endswith(b"\n"):
        if not (part := os.read(0, 65536)):
            return
        request += part
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    job = json.loads(request)
    event.register("numba:compile", _Compiler())
    module, _, name = job["function"].partition(":")
    getattr(importlib.import_module(module), name)(**job["arguments"])
    version = Path(numba.__file__).with_name("_version.py")
    _write({"files": [str(each) for each in (version, *kernels.sources())]})


if __name__ == "__main__":
    main()
