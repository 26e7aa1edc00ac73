"""Process of a run's view, started and stopped with the run."""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from airl_mav.core.child_process import ChildProcess
from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import FieldError
from airl_mav.scenario.resolved import ResolvedScenario
from airl_mav.view.ends import ViewAnswer, ViewEnds, ViewSettings
from airl_mav.view.pace import REAL_TIME

MODULE = "airl_mav.view.server"


class ViewError(Exception):
    """Error for a view that failed to start; the message contains the cause."""


def request_of(scenario: ResolvedScenario, name: str, port: int | None = None) -> ViewSettings:
    """Return the settings of a view of a scenario's flights; arguments as in `ViewSettings`."""
    paced = scenario.scenario.level == "lockstep"
    return ViewSettings(
        run=name,
        port=port,
        paced=paced,
        speed=(scenario.speed or REAL_TIME) if paced else None,
        steerable=True,
        compensable=scenario.vehicle.compensable,
        compensated=scenario.pilot.compensate,
    )


class Viewer:
    """Page that shows flights until closed."""

    def __init__(self, request: ViewSettings) -> None:
        """Start the viewer and wait for it; raise FieldError if the port is in use."""
        self._folder = tempfile.TemporaryDirectory(prefix="airl-view-")
        self._child = ChildProcess(
            [sys.executable, "-m", MODULE],
            Path(self._folder.name) / "view.log",
            capture_stdout=True,
        )
        try:
            answer = self._answer(request)
            if answer.ends is None:
                raise FieldError(
                    "view_port", request.port, problem="the port is taken; accepted: a free one"
                )
        except BaseException:
            self.close()
            raise
        self.ends: ViewEnds = answer.ends
        """Addresses for flights to connect to."""
        self.url = f"http://{LOOPBACK}:{answer.port}"
        """URL of the page for a browser."""

    def _answer(self, request: ViewSettings) -> ViewAnswer:
        stdin, stdout = self._child.stdin, self._child.stdout
        line = b""
        if stdin is not None and stdout is not None:
            with suppress(BrokenPipeError):
                stdin.write(request.model_dump_json().encode() + b"\n")
                stdin.flush()
                line = stdout.readline()
        try:
            return ViewAnswer.model_validate_json(line)
        except ValidationError:
            self._child.stop()
            raise ViewError(f"the view did not start\n{self._child.log_tail()}") from None

    def close(self) -> None:
        """Stop the process; open pages report a lost connection. Safe to call again."""
        self._child.stop()
        if self._child.stdout is not None:
            self._child.stdout.close()
        self._folder.cleanup()
