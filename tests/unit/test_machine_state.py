"""Governor, frequency, temperature, throttling: read where a system offers them."""

from __future__ import annotations

from pathlib import Path

from airl_mav.core.machine import NOT_OFFERED, machine_state, pi_throttling


def write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return root


CPU = "sys/devices/system/cpu"


def test_raspberry_pi(tmp_path: Path) -> None:
    root = write(
        tmp_path,
        {
            f"{CPU}/cpu0/cpufreq/scaling_governor": "ondemand",
            f"{CPU}/cpu0/cpufreq/scaling_cur_freq": "600000",
            f"{CPU}/cpu0/cpufreq/scaling_max_freq": "1500000",
            f"{CPU}/cpu1/cpufreq/scaling_governor": "ondemand",
            f"{CPU}/cpu1/cpufreq/scaling_cur_freq": "1500000",
            f"{CPU}/cpu1/cpufreq/scaling_max_freq": "1500000",
            "sys/class/thermal/thermal_zone0/type": "cpu-thermal",
            "sys/class/thermal/thermal_zone0/temp": "61835",
            "sys/class/thermal/thermal_zone1/type": "battery",
            "sys/class/thermal/thermal_zone1/temp": "90000",
            "proc/loadavg": "0.52 0.58 0.59 1/389 1234",
        },
    )
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


def test_x86_counts_throttling(tmp_path: Path) -> None:
    files = {
        f"{CPU}/cpu0/thermal_throttle/core_throttle_count": "0",
        f"{CPU}/cpu1/thermal_throttle/core_throttle_count": "3",
        "proc/cpuinfo": "processor : 0\ncpu MHz\t\t: 2596.100\ncpu MHz : 3000.5",
        "sys/class/hwmon/hwmon0/name": "k10temp",
        "sys/class/hwmon/hwmon0/temp1_input": "45000",
    }
    state = machine_state(write(tmp_path, files), lambda: None)
    assert state.throttling == "3 times since the start of the system"
    assert state.frequency_mhz == (2596.1, 3000.5)
    assert state.temperature_c == 45.0


def test_what_is_not_offered_is_said_to_be_so(tmp_path: Path) -> None:
    rows = dict(machine_state(tmp_path, lambda: None).rows())
    for name in ("governor", "frequency", "temperature", "throttling"):
        assert rows[name] == NOT_OFFERED


def test_every_flag_of_the_pi() -> None:
    assert pi_throttling(0) == "none"
    assert pi_throttling(1 << 3) == "soft temperature limit"
    assert len(pi_throttling(0xF000F).split(", ")) == 8


def test_this_machine_answers() -> None:
    assert len(machine_state().rows()) == 5
