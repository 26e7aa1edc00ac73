"""Resource usage of a process in an interval: processor time, memory, electrical power.

`VmHWM` of /proc/self/status is the peak resident set since the start of the process. Writing 5 to
/proc/self/clear_refs resets it to the current value (Linux 4.0, proc(5)). If that is not permitted,
the peak covers the lifetime of the process, as reported by `ProcessUse.peak_since`.

Sources of the power in Linux's sysfs, in order of priority:

- INA2xx and INA3221 shunt monitors of hwmon (Jetson and other boards): `power*_input` [µW], or
  `in*_input` [mV] times `curr*_input` [mA]. A rail that feeds the whole board (`TOTAL_RAILS`) is
  used alone. Without such a rail, the rails are added up.
- A discharging battery: `power_now` [µW], or `current_now` [µA] times `voltage_now` [µV]. It feeds
  the whole machine.
- RAPL (Intel, AMD): energy counters [µJ] of the processor packages and of the memory, or of the
  whole platform if there is a domain `psys`. Other domains exclude the rest of the machine.

Formats: the kernel's Documentation/hwmon/sysfs-interface.rst, hwmon/ina3221.rst,
power/powercap/powercap.rst and ABI/testing/sysfs-class-power.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from airl_mav.core.clock import Clock, processor_time_us
from airl_mav.core.constants import US_PER_S
from airl_mav.core.machine import sysfs_number, sysfs_text

TOTAL_RAILS = ("VDD_IN", "POM_5V_IN")
"""Labels of rails that feed the whole board: Jetson Orin and Xavier NX, Jetson Nano."""

UNCONNECTED = "NC"
"""Label of an unconnected channel."""

INA3221_RAILS = 3
"""Number of rail channels; other channels are shunt voltages and the sum of the currents."""

NO_SENSOR = "no power sensor that can be read: no INA monitor, no discharging battery, no RAPL"

SAMPLE_EVERY_S = 1.0
"""Sampling interval, far below the fastest overflow of a RAPL counter (about a minute)."""


class EnergyCounters:
    """Energy counters that overflow to 0."""

    def __init__(self, name: str, zones: tuple[Path, ...]) -> None:
        """Set the folders of readable counters in the power capping framework."""
        self.name = name
        self._zones = zones
        self._last_uj = self._read()

    def take_j(self, elapsed_s: float) -> float | None:  # noqa: ARG002 (not needed by a counter)
        """Return the energy of the last `elapsed_s` seconds, since the previous call [J]."""
        before, self._last_uj = self._last_uj, self._read()
        total_uj = 0.0
        for zone, last, now in zip(self._zones, before, self._last_uj, strict=True):
            if last is None or now is None:
                return None
            wrapped = (sysfs_number(zone / "max_energy_range_uj") or 0.0) if now < last else 0.0
            total_uj += now - last + wrapped
        return 1e-6 * total_uj

    def _read(self) -> list[float | None]:
        return [sysfs_number(zone / "energy_uj") for zone in self._zones]


@dataclass(frozen=True)
class Rail:
    """Instantaneous power: the product of the values in its files."""

    name: str
    files: tuple[Path, ...]
    watts_per_unit: float

    def read_w(self) -> float | None:
        """Return the absolute power [W]; None if it is unreadable."""
        values = [sysfs_number(path) for path in self.files]
        known = [value for value in values if value is not None]
        return abs(math.prod(known)) * self.watts_per_unit if len(known) == len(values) else None


class Rails:
    """Sum of instantaneous powers, interpolated linearly over time."""

    def __init__(self, name: str, rails: tuple[Rail, ...]) -> None:
        self.name = name
        self._rails = rails
        self._last_w = self._read_w()

    def take_j(self, elapsed_s: float) -> float | None:
        """Return the energy since the previous call; as `EnergyCounters` does."""
        before, self._last_w = self._last_w, self._read_w()
        if before is None or self._last_w is None:
            return None
        return 0.5 * (before + self._last_w) * elapsed_s

    def _read_w(self) -> float | None:
        read = [rail.read_w() for rail in self._rails]
        known = [watts for watts in read if watts is not None]
        return sum(known) if len(known) == len(read) else None


PowerSource: TypeAlias = "EnergyCounters | Rails"


def find_power_source(root: Path = Path("/")) -> tuple[PowerSource | None, str]:
    """Return this machine's power source below `root`/sys and its name; or None and a reason."""
    found = _shunt_monitors(root) or _battery(root)
    if found is not None:
        return found, found.name
    return _rapl(root)


def _shunt_monitors(root: Path) -> Rails | None:
    monitors = sorted((root / "sys/class/hwmon").glob("hwmon*"))
    rails = [
        rail for monitor in monitors for rail in _rails_of(monitor) if rail.read_w() is not None
    ]
    whole = [rail for rail in rails if rail.name in TOTAL_RAILS]
    rails = whole[:1] or rails
    if not rails:
        return None
    return Rails(f"INA monitor: {', '.join(rail.name for rail in rails)}", tuple(rails))


def _rails_of(monitor: Path) -> Iterator[Rail]:
    """Yield the rails of an INA monitor of hwmon."""
    chip = sysfs_text(monitor / "name") or ""
    if not chip.startswith("ina"):
        return
    for number in range(1, INA3221_RAILS + 1):
        label = sysfs_text(monitor / f"in{number}_label") or f"{chip} {monitor.name}.{number}"
        power = monitor / f"power{number}_input"
        pair = monitor / f"in{number}_input", monitor / f"curr{number}_input"
        if label != UNCONNECTED:
            yield Rail(label, (power,) if power.exists() else pair, 1e-6)


def _battery(root: Path) -> Rails | None:
    """Return the batteries that currently feed the machine; None = no such battery."""
    rails = []
    for supply in sorted((root / "sys/class/power_supply").glob("*")):
        # Batteries of scope Device belong to peripherals such as a mouse.
        mine = sysfs_text(supply / "type") == "Battery" and (
            sysfs_text(supply / "scope") != "Device"
        )
        if not mine or sysfs_text(supply / "status") != "Discharging":
            continue
        power, pair = supply / "power_now", (supply / "current_now", supply / "voltage_now")
        rail = (
            Rail(supply.name, (power,), 1e-6) if power.exists() else Rail(supply.name, pair, 1e-12)
        )
        if rail.read_w() is not None:
            rails.append(rail)
    names = ", ".join(rail.name for rail in rails)
    return Rails(f"battery: {names}", tuple(rails)) if rails else None


def _rapl(root: Path) -> tuple[EnergyCounters | None, str]:
    zones = {
        zone: sysfs_text(zone / "name") or zone.name
        for zone in sorted((root / "sys/class/powercap").glob("intel-rapl:*"))
    }
    counted = [zone for zone, name in zones.items() if name == "psys"] or [
        zone for zone, name in zones.items() if name.startswith(("package", "dram"))
    ]
    readable = [zone for zone in counted if sysfs_number(zone / "energy_uj") is not None]
    if not counted:
        return None, NO_SENSOR
    if not readable:
        return None, "RAPL is there, but this user may not read it (energy_uj)"
    counters = EnergyCounters(f"RAPL: {', '.join(zones[z] for z in readable)}", tuple(readable))
    return counters, counters.name


class PowerMeter:
    """Averages the power of a source over time."""

    def __init__(self, source: PowerSource, clock: Clock) -> None:
        """Start the measurement."""
        self._source, self._clock = source, clock
        self._begun_us = self._last_us = clock.time_us()
        self._energy_j: float | None = 0.0

    def sample(self) -> float | None:
        """Return the mean power since the last sample [W]; None if unreadable or no time passed.

        Must be called more often than the counters of the source overflow.
        """
        now_us = self._clock.time_us()
        elapsed_s = (now_us - self._last_us) / US_PER_S
        if elapsed_s <= 0.0:
            return None
        self._last_us = now_us
        energy_j = self._source.take_j(elapsed_s)
        if energy_j is None or self._energy_j is None:
            self._energy_j = None
            return None
        self._energy_j += energy_j
        return energy_j / elapsed_s

    @property
    def mean_w(self) -> float | None:
        """Mean power up to the last sample [W]; None without samples or after a failed one."""
        elapsed_s = (self._last_us - self._begun_us) / US_PER_S
        return None if self._energy_j is None or not elapsed_s else self._energy_j / elapsed_s


class PowerSampling:
    """Context that samples a meter in a separate thread."""

    def __init__(self, source: PowerSource, clock: Clock) -> None:
        """Set the source and the wall clock."""
        self._clock = clock
        self.meter = PowerMeter(source, clock)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="power", daemon=True)

    def __enter__(self) -> PowerMeter:
        """Start the thread."""
        self._thread.start()
        return self.meter

    def __exit__(self, *_: object) -> None:
        """Stop the thread and take a last sample."""
        self._ending.set()
        self._thread.join()
        self.meter.sample()

    def _run(self) -> None:
        while not self._ending.is_set():
            wake_us = self._clock.time_us() + round(SAMPLE_EVERY_S * US_PER_S)
            self._clock.sleep_until(wake_us, self._ending)
            if not self._ending.is_set():
                self.meter.sample()


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
