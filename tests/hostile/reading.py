"""Commands on hostile input in bounded children: exit code, last line, memory and time of each."""

from __future__ import annotations

import hashlib
import os
import re
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
from matplotlib import get_cachedir

LIMIT_S = 60.0
"""Maximum processor time of a command [s], equal to the wall time on an idle machine."""

PATIENCE_S = 240.0
"""Timeout of a command that waits [wall s]."""

LIMIT_BYTES, PROGRAM_BYTES = 1 << 30, 350 << 20
"""Maximum resident memory of a command."""

ADDRESSES = 6 << 30
"""Maximum address space of a command: a bomb ends only the command."""

CODES = (0, 1, 2, 3, 4, 5)

MARKUP = b"<img src=x onerror=hostile()>"
"""Markup in names: a page must contain it escaped alone."""

SCRIPT = b"</script><script>hostile()"

CONTROL = re.compile(rb"\x1b\]|\x1b\[2J|\x07")
"""Control sequences in names: the terminal must not get them."""

Words = Sequence[str]


@dataclass(frozen=True)
class Entry:
    """One hostile input."""

    name: str
    words: Words
    """Command line; `{d}` is the entry's folder, which is also the current folder."""
    build: Callable[[Path], object]
    """Writes the input into a folder."""
    alone: bool = False
    """True for a new interpreter instead of a fork of this one."""


@dataclass(frozen=True)
class Result:
    """Outcome of an entry."""

    entry: Entry
    code: int
    """Exit code; negative = a signal."""
    seconds: float
    """Processor time, of child processes too."""
    peak_bytes: int
    last: str
    """Last line of the output."""
    problems: tuple[str, ...]

    def row(self) -> str:
        """Return the outcome as one line."""
        mark = "; ".join(self.problems) or "ok"
        size = f"{self.peak_bytes / 2**20:5.0f} MiB"
        return (
            f"{self.entry.name:44} {self.code:4d} {self.seconds:6.1f} s {size} {mark}: {self.last}"
        )


def fingerprint(folder: Path) -> str:
    """Return a digest of names, kinds, permissions and contents below a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if ".cache" in path.parts:  # Of libraries: ONNX Runtime stores an id there.
            continue
        digest.update(f"{path.relative_to(folder)} {path.lstat().st_mode}\n".encode())
        if path.is_file() and not path.is_symlink():
            digest.update(path.read_bytes())
    return digest.hexdigest()


def read(entry: Entry, root: Path) -> Result:
    """Build an entry below a folder, read it with its command, and return the outcome.

    `root/outside` is a folder of the user that no entry may change, and its home.
    """
    outside, folder = root / "outside", root / "sent" / "in"
    outside.mkdir(parents=True)
    folder.mkdir(parents=True)
    (outside / "secret").write_bytes(b"a secret of the user\n" * 8)
    entry.build(folder)
    before = fingerprint(outside)
    kept = {path.name for path in root.iterdir()} | {"output"}
    words = [word.replace("{d}", str(folder)) for word in entry.words]
    began, inherited = time.monotonic(), psutil.Process().memory_info().rss
    child = os.fork()
    if child == 0:
        _child(words, folder, outside, root / "output", alone=entry.alone)
    code, used = _wait(child, began)
    seconds = used.ru_utime + used.ru_stime
    output = (root / "output").read_bytes()
    problems = []
    if fingerprint(outside) != before or {path.name for path in root.iterdir()} != kept:
        problems.append("touched a file outside")
    if b"Traceback" in output:
        problems.append("traceback")
    if code == -signal.SIGKILL:
        problems.append("never ends")
    elif code not in CODES:
        problems.append(f"ended by {code}")
    if seconds > LIMIT_S:
        problems.append("too slow")
    # The child inherits the memory of this process.
    peak = max(0, used.ru_maxrss * 1024 - inherited) + PROGRAM_BYTES
    if peak > LIMIT_BYTES:
        problems.append("too much memory")
    if CONTROL.search(output):
        problems.append("control sequence on the terminal")
    for page in folder.rglob("*.html"):
        if not page.is_symlink() and any(each in page.read_bytes() for each in (MARKUP, SCRIPT)):
            problems.append(f"markup in {page.name}")
    lines = output.decode(errors="replace").strip().splitlines()
    last = next((each for each in reversed(lines) if each.startswith("error")), "")
    last = last or (lines[-1] if lines else "")
    return Result(entry, code, seconds, peak, ascii(last)[1:161], tuple(problems))


def _child(words: Words, folder: Path, outside: Path, output: Path, *, alone: bool) -> None:
    """Run a command, and end this process."""
    try:
        os.setsid()
        os.chdir(folder)
        os.environ |= {"HOME": str(outside), "COLUMNS": "200", "MPLCONFIGDIR": get_cachedir()}
        file = os.open(output, os.O_CREAT | os.O_WRONLY)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for number, descriptor in enumerate((nothing, file, file)):
            os.dup2(descriptor, number)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if alone:
            program = str(Path(sys.executable).with_name("airl"))
            os.execv(program, [program, *words])  # noqa: S606
        from airl_mav.cli.main import main

        sys.argv = ["airl", *words]
        main(words)
    except SystemExit as end:
        sys.stdout.flush()
        os._exit(end.code if isinstance(end.code, int) else 1)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(99)


def _wait(child: int, began: float) -> tuple[int, resource.struct_rusage]:
    """Wait for a process, which is killed after the limit; return its exit code and its use."""
    while True:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), used
        if time.monotonic() - began > PATIENCE_S:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.005)


def preload() -> None:
    """Import what the commands need once, for all forks."""
    import matplotlib.pyplot  # noqa: F401
    import mcap.stream_reader  # noqa: F401
    import pyulog  # noqa: F401
    import trimesh  # noqa: F401

    import airl_mav.addons.export_log.command
    import airl_mav.addons.identification.identify_command
    import airl_mav.addons.meshes.mesh_boxes
    import airl_mav.arena.generate
    import airl_mav.cli.evaluate_command
    import airl_mav.cli.report_command
    import airl_mav.report.comparison.show
    import airl_mav.report.run_report
    import airl_mav.report.run_tables  # noqa: F401
