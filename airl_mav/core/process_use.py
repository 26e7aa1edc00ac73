"""What this process takes of its machine over a time: processor time, memory, and the power drawn.

`VmHWM` of /proc/self/status is the greatest resident set since the process began. Writing 5 to
/proc/self/clear_refs sets it back to the present one (Linux 4.0, proc(5)). Where that is not
permitted, the peak stays that of the whole life of the process, and `ProcessUse.peak_since` says
so.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from airl_mav.core.clock import Clock, processor_time_us
from airl_mav.core.constants import US_PER_S
from airl_mav.core.machine import sysfs_text
from airl_mav.core.power import PowerMeter, PowerSampling, find_power_source

BYTES_PER_KIB = 1024


@dataclass(frozen=True)
class ProcessUse:
    """What a process took of its machine while it did something."""

    wall_s: float
    """How long that lasted [wall s]."""
    cpu_s: float
    """Processor time of all its threads [s]."""
    peak_memory_bytes: int | None
    """Greatest resident set: all its memory that lay in RAM, shared libraries included."""
    peak_since: Literal["begin", "process start"]
    """Since when that is the greatest."""
    power_w: float | None
    """Mean power of the whole machine, as far as its source sees it [W]."""
    power_source: str
    """What told the power, or why nothing did."""

    @property
    def cores(self) -> float:
        """Processor time by wall time: 1 is one core, all the time."""
        return self.cpu_s / self.wall_s if self.wall_s > 0.0 else 0.0


class UseMeter:
    """Measures from its `begin` to its `end`."""

    def __init__(self, clock: Clock, root: Path = Path("/")) -> None:
        """Take the wall clock, and where /proc and /sys are found."""
        self._clock, self._root = clock, root
        self._sampling = ExitStack()
        self._power: PowerMeter | None = None

    def begin(self) -> None:
        """Begin."""
        self._reset = _reset_peak(self._root)
        source, self._source = find_power_source(self._root)
        if source is not None:
            self._power = self._sampling.enter_context(PowerSampling(source, self._clock))
        self._begun_us, self._used_us = self._clock.time_us(), processor_time_us()

    def end(self) -> ProcessUse:
        """Return what was used since the beginning."""
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
    """Set the peak of the resident set back to the present one; return whether that worked."""
    try:
        (root / "proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak_bytes(root: Path) -> int | None:
    """Return the peak of the resident set; None where the system does not tell."""
    for line in (sysfs_text(root / "proc/self/status") or "").splitlines():
        name, _, value = line.partition(":")
        if name == "VmHWM":
            return int(value.split()[0]) * BYTES_PER_KIB
    return None
