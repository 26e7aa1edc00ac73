"""Governor, frequency, temperature, throttling: read where a system offers them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from airl_mav.core.machine import NOT_OFFERED, machine_state, pi_throttling


def write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


CPU = "sys/devices/system/cpu"


def sensors(
    monkeypatch: pytest.MonkeyPatch, mhz: list[tuple[float, float]], celsius: dict[str, list[float]]
) -> None:
    """Make psutil report the readings of another machine."""
    cores = [SimpleNamespace(current=now, max=limit) for now, limit in mhz]
    found = {name: [SimpleNamespace(current=c) for c in each] for name, each in celsius.items()}
    monkeypatch.setattr(psutil, "cpu_freq", lambda percpu: cores)
    monkeypatch.setattr(psutil, "sensors_temperatures", lambda: found)
    monkeypatch.setattr(psutil, "getloadavg", lambda: (0.52, 0.58, 0.59))


def test_raspberry_pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write(
        tmp_path,
        {
            f"{CPU}/cpu0/cpufreq/scaling_governor": "ondemand",
            f"{CPU}/cpu1/cpufreq/scaling_governor": "ondemand",
        },
    )
    temperatures = {"cpu_thermal": [61.835], "battery": [90.0]}
    sensors(monkeypatch, [(600.0, 1500.0), (1500.0, 1500.0)], temperatures)
    state = machine_state(root, lambda: "throttled=0x50005")
    assert dict(state.rows()) == {
        "governor": "ondemand",
        "frequency": "600 to 1500 MHz, at most 1500 MHz",
        "temperature": "61.8 °C",
        "throttling": (
            "under-voltage, throttled, under-voltage has occurred, throttling has occurred"
        ),
        "load average": "0.52, 0.58, 0.59",
    }


def test_sysfs_is_asked_before_the_program(tmp_path: Path) -> None:
    root = write(tmp_path, {"sys/devices/platform/soc/soc:firmware/get_throttled": "0"})
    assert machine_state(root, lambda: "throttled=0x1").throttling == "none"


def test_x86_counts_throttling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        f"{CPU}/cpu0/thermal_throttle/core_throttle_count": "0",
        f"{CPU}/cpu1/thermal_throttle/core_throttle_count": "3",
    }
    sensors(monkeypatch, [(2596.1, 0.0), (3000.5, 0.0)], {"k10temp": [45.0, 44.0]})
    state = machine_state(write(tmp_path, files), lambda: None)
    assert state.throttling == "3 times since the start of the system"
    assert state.frequency_mhz == (2596.1, 3000.5)
    assert state.frequency_limit_mhz is None
    assert state.temperature_c == 45.0


def test_what_is_not_offered_is_said_to_be_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensors(monkeypatch, [], {})
    rows = dict(machine_state(tmp_path, lambda: None).rows())
    for name in ("governor", "frequency", "temperature", "throttling"):
        assert rows[name] == NOT_OFFERED


def test_every_flag_of_the_pi() -> None:
    assert pi_throttling(0) == "none"
    assert pi_throttling(1 << 3) == "soft temperature limit"
    assert len(pi_throttling(0xF000F).split(", ")) == 8


def test_this_machine_answers() -> None:
    assert len(machine_state().rows()) == 5
