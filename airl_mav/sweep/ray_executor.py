"""Trials as tasks of a Ray cluster, or of a Ray started on this machine.

Ray places the tasks; the sweep's folder, which all machines must see under the same path, is the
only thing that they share. What a lost task had done lies there, and the next one goes on from it.
"""

from __future__ import annotations

import os
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.workers import LOOK_S, TRIES, WorkerError
from airl_mav.sweep.executors import Work
from airl_mav.sweep.result import TrialResult
from airl_mav.sweep.trial import Trial

LOCAL = "local"
"""Address that starts a Ray of its own on this machine."""

AUTO = "auto"
"""Address of the Ray that runs on this machine."""

GREATEST_PORT = 65_535

REACH_S = 10.0
"""Longest wait for a cluster's head to answer [wall s]."""


@dataclass(frozen=True)
class _Failed:
    """A task's answer when a trial could not be done."""

    message: str
    usage: bool
    """The input cannot be used: an error of whoever asked."""


@dataclass(frozen=True)
class RayExecutor:
    """Tasks of the Ray that `connected` has reached."""

    work: Work
    most: int | None
    """Greatest number of trials at a time; None: as many as the cluster has room for."""
    gpus: float
    """Share of a GPU that a trial is given, as Ray counts them."""
    lost: Callable[[str], None]
    """Is told, in words, of each worker that was lost."""

    def run(self, waiting: Sequence[Trial], stop: Callable[[], bool]) -> Iterator[TrialResult]:
        """Carry out trials; see `executors.Executor`."""
        import ray

        # Lost tasks begin again here, not inside Ray: so that people hear of it.
        task = ray.remote(num_cpus=1, num_gpus=self.gpus, max_retries=0)(_carry_out)
        left = deque(waiting)
        tries: Counter[Trial] = Counter()
        busy: dict[Any, Trial] = {}
        most = len(left) if self.most is None else self.most

        def begin(trial: Trial) -> None:
            busy[task.remote(self.work, trial)] = trial

        try:
            while (left or busy) and not stop():
                while left and len(busy) < most:
                    begin(left.popleft())
                for ref in ray.wait(list(busy), timeout=LOOK_S)[0]:
                    trial = busy.pop(ref)
                    try:
                        answer = ray.get(ref)
                    except ray.exceptions.RayTaskError as error:
                        # Not the trial, which answers for itself: it could not even begin.
                        last = f"{error}".strip().splitlines()[-1]
                        raise WorkerError(f"{trial.name}: {last}") from None
                    except ray.exceptions.RayError as error:
                        tries[trial] += 1
                        how = type(error).__name__
                        if tries[trial] == TRIES:
                            raise WorkerError(
                                f"{trial.name}: lost {TRIES} workers, the last one by {how}"
                            ) from None
                        self.lost(f"a worker was lost by {how}: {trial.name} begins again")
                        begin(trial)
                        continue
                    if isinstance(answer, _Failed):
                        kind = UsageError if answer.usage else WorkerError
                        raise kind(f"{trial.name}: {answer.message}")
                    yield answer
        finally:
            for ref in busy:
                ray.cancel(ref, force=True)


def _carry_out(work: Work, trial: Trial) -> TrialResult | _Failed:
    """Do a trial, in a worker of Ray."""
    try:
        return work()(trial)
    except UsageError as error:
        return _Failed(str(error), usage=True)
    except Exception as error:
        return _Failed(" ".join(f"{type(error).__name__}: {error}".split()), usage=False)


def check_ray_installed() -> None:
    """Raise UsageError unless Ray is installed."""
    if find_spec("ray") is None:
        raise UsageError("--ray: not installed: ray; pip install 'airl-mav[ray]'")


def _check_reached(address: str) -> None:
    """Raise UsageError unless something listens at HOST:PORT: Ray itself would wait minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= GREATEST_PORT:
        raise UsageError(f"--ray {address}: accepted: local, auto, HOST:PORT or ray://HOST:PORT")
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except OSError as error:
        raise UsageError(f"--ray {address}: {error.strerror or error}") from None


@contextmanager
def connected(address: str, cores: int) -> Iterator[None]:
    """Be connected to a Ray for a while.

    Args:
        address: `local` starts one on this machine, `auto` takes the one that runs here; else
            HOST:PORT of its head.
        cores: How many one that is started here may use.

    Raises:
        UsageError: There is none at that address.
    """
    if address not in (LOCAL, AUTO):
        _check_reached(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # A task without a GPU hides all GPUs from itself in any case.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "1")
    if address == LOCAL:
        # Its workers find this very package, installed or not.
        here = f"{Path(__file__).resolve().parents[2]}"
        known = os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = here if known is None else f"{here}{os.pathsep}{known}"
    import ray

    started = {"num_cpus": cores, "include_dashboard": False} if address == LOCAL else {}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **started)
    except (ConnectionError, RuntimeError, ValueError) as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UsageError(f"--ray {address}: {first}") from None
    try:
        yield
    finally:
        ray.shutdown()
