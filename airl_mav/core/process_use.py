"""Resource usage of this process in an interval: processor time, memory, and power.

`VmHWM` of /proc/self/status is the peak resident set since the start of the process. Writing 5 to
/proc/self/clear_refs resets it to the current value (Linux 4.0, proc(5)). If that is not permitted,
the peak covers the lifetime of the process, as reported by `ProcessUse.peak_since`.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from airl_mav.core.clock import Clock, processor_time_us
from airl_mav.core.constants import US_PER_S
from airl_mav.core.machine import sysfs_text
from airl_mav.core.power_meter import PowerMeter, PowerSampling, find_power_source

BYTES_PER_KIB = 1024


@dataclass(frozen=True)
class ProcessUse:
    """Resource usage of a process in an interval."""

    wall_s: float
    """Duration of the interval [wall s]."""
    cpu_s: float
    """Processor time of all threads [s]."""
    peak_memory_bytes: int | None
    """Peak resident set: all memory in RAM, including shared libraries."""
    peak_since: Literal["begin", "process start"]
    """Start of the interval for the peak."""
    power_w: float | None
    """Mean power of the machine, or of the part that the source measures [W]."""
    power_source: str
    """Source of the power, or the reason for a missing value."""

    @property
    def cores(self) -> float:
        """Processor time by wall time: 1 is one fully used core."""
        return self.cpu_s / self.wall_s if self.wall_s > 0.0 else 0.0


class UseMeter:
    """Meter of the resource usage from `begin` to `end`."""

    def __init__(self, clock: Clock, root: Path = Path("/")) -> None:
        """Set the wall clock; `root` contains /proc and /sys."""
        self._clock, self._root = clock, root
        self._sampling = ExitStack()
        self._power: PowerMeter | None = None

    def begin(self) -> None:
        """Start the measurement."""
        self._reset = _reset_peak(self._root)
        source, self._source = find_power_source(self._root)
        if source is not None:
            self._power = self._sampling.enter_context(PowerSampling(source, self._clock))
        self._begun_us, self._used_us = self._clock.time_us(), processor_time_us()

    def end(self) -> ProcessUse:
        """Return the usage since `begin`."""
        used_us = processor_time_us() - self._used_us
        wall_us = self._clock.time_us() - self._begun_us
        self._sampling.close()
        return ProcessUse(
            wall_s=wall_us / US_PER_S,
            cpu_s=used_us / US_PER_S,
            peak_memory_bytes=_peak_bytes(self._root),
            peak_since="begin" if self._reset else "process start",
            power_w=None if self._power is None else self._power.mean_w,
            power_source=self._source,
        )


def _reset_peak(root: Path) -> bool:
    """Reset the peak of the resident set to the current value; return False on failure."""
    try:
        (root / "proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak_bytes(root: Path) -> int | None:
    """Return the peak of the resident set; None if not available."""
    for line in (sysfs_text(root / "proc/self/status") or "").splitlines():
        name, _, value = line.partition(":")
        if name == "VmHWM":
            return int(value.split()[0]) * BYTES_PER_KIB
    return None
