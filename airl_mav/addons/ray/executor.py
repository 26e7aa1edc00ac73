"""Executor on a Ray cluster or a local Ray; lost tasks restart here, with a message."""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from airl_mav.core.compiling import Heard
from airl_mav.core.errors import FieldError
from airl_mav.core.machine import package_versions
from airl_mav.experiments import executors
from airl_mav.scenario.model import Workers

LOCAL = "local"
"""Address that starts a new Ray instance on this machine."""

AUTO = "auto"
"""Address of the running Ray instance on this machine."""

MAX_PORT = 65_535

CONNECT_S = 10.0
"""Timeout for the connection to a cluster's head [wall s]."""


@dataclass(frozen=True)
class RayExecutor:
    """Executor of Ray tasks with one core each, created by `connected`."""

    workers: int
    """Maximum number of submitted tasks; tasks without a free core wait in Ray."""
    gpus: float = 0.0
    """Share of a GPU that Ray reserves for a task."""
    streams: ClassVar[bool] = False

    def run(
        self,
        jobs: Iterable[executors.J],
        start: executors.Start[executors.J, executors.R],
        *,
        name: Callable[[executors.J], str] = str,
        stop: executors.Stop = executors.never,
        lost: Callable[[str], None] = lambda _: None,
        compiling: Heard = lambda _: None,  # noqa: ARG002 (see there)
    ) -> executors.Results[executors.J, executors.R]:
        """Run jobs; see `executors.Executor`."""
        import ray

        task = ray.remote(num_cpus=1, num_gpus=self.gpus, max_retries=0)(_carry_out)
        versions = package_versions()
        pickled = pickle.dumps(start)
        key, shared = hashlib.sha256(pickled).hexdigest(), ray.put(pickled)
        waiting, busy = iter(jobs), dict[Any, tuple[executors.J, int]]()

        def begin(job: executors.J, attempt: int = 1) -> None:
            busy[task.remote(key, versions, shared, job)] = job, attempt

        def fill() -> None:
            while len(busy) < self.workers:
                try:
                    begin(next(waiting))
                except StopIteration:
                    return

        try:
            fill()
            while busy and not stop():
                for ref in ray.wait(list(busy), timeout=executors.POLL_S)[0]:
                    job, attempt = busy.pop(ref)
                    try:
                        told = ray.get(ref)
                    except ray.exceptions.RayTaskError as error:
                        # The task failed before its job began: jobs return their own failures.
                        last = f"{error}".strip().splitlines()[-1]
                        raise executors.WorkerError(f"{name(job)}: {last}") from None
                    except ray.exceptions.RayError as error:
                        begin(
                            job,
                            executors.next_attempt(name(job), attempt, type(error).__name__, lost),
                        )
                        continue
                    if isinstance(told, executors.Failure):
                        raise told.error(name(job))
                    fill()
                    for result in told:
                        yield job, result
        finally:
            for ref in busy:
                ray.cancel(ref, force=True)


_started: dict[str, executors.Work[Any, Any]] = {}
"""Initialized work of one run in this Ray worker, by its key."""


def _carry_out(key: str, versions: Mapping[str, str], pickled: bytes, job: Any) -> Any:
    """Run a job in a Ray worker with the driver's versions."""

    def work() -> Iterable[Any]:
        if key not in _started:
            executors.check_versions(versions)
            _started.clear()
            # Set before numba and similar libraries are imported.
            os.environ.update(executors.ONE_THREAD)
            _started[key] = pickle.loads(pickled)(executors.never)  # noqa: S301 (from the driver, by Ray)
        results: Iterable[Any] = _started[key](job)
        return results

    return executors.answer(work)


def _check_reachable(address: str) -> None:
    """Raise UsageError unless HOST:PORT accepts connections: Ray would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= MAX_PORT:
        accepted = "local, auto, HOST:PORT or ray://HOST:PORT"
        raise FieldError("ray_address", address, accepted)
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except OSError as error:
        problem = f"{error.strerror or error}"
        raise FieldError("ray_address", address, problem=problem) from None


def _require_token(address: str) -> None:
    """Turn Ray's token authentication on; raise UsageError if a cluster's token is missing."""
    mode = os.environ.setdefault("RAY_AUTH_MODE", "token")
    if mode != "token":
        raise FieldError(
            "RAY_AUTH_MODE", mode, "token: Ray runs the code of everyone who reaches it"
        )
    file = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    if address == LOCAL:  # Only this process and its workers have the token.
        os.environ.setdefault("RAY_AUTH_TOKEN", os.urandom(32).hex())
    elif not os.environ.get("RAY_AUTH_TOKEN") and not (file.is_file() and file.read_text().strip()):
        problem = f"no token in RAY_AUTH_TOKEN or {file}; accepted: the token of the cluster"
        raise FieldError("ray_address", address, problem=problem)


@contextmanager
def connected(settings: Workers, cores: int, gpus: float) -> Iterator[RayExecutor]:
    """Connect to Ray, or raise UsageError; `gpus` is the share of a GPU per job."""
    if find_spec("ray") is None:
        raise FieldError("executor", "ray", problem="not installed: pip install 'airl-mav[ray]'")
    address, local = settings.ray_address, settings.ray_address == LOCAL
    if address not in (LOCAL, AUTO):
        _check_reachable(address)
    _require_token(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Tasks without a GPU hide all GPUs in any case.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "1")
    if local:
        # Ray then takes 127.0.0.1 for its node's address, and binds all sockets to it.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        # Lets Ray's workers import this package, installed or not.
        here = f"{Path(__file__).resolve().parents[3]}"
        known = os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = here if known is None else f"{here}{os.pathsep}{known}"
    import ray

    started: dict[str, Any] = {}
    if local:
        started = {"num_cpus": settings.workers or cores, "include_dashboard": False}
    try:
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **started)
            nodes = [node for node in ray.nodes() if node["Alive"]]
        except Exception as error:  # Ray raises plain exceptions for time-outs and lost processes.
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise FieldError("ray_address", address, problem=first) from None
        there = sum(int(node["Resources"].get("CPU", 0)) for node in nodes)
        yield RayExecutor(settings.workers or max(there, 1), gpus)
    finally:
        ray.shutdown()
