"""Machine and software of a run, and the machine's state: governor, temperature, throttling.

Most values come from psutil; governor and throttling come from Linux and the Raspberry Pi's
firmware. None means not available. psutil is imported only in functions that use it: flight records
need this module, and reading them does not need psutil.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from airl_mav import __version__
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError

NOT_OFFERED = "not offered by this system"
VCGENCMD_TIMEOUT_S = 5.0

PI_FLAGS = {
    0: "under-voltage",
    1: "frequency capped",
    2: "throttled",
    3: "soft temperature limit",
    16: "under-voltage has occurred",
    17: "frequency capping has occurred",
    18: "throttling has occurred",
    19: "soft temperature limit has occurred",
}
"""Bits of the Raspberry Pi's `get_throttled` (raspberrypi.com, documentation of vcgencmd)."""

PI_PAST = 16
"""First bit of the flags for past events since the start of the system."""

CPU_SENSORS = ("cpu", "soc", "x86_pkg", "coretemp", "k10temp", "package")
"""Parts of the names of processor temperature sensors."""


@dataclass(frozen=True)
class MachineState:
    """State of a machine at one time."""

    governor: str | None
    """Frequency governors of the cores; a single name if all are the same."""
    frequency_mhz: tuple[float, float] | None
    """Minimum and maximum frequency of the cores [MHz]."""
    frequency_limit_mhz: float | None
    """Maximum permitted frequency [MHz]."""
    temperature_c: float | None
    """Temperature of the hottest processor sensor [°C]."""
    throttling: str | None
    """Text `none`, or the system's report."""
    load: tuple[float, float, float] | None
    """Load average over 1, 5 and 15 minutes."""

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Return all values as names and texts."""
        mhz, limit, load = self.frequency_mhz, self.frequency_limit_mhz, self.load
        frequency = None
        if mhz is not None:
            low, high = mhz
            frequency = f"{low:.0f} MHz" if high - low < 1.0 else f"{low:.0f} to {high:.0f} MHz"
            if limit is not None:
                frequency += f", at most {limit:.0f} MHz"
        known = {
            "governor": self.governor,
            "frequency": frequency,
            "temperature": None if self.temperature_c is None else f"{self.temperature_c:.1f} °C",
            "throttling": self.throttling,
            "load average": None if load is None else ", ".join(f"{value:.2f}" for value in load),
        }
        return tuple((name, value or NOT_OFFERED) for name, value in known.items())


def machine_state(
    root: Path = Path("/"), ask_pi: Callable[[], str | None] | None = None
) -> MachineState:
    """Return the state of this machine; psutil does not read governor and throttling.

    `root` contains /sys. `ask_pi` returns the output of `vcgencmd get_throttled`, or None if the
    program is missing; by default it is run.
    """
    import psutil

    governors = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    cores = _core_frequencies()
    now = [core.current for core in cores]
    return MachineState(
        governor=", ".join(sorted({text for path in governors if (text := sysfs_text(path))}))
        or None,
        frequency_mhz=(min(now), max(now)) if now else None,
        # 0 = unknown.
        frequency_limit_mhz=max((core.max for core in cores), default=0.0) or None,
        temperature_c=temperature_c(),
        throttling=_throttling(root, ask_pi or _vcgencmd),
        load=psutil.getloadavg(),
    )


def _core_frequencies() -> Sequence[Any]:
    """Return psutil's frequency of each core; empty if not available."""
    import psutil

    return (psutil.cpu_freq(percpu=True) if hasattr(psutil, "cpu_freq") else None) or ()


def mean_frequency_mhz() -> float | None:
    """Return the mean frequency of the cores; None if not available."""
    now = [core.current for core in _core_frequencies()]
    return sum(now) / len(now) if now else None


def temperature_c() -> float | None:
    """Return the temperature of the hottest processor sensor [°C]; None if not available."""
    import psutil

    if not hasattr(psutil, "sensors_temperatures"):  # Linux and FreeBSD have it.
        return None
    return max(
        (
            sensor.current
            for name, sensors in psutil.sensors_temperatures().items()
            if any(word in name.lower() for word in CPU_SENSORS)
            for sensor in sensors
        ),
        default=None,
    )


def throttled_since(before: str | None, after: str | None) -> bool | None:
    """Return True if a processor was throttled between two states of `throttling`.

    None if not available. The Raspberry Pi's flags of past events stay set until a restart: only
    newly set flags count, while flags of the present always count.
    """
    if before is None or after is None:
        return None
    now = set(after.split(", ")) & {text for bit, text in PI_FLAGS.items() if bit < PI_PAST}
    return bool(now) or (after != "none" and after != before)


def _throttling(root: Path, ask_pi: Callable[[], str | None]) -> str | None:
    """Return the reasons for throttling as text; None if not available."""
    bits = sysfs_text(root / "sys/devices/platform/soc/soc:firmware/get_throttled")
    if bits is None and (answer := ask_pi()) is not None:
        bits = answer.partition("=")[2]
    if bits is not None:
        try:
            return pi_throttling(int(bits, 16))
        except ValueError:
            return None
    counts = [
        count
        for path in sorted(
            (root / "sys/devices/system/cpu").glob("cpu[0-9]*/thermal_throttle/*_throttle_count")
        )
        if (count := sysfs_number(path)) is not None
    ]
    if counts:
        return f"{sum(counts):.0f} times since the start of the system" if sum(counts) else "none"
    return None


def pi_throttling(bits: int) -> str:
    """Return the names of the Raspberry Pi's throttling flags."""
    flags = [text for bit, text in PI_FLAGS.items() if bits >> bit & 1]
    return ", ".join(flags) or "none"


def _vcgencmd() -> str | None:
    program = shutil.which("vcgencmd")
    if program is None:
        return None
    try:
        done = subprocess.run(  # noqa: S603 - fixed words, no shell
            [program, "get_throttled"],
            capture_output=True,
            text=True,
            timeout=VCGENCMD_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def sysfs_text(path: Path) -> str | None:
    """Return the text of a small file; None if it is unreadable or empty."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip() or None
    except OSError:
        return None


def sysfs_number(path: Path) -> float | None:
    """Return the number in a small file; None if there is no number."""
    text = sysfs_text(path)
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


PACKAGES = (
    "filterpy",
    "gymnasium",
    "matplotlib",
    "mavsdk",
    "numba",
    "numpy",
    "onnxruntime",
    "pybullet",
    "pydantic",
    "pymavlink",
    "pyzmq",
    "scipy",
    "stable-baselines3",
    "torch",
)
GIT_TIMEOUT_S = 10.0

SOURCES = "sources"
"""Name of `sources_digest` among the versions."""

NO_FLIGHT = ("airl-mav", "matplotlib", "pydantic", "pyzmq")
"""Versions without effect on flights; the sources stand for airl-mav."""

UNKNOWN = "unknown code"

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the packages: the checkout, or site-packages."""


@cache
def sources_digest() -> str:
    """Return the digest of code and tables that decide flights: no commands, reports, profiles."""
    digests = sorted(
        hashlib.sha256(file.read_bytes()).digest()
        for package in ("airl_mav", "companion", "firmware_sim")
        for file in (ROOT / package).rglob("*.*")
        if file.suffix in (".py", ".toml")
        and file.relative_to(ROOT).parts[1] not in ("cli", "report", "_profiles", "__pycache__")
    )
    return hashlib.sha256(b"".join(digests)).hexdigest()[:12]


def package_versions() -> dict[str, str]:
    """Return the versions of all packages that can change a result, and of the sources."""
    found = {"airl-mav": __version__, SOURCES: sources_digest()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def version_changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the versions that differ, as text: "numpy 2.3.1, not 2.3.2"."""
    names = [name for name in {**new, **old} if old.get(name) != new.get(name)]
    return [f"{name} {old.get(name)}, not {new.get(name)}" for name in names]


def code_of(made: Mapping[str, Any]) -> str:
    """Return the identity of the code from `versions` and `git`: "FINGERPRINT@COMMIT".

    The fingerprint is equal for code with the same flights. The part from @ is missing without git.
    """
    versions, git = made.get("versions"), made.get("git")
    if not isinstance(versions, Mapping):
        return UNKNOWN
    lines = sorted(f"{k} {v}\n" for k, v in versions.items() if k not in NO_FLIGHT)
    fingerprint = hashlib.sha256("".join(lines).encode()).hexdigest()[:12]
    return f"{fingerprint}@{git.get('commit')}"[:23] if isinstance(git, Mapping) else fingerprint


@cache
def code_now() -> str:
    """Return the identity of the code of this process."""
    return code_of({"versions": package_versions(), "git": git_state()})


def check_code(
    where: object,
    made: Mapping[str, Any],
    flown: Iterable[str | None] = (),
    *,
    mixed: bool,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Compare the code of a folder's results with this code.

    Args:
        where: Name of the folder in messages.
        made: Provenance of the folder: `versions` and `git`.
        flown: Code of each result.
        mixed: True accepts results of several versions.
        say: Called with a line about an accepted difference.

    Raises:
        UsageError: Results of other code, unless `mixed`.
    """
    held = dict.fromkeys((code_of(made), *(each or UNKNOWN for each in flown)))
    others = [code for code in held if code != code_now()]
    if not others:
        return
    line = f"{where}: flown with code {' and '.join(others[:3])}; this is {code_now()}"
    if {code.partition("@")[0] for code in others} == {code_now().partition("@")[0]}:
        say(f"{line}: another commit, the same code of flights")
        return
    old = made.get("versions")
    if isinstance(old, Mapping) and (changed := version_changes(old, package_versions())):
        line += f" ({'; '.join(changed)})"
    if not mixed:
        raise UsageError(f"{line}; accepted: a new folder, the same code, or --mixed-code")
    say(f"{line}: resumed with several versions of the code")


def flown_with(codes: Iterable[str | None]) -> str:
    """Return the code of flights as text; "" if it is unknown for all."""
    known = [code or UNKNOWN for code in codes]
    if len(set(known)) < 2:
        return "".join(set(known) - {UNKNOWN})
    return ", ".join(f"{each} ({known.count(each):,} flights)" for each in dict.fromkeys(known))


def mixed_code(codes: Iterable[str | None]) -> tuple[str, ...]:
    """Return a sentence if flights have different code; else nothing."""
    codes = list(codes)
    versions = len({(code or UNKNOWN).partition("@")[0] for code in codes})
    if versions < 2:
        return ()
    return (f"Flown with {versions} versions of the code: {flown_with(codes)}.",)


def provenance(command: str) -> dict[str, Any]:
    """Return versions, machine and commit for the results of a command, as plain values."""
    return {
        "created_utc": utc_now().isoformat(timespec="seconds"),
        "command": command,
        "versions": package_versions(),
        "machine": describe_machine(),
        "git": git_state(),
    }


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, operating system and Python. No names, no addresses."""
    # Imported here: reading a run does not need it.
    import psutil

    return {
        "cpu": _cpu_model(),
        "architecture": platform.machine(),
        "cores": os.cpu_count() or 1,
        "cores_usable": usable_cores(),
        "memory_bytes": psutil.virtual_memory().total,
        "os": f"{platform.system()} {platform.release()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
    }


def usable_cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu_model() -> str:
    """Return the processor's name: Linux lists it as `model name`, Arm boards as `Model`."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    fields = {
        key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)
    }
    return fields.get("model name") or fields.get("Model") or platform.machine()


def git_state(checkout: Path | None = None) -> dict[str, Any] | None:
    """Return `commit` and `changed` of a checkout, by default this package's; None without git."""
    root = checkout or Path(__file__).resolve().parents[2]
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        return None

    def ask(*words: str) -> str | None:
        done = subprocess.run(  # noqa: S603 - fixed words, no shell
            [git, "-C", str(root), *words],
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT_S,
            check=False,
        )
        return done.stdout.strip() if done.returncode == 0 else None

    try:
        commit = ask("rev-parse", "HEAD")
        changes = ask("status", "--porcelain")
    except (OSError, subprocess.TimeoutExpired):
        return None
    if commit is None:
        return None
    return {"commit": commit, "changed": bool(changes)}
