"""The electrical power that a machine says it draws, from Linux's sysfs.

Looked for in this order, the first that answers counts:

- INA2xx and INA3221 shunt monitors of hwmon (Jetson and other boards): `power*_input` [µW], or
  `in*_input` [mV] times `curr*_input` [mA]. A rail that feeds the whole board (`TOTAL_RAILS`)
  counts alone. Without one the rails are added up.
- A battery that is being discharged: `power_now` [µW], or `current_now` [µA] times `voltage_now`
  [µV]. It feeds the whole machine.
- RAPL (Intel, AMD): energy counters [µJ] of the processor packages and of the memory, or of the
  whole platform where there is a domain `psys`. All but that one leave the rest of the machine out.

Formats: the kernel's Documentation/hwmon/sysfs-interface.rst, hwmon/ina3221.rst,
power/powercap/powercap.rst and ABI/testing/sysfs-class-power.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.machine import sysfs_number, sysfs_text

TOTAL_RAILS = ("VDD_IN", "POM_5V_IN")
"""Labels of rails that feed the whole board: Jetson Orin and Xavier NX, Jetson Nano."""

UNCONNECTED = "NC"
"""Label of a channel that measures nothing."""

INA3221_RAILS = 3
"""Channels that are rails; the others are shunt voltages, and the sum of the currents."""

NO_SENSOR = "no power sensor that can be read: no INA monitor, no discharging battery, no RAPL"

SAMPLE_EVERY_S = 1.0
"""Far less than the fastest overflow of a RAPL counter (about a minute), and cheap."""


class PowerSource(Protocol):
    """Something that knows what is drawn."""

    @property
    def name(self) -> str:
        """What is measured, in words."""

    def take_j(self, elapsed_s: float) -> float | None:
        """Return the energy of the last `elapsed_s`, since the call before [J]."""


class EnergyCounters:
    """Counters that run up and begin again at 0. Implements `PowerSource`."""

    def __init__(self, name: str, zones: tuple[Path, ...]) -> None:
        """Take folders of the power capping framework, whose counters can be read."""
        self.name = name
        self._zones = zones
        self._last_uj = self._read()

    def take_j(self, elapsed_s: float) -> float | None:  # noqa: ARG002 (it counts by itself)
        """Return the energy since the call before; see `PowerSource`."""
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
    """A power that can be read at a moment: the product of what its files say."""

    name: str
    files: tuple[Path, ...]
    watts_per_unit: float

    def read_w(self) -> float | None:
        """Return the power [W], whichever way the current is counted; None: unreadable."""
        values = [sysfs_number(path) for path in self.files]
        known = [value for value in values if value is not None]
        return abs(math.prod(known)) * self.watts_per_unit if len(known) == len(values) else None


class Rails:
    """The sum of powers at moments; between two the power changes evenly. A `PowerSource`."""

    def __init__(self, name: str, rails: tuple[Rail, ...]) -> None:
        self.name = name
        self._rails = rails
        self._last_w = self._read_w()

    def take_j(self, elapsed_s: float) -> float | None:
        """Return the energy since the call before; see `PowerSource`."""
        before, self._last_w = self._last_w, self._read_w()
        if before is None or self._last_w is None:
            return None
        return 0.5 * (before + self._last_w) * elapsed_s

    def _read_w(self) -> float | None:
        read = [rail.read_w() for rail in self._rails]
        known = [watts for watts in read if watts is not None]
        return sum(known) if len(known) == len(read) else None


def find_power_source(root: Path = Path("/")) -> tuple[PowerSource | None, str]:
    """Return this machine's power source, found below `root`/sys, and its name; None, and why."""
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
    """Yield the rails that an INA monitor of hwmon measures."""
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
    """Return the batteries that feed the machine at the moment."""
    rails = []
    for supply in sorted((root / "sys/class/power_supply").glob("*")):
        # Those of scope Device are a mouse's.
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
        """Begin now."""
        self._source, self._clock = source, clock
        self._begun_us = self._last_us = clock.time_us()
        self._energy_j: float | None = 0.0

    def sample(self) -> float | None:
        """Return the mean power since the last sample [W]; None: unreadable, or no time passed.

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
        """Mean power up to the last sample [W]; None: none, or one could not be read."""
        elapsed_s = (self._last_us - self._begun_us) / US_PER_S
        return None if self._energy_j is None or not elapsed_s else self._energy_j / elapsed_s


class PowerSampling:
    """Samples a meter from a thread of its own for as long as the context lasts."""

    def __init__(self, source: PowerSource, clock: Clock) -> None:
        """Take the source, and the wall clock."""
        self._clock = clock
        self.meter = PowerMeter(source, clock)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="power", daemon=True)

    def __enter__(self) -> PowerMeter:
        """Start."""
        self._thread.start()
        return self.meter

    def __exit__(self, *_: object) -> None:
        """End, with a last sample."""
        self._ending.set()
        self._thread.join()
        self.meter.sample()

    def _run(self) -> None:
        while not self._ending.is_set():
            wake_us = self._clock.time_us() + round(SAMPLE_EVERY_S * US_PER_S)
            self._clock.sleep_until(wake_us, self._ending)
            if not self._ending.is_set():
                self.meter.sample()
