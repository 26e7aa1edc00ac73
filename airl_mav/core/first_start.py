"""Compilation of kernels before the first start, as a separate step in parallel processes.

A plan names functions that use the kernels of a command. Each function runs in a separate process,
with one process per core. numba's cache stores the result of each kernel, so an interrupted step
resumes where it ended. A record of the source files marks a plan as done.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from airl_mav.core.child_process import ChildProcess, Exited
from airl_mav.core.clock import WallClock
from airl_mav.core.compiling import writable_folder
from airl_mav.core.constants import US_PER_S
from airl_mav.core.files import replace_file, scratch_folder, try_lock
from airl_mav.core.machine import usable_cores
from airl_mav.core.progress import Bar, Progress

LABEL = "compiling kernels (first start only)"

LOADING = "loading kernels (the first start compiles them, in about a minute on two idle cores)"

POLL_S = 0.1
"""Interval between two checks for Ctrl-C [wall s]."""

LINE_EVERY_S = 10.0
"""Interval between two progress lines if bars cannot be drawn [wall s]."""


@dataclass(frozen=True)
class CompileJob:
    """Function that uses kernels, run in a separate process."""

    function: str
    """Module and name, as `package.module:function`."""
    arguments: Mapping[str, Any]
    """Keyword arguments, JSON compatible."""
    kernels: int
    """Number of kernels compiled with an empty cache; used only for progress."""


@dataclass(frozen=True)
class CompilePlan:
    """Kernels to compile before a command's first flight."""

    family: str
    """Family of plans with many common kernels: after one of them, others run only `whole`."""
    variant: str
    """Name within the family; plans that need different kernels have different variants."""
    parts: tuple[CompileJob, ...]
    """Parallel jobs, with few shared kernels."""
    whole: CompileJob
    """Final job, which compiles all remaining kernels; uses every kernel of the plan."""

    def record(self, folder: Path) -> Path:
        """Return the file that marks the plan as done."""
        return folder / f"{self.family}-{self.variant}.json"


def compile_first(
    plans: Sequence[CompilePlan],
    progress: Progress | None = None,
    stop: Callable[[], bool] = lambda: False,
    workers: int | None = None,
) -> None:
    """Compile the kernels of plans, unless all are cached; one process per core by default.

    `stop` is polled several times per second; True ends the step. Ctrl-C (KeyboardInterrupt) keeps
    compiled kernels.
    """
    folder, missing = _missing(plans)
    if folder is None or not missing:
        return
    progress = progress or Progress()
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, progress, stop):
        for plan in missing:
            if _is_done(plan.record(folder)):
                continue
            if stop():
                return
            parts = plan.parts
            if any(map(_is_done, folder.glob(f"{plan.family}-*.json"))):
                parts = ()
            with scratch_folder("airl-compiling-") as scratch:
                step = _Step(progress, stop, workers or usable_cores(), scratch)
                files = step.run(parts, plan.whole)
            if files is not None:
                _record(plan.record(folder), files)


_show: Callable[[], AbstractContextManager[Progress]] | None = None
"""Factory of the running command's progress display; None = no display."""


@contextmanager
def shown_by(show: Callable[[], AbstractContextManager[Progress]]) -> Iterator[None]:
    """Use `show` to display progress of `compile_shown` within the context."""
    global _show
    before, _show = _show, show
    try:
        yield
    finally:
        _show = before


def compile_shown(plans: Sequence[CompilePlan]) -> None:
    """Compile as `compile_first` within `shown_by`; otherwise do nothing."""
    if _show is not None and _missing(plans)[1]:
        with _show() as progress:
            compile_first(plans, progress)


# --- the record


def _missing(plans: Sequence[CompilePlan]) -> tuple[Path | None, list[CompilePlan]]:
    """Return the folder of the records and the plans without one; None = no writable folder."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(chosen) if chosen else writable_folder("first-start")
    if folder is None:
        return None, []
    return folder, [plan for plan in plans if not _is_done(plan.record(folder))]


def _is_done(path: Path) -> bool:
    """Return True if a record matches the current sources and machine."""
    try:
        record = json.loads(path.read_bytes())
        return bool(
            record["machine"] == _machine()
            and all(_stamp(name) == stamp for name, stamp in record["files"].items())
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _record(path: Path, files: Sequence[str]) -> None:
    record = {"machine": _machine(), "files": {name: _stamp(name) for name in files}}
    with suppress(OSError):
        replace_file(path, json.dumps(record).encode())


def _stamp(name: str) -> list[int]:
    """Return size and time of a file: numba recompiles after a change of either."""
    stat = os.stat(name)  # noqa: PTH116 - three hundred of them at every start
    return [stat.st_size, stat.st_mtime_ns]


def _machine() -> str:
    """Return other inputs of numba's cache: the interpreter, and the processor name on Linux."""
    with suppress(OSError), open("/proc/cpuinfo", "rb", buffering=0) as file:  # noqa: PTH123
        for line in file.read(2048).decode(errors="replace").splitlines():
            if line.startswith("model name"):
                return f"{sys.version} {line}"
    return sys.version


@contextmanager
def _locked(folder: Path, progress: Progress, stop: Callable[[], bool]) -> Iterator[None]:
    """Let one program at a time compile; the others wait, and then use the cache."""
    clock, said = WallClock(), False
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        while not stop() and not try_lock(descriptor):
            if not said:
                what = "waiting for another program that compiles kernels"
                progress.status(what)
                progress.line(what)
            said = True
            clock.sleep_until(clock.time_us() + round(POLL_S * US_PER_S))
        if said:
            progress.status(None)
        yield
    finally:
        os.close(descriptor)


# --- the step


@dataclass
class _Running:
    """Job in its process."""

    job: CompileJob
    process: ChildProcess
    reader: threading.Thread | None = None
    """Reader of the process's output."""
    count: int = 0


class _Step:
    """Runner of one plan's jobs."""

    def __init__(
        self, progress: Progress, stop: Callable[[], bool], workers: int, scratch: Path
    ) -> None:
        self._progress, self._stop = progress, stop
        self._workers, self._scratch = workers, scratch
        self._events: queue.Queue[tuple[_Running, Mapping[str, Any] | Exited]] = queue.Queue()
        self._running: list[_Running] = []
        self._total = 0
        self._ended = 0
        """Kernels of finished jobs, compiled or found in the cache."""
        self._files: list[str] = []
        """Source files of the last finished job."""
        self._failed = False
        self._clock = WallClock()
        self._line_us: int | None = None
        """Time of the next progress line; None = no compilation so far."""
        self._bar: Bar | None = None

    def run(self, parts: Sequence[CompileJob], whole: CompileJob) -> list[str] | None:
        """Run all jobs; return the source files of the kernels, or None if a job failed."""
        self._total = sum(job.kernels for job in (*parts, whole))
        self._progress.status(LOADING)
        self._progress.line(LOADING)
        try:
            done = self._run_all(parts) and self._run_all([whole])
        finally:
            self._progress.status(None)
            for each in self._running:
                each.process.kill()  # numba replaces files atomically.
                _clear(each)
            if self._bar is not None:
                self._bar.close()
        if not done or not self._files:
            return None
        if self._bar is not None:
            self._progress.line(f"kernels compiled in {self._elapsed_s():.0f} s")
        return self._files

    def _run_all(self, jobs: Sequence[CompileJob]) -> bool:
        waiting = list(jobs)
        while (waiting or self._running) and not self._failed:
            while waiting and len(self._running) < self._workers:
                self._start(waiting.pop(0))
            if self._stop():
                return False
            with suppress(queue.Empty):
                self._take(*self._events.get(timeout=POLL_S))
            self._show()
        return not self._failed

    def _start(self, job: CompileJob) -> None:
        process = ChildProcess(
            [sys.executable, "-m", "airl_mav.core.first_start"],
            self._scratch / "log.txt",
            capture_stdout=True,
        )
        running = _Running(job, process)
        running.reader = threading.Thread(target=self._read, args=(running,), daemon=True)
        self._running.append(running)
        if process.stdin is not None:
            request = {"function": job.function, "arguments": dict(job.arguments)}
            with suppress(BrokenPipeError):  # Its exit is reported.
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
        running.reader.start()

    def _read(self, running: _Running) -> None:
        if running.process.stdout is not None:
            with running.process.stdout as lines:
                for line in lines:
                    with suppress(ValueError):  # Output of a library.
                        self._events.put((running, json.loads(line)))
        self._events.put((running, running.process.wait()))

    def _take(self, running: _Running, event: Mapping[str, Any] | Exited) -> None:
        if isinstance(event, Exited):
            self._running.remove(running)
            _clear(running)
            self._ended += max(running.count, running.job.kernels)
            if event.code:
                self._failed = True
                tail = running.process.log_tail().splitlines()[-1:]
                self._progress.note(
                    f"kernels are not compiled ahead: {': '.join([str(event), *tail])}", "yellow"
                )
        elif "files" in event:
            self._files = event["files"]
        elif self._line_us is None:  # The first kernel missing in the cache.
            self._bar = self._progress.bar(LABEL, self._total, unit="kernels")
            self._line_us = self._clock.time_us()
        elif "compiled" in event:
            running.count += 1

    def _show(self) -> None:
        if self._bar is None or self._line_us is None:
            return
        count = self._ended + sum(each.count for each in self._running)
        self._total = max(count, self._total)
        self._bar.update(completed=count, total=self._total)
        if (now_us := self._clock.time_us()) >= self._line_us:
            self._line_us = now_us + round(LINE_EVERY_S * US_PER_S)
            self._progress.line(f"{LABEL}: {count} of {self._total}, {self._elapsed_s():.0f} s")

    def _elapsed_s(self) -> float:
        return self._clock.time_us() / US_PER_S


def _clear(running: _Running) -> None:
    """Close the pipes of a job that has ended or has been killed."""
    running.process.stop()
    if running.reader is not None and running.reader.ident is not None:
        running.reader.join()


# --- the process of a job


def main() -> None:
    """Run the `CompileJob` in standard input; end with it.

    Writes a line of JSON for each compiled kernel, without numba's own functions, and at the end
    the source files of all kernels, including dependencies.
    """
    import numba
    from numba.core import event

    from airl_mav.core import kernels

    class Compiler(event.Listener):  # type: ignore[misc]
        def on_start(self, event: event.Event) -> None:  # noqa: ARG002 (any is one)
            _write({"compiling": True})  # A kernel is missing in the cache.

        def on_end(self, event: event.Event) -> None:
            function = event.data["dispatcher"].py_func
            if function.__code__.co_filename in kernels.kernel_files:
                _write({"compiled": function.__qualname__})

    # Not `sys.stdin`, whose lock the thread would hold at exit.
    request = b""
    while not request.endswith(b"\n"):
        if not (part := os.read(0, 65536)):
            return
        request += part
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    job = json.loads(request)
    event.register("numba:compile", Compiler())
    module, _, name = job["function"].partition(":")
    getattr(importlib.import_module(module), name)(**job["arguments"])
    version = Path(numba.__file__).with_name("_version.py")
    _write({"files": [str(each) for each in (version, *kernels.sources())]})


def _write(line: Mapping[str, Any]) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def _end_with_stdin() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
