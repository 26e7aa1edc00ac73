"""Thermal soak: decisions without a pause until the temperature is steady."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.machine import MachineState, throttled_since
from airl_mav.latency.stages import Samples, percentile, summarize

ROW_US = US_PER_S
"""Interval of the series."""

WINDOW_US = 60 * US_PER_S
"""Window of the comparison: the last minute with the first; below two minutes, the halves."""

FREQUENCY_DROP = 0.05
"""Relative drop of mean frequency that counts as throttling. A governor varies less from second to
second."""


class MachineReading(NamedTuple):
    """Machine state at one moment; None: not available."""

    frequency_mhz: float | None
    """Mean of the cores."""
    temperature_c: float | None
    power_w: float | None
    """Mean since the last reading."""


@dataclass(frozen=True)
class Soak:
    """Result of a thermal soak."""

    asked_s: float
    interrupted: bool
    series: dict[str, NDArray[np.float64]]
    """Rows of one second: `time_s` (end, since the start), `n` decisions, their `p50_ms` and
    `max_ms`, `frequency_mhz`, `temperature_c`, `power_w`; NaN if not available."""
    window_s: float
    """Duration of the first and of the last part [s]."""
    first_us: Samples
    """t2 of the first part's decisions, in order."""
    last_us: Samples
    """t2 of the last part's decisions, in order."""
    throttled: bool | None
    """True if the system reported throttling; None: not available."""

    @property
    def duration_s(self) -> float:
        """Duration of the soak [s]."""
        return float(self.series["time_s"][-1])

    def ends(self, name: str) -> tuple[float, float] | None:
        """Return the mean of a column over the first and the last part; None: not available."""
        column, time_s = self.series[name], self.series["time_s"]
        # A row longer than the window is the first part alone.
        first, last = max(self.window_s, time_s[0]), self.duration_s - self.window_s
        parts = time_s <= first, time_s > last
        known = [column[part & np.isfinite(column)] for part in parts]
        # A change needs a reading at both ends.
        if not all(part.size for part in known):
            return None
        return float(known[0].mean()), float(known[1].mean())

    @property
    def frequency_dropped(self) -> bool | None:
        """True if the processor is slower at the end; None: not available."""
        ends = self.ends("frequency_mhz")
        return None if ends is None else ends[1] < (1.0 - FREQUENCY_DROP) * ends[0]

    def facts(self) -> dict[str, Any]:
        """Return the soak without its series, as plain values."""
        return {
            "asked_s": self.asked_s,
            "duration_s": self.duration_s,
            "interrupted": self.interrupted,
            "window_s": self.window_s,
            "first_us": asdict(summarize(self.first_us)),
            "last_us": asdict(summarize(self.last_us)),
            **{name: self.ends(name) for name in MachineReading._fields},
            "frequency_dropped": self.frequency_dropped,
            "throttled": self.throttled,
        }

    def sentence(self) -> str:
        """Return the difference between the first and the last part, in one line."""
        part = "minute" if self.window_s == WINDOW_US / US_PER_S else f"{self.window_s:.0f} s"
        moved = [
            f"{name} {_change(percentile(self.first_us, p), percentile(self.last_us, p))}"
            for name, p in (("p50", 50.0), ("p99", 99.0))
        ]
        early = f" of {_minutes(self.asked_s)}, interrupted" if self.interrupted else ""
        return (
            f"soak of {_minutes(self.duration_s)}{early}: t2 from the first to the last {part}: "
            f"{', '.join(moved)}; {self._machine()}"
        )

    def _machine(self) -> str:
        """Return frequency, temperature and throttling as text."""
        mhz, celsius = self.ends("frequency_mhz"), self.ends("temperature_c")
        frequency = temperature = throttling = None
        if mhz is not None:
            change = "dropped" if self.frequency_dropped else "did not drop"
            frequency = f"frequency {change} ({mhz[0]:.0f} to {mhz[1]:.0f} MHz)"
        if celsius is not None:
            temperature = f"temperature {celsius[0]:.1f} to {celsius[1]:.1f} °C"
        if self.throttled is not None:
            throttling = "throttled" if self.throttled else "not throttled"
        known = {"frequency": frequency, "temperature": temperature, "throttling": throttling}
        return "; ".join(text or f"{name}: not available" for name, text in known.items())


def soak(
    decide: Callable[[], tuple[int, int]],
    duration_s: float,
    clock: Clock,
    *,
    read: Callable[[], MachineReading],
    state: Callable[[], MachineState],
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float], None] = lambda _: None,
) -> Soak:
    """Repeat decisions until `stop`, and read the machine's state every second.

    `decide` returns a decision's start and end by the clock [µs]. `read` reads the machine between
    decisions, `state` the machine's state before and after. `progress` gets the elapsed seconds,
    each row.
    """
    before, begun_us = state(), clock.time_us()
    end_us = begun_us + round(duration_s * US_PER_S)
    rows: list[tuple[float, ...]] = []
    first: list[tuple[int, Samples]] = []
    last: deque[tuple[int, Samples]] = deque()
    now_us = begun_us
    # At least one row: an immediate interrupt still has a result.
    while now_us < end_us and not (rows and stop()):
        row_end_us = min(now_us + ROW_US, end_us)
        taken: list[int] = []
        while now_us < row_end_us:
            started_us, now_us = decide()
            taken.append(now_us - started_us)
        samples = np.array(taken, np.int64)
        since_us = now_us - begun_us
        # Only both ends are kept: an hour of decisions would fill the memory of a small computer.
        if since_us <= WINDOW_US or not first:
            first.append((since_us, samples))
        last.append((since_us, samples))
        while len(last) > 1 and last[0][0] <= since_us - WINDOW_US:
            last.popleft()
        told = (np.nan if value is None else value for value in read())
        p50_ms, max_ms = (float(np.percentile(samples, p)) / US_PER_MS for p in (50, 100))
        rows.append((since_us / US_PER_S, len(samples), p50_ms, max_ms, *told))
        progress(since_us / US_PER_S)
        now_us = clock.time_us()
    names = ("time_s", "n", "p50_ms", "max_ms", *MachineReading._fields)
    lasted_us = last[-1][0]
    # In a short soak the first and the last part must not overlap.
    window_us = min(WINDOW_US, lasted_us // 2)
    early = [part for end, part in first if end <= window_us] or [first[0][1]]
    late = [part for end, part in last if end > lasted_us - window_us]
    return Soak(
        asked_s=duration_s,
        interrupted=now_us < end_us,
        series=dict(zip(names, np.array(rows, np.float64).T, strict=True)),
        window_s=window_us / US_PER_S,
        first_us=np.concatenate(early),
        last_us=np.concatenate(late),
        throttled=throttled_since(before.throttling, state().throttling),
    )


def _change(before_us: float | None, after_us: float | None) -> str:
    if before_us is None or after_us is None:
        return "too few decisions"
    share = f" ({after_us / before_us - 1.0:+.0%})" if before_us else ""
    return f"{before_us / US_PER_MS:.3f} to {after_us / US_PER_MS:.3f} ms{share}"


def _minutes(seconds: float) -> str:
    return f"{seconds / 60.0:.1f} min" if seconds >= 120.0 else f"{seconds:.0f} s"
