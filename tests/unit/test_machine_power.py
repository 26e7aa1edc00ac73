"""The power that a machine says it draws, from sysfs trees as Linux makes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.resource_use import NO_SENSOR, PowerMeter, PowerSampling, find_power_source
from tests.unit.test_machine_state import write

RAPL = "sys/class/powercap"
HWMON = "sys/class/hwmon"
SUPPLY = "sys/class/power_supply"
RANGE_UJ = 262_143_328_850

ORIN_NX = {
    f"{HWMON}/hwmon0/name": "pwmfan",
    f"{HWMON}/hwmon1/name": "ina3221",
    f"{HWMON}/hwmon1/in1_label": "VDD_IN",
    f"{HWMON}/hwmon1/in1_input": "5016",
    f"{HWMON}/hwmon1/curr1_input": "1200",
    f"{HWMON}/hwmon1/in2_label": "VDD_CPU_GPU_CV",
    f"{HWMON}/hwmon1/in2_input": "5016",
    f"{HWMON}/hwmon1/curr2_input": "400",
    f"{HWMON}/hwmon1/in3_label": "VDD_SOC",
    f"{HWMON}/hwmon1/in3_input": "5008",
    f"{HWMON}/hwmon1/curr3_input": "300",
    f"{HWMON}/hwmon1/curr4_input": "1900",
}
BATTERY = {
    f"{SUPPLY}/BAT0/type": "Battery",
    f"{SUPPLY}/BAT0/status": "Discharging",
    f"{SUPPLY}/BAT0/power_now": "9500000",
}
PACKAGE = {
    f"{RAPL}/intel-rapl/enabled": "1",
    f"{RAPL}/intel-rapl:0/name": "package-0",
    f"{RAPL}/intel-rapl:0/energy_uj": "1000000",
    f"{RAPL}/intel-rapl:0/max_energy_range_uj": f"{RANGE_UJ}",
    f"{RAPL}/intel-rapl:0:0/name": "core",
    f"{RAPL}/intel-rapl:0:0/energy_uj": "700000",
    f"{RAPL}/intel-rapl:0:2/name": "dram",
    f"{RAPL}/intel-rapl:0:2/energy_uj": "200000",
    f"{RAPL}/intel-rapl:0:2/max_energy_range_uj": "65712999613",
    f"{RAPL}/intel-rapl-mmio:0/name": "package-0",
    f"{RAPL}/intel-rapl-mmio:0/energy_uj": "5000000",
}


def metered(root: Path) -> tuple[PowerMeter, SimClock, str]:
    source, name = find_power_source(root)
    assert source is not None
    assert source.name == name
    clock = SimClock()
    return PowerMeter(source, clock), clock, name


def powered(root: Path, files: dict[str, str], seconds: float = 2.0) -> tuple[float, str]:
    """Return the mean power of a machine with constant files, and its source."""
    meter, clock, name = metered(write(root, files))
    clock.advance(round(seconds * 1e6))
    watts = meter.sample()
    assert watts is not None
    assert meter.mean_w == pytest.approx(watts)
    return watts, name


def test_the_rail_that_feeds_a_jetson_counts_alone(tmp_path: Path) -> None:
    watts, name = powered(tmp_path, ORIN_NX)
    assert watts == pytest.approx(5.016 * 1.2)
    assert name == "INA monitor: VDD_IN"


def test_without_such_a_rail_they_are_added_up(tmp_path: Path) -> None:
    """Jetson AGX Orin: two chips, one channel not connected, no rail for the whole."""
    files = {
        f"{HWMON}/hwmon1/name": "ina3221",
        f"{HWMON}/hwmon1/in1_label": "VDD_GPU_SOC",
        f"{HWMON}/hwmon1/in1_input": "20000",
        f"{HWMON}/hwmon1/curr1_input": "500",
        f"{HWMON}/hwmon2/name": "ina3221",
        f"{HWMON}/hwmon2/in1_label": "NC",
        f"{HWMON}/hwmon2/in1_input": "20000",
        f"{HWMON}/hwmon2/curr1_input": "500",
        f"{HWMON}/hwmon3/name": "ina226",
        f"{HWMON}/hwmon3/power1_input": "2500000",
        f"{HWMON}/hwmon3/in1_input": "5000",
        f"{HWMON}/hwmon3/curr1_input": "480",
        f"{HWMON}/hwmon4/name": "amdgpu",
        f"{HWMON}/hwmon4/power1_input": "90000000",
    }
    watts, name = powered(tmp_path, files)
    assert watts == pytest.approx(20.0 * 0.5 + 2.5)
    assert name == "INA monitor: VDD_GPU_SOC, ina226 hwmon3.1"


@pytest.mark.parametrize(
    ("now", "watts"),
    [
        ({"power_now": "9500000"}, 9.5),
        ({"current_now": "-1250000", "voltage_now": "11400000"}, 1.25 * 11.4),
    ],
)
def test_a_battery_that_is_drawn_from(tmp_path: Path, now: dict[str, str], watts: float) -> None:
    files = {
        f"{SUPPLY}/BAT0/type": "Battery",
        f"{SUPPLY}/BAT0/status": "Discharging",
        **{f"{SUPPLY}/BAT0/{name}": value for name, value in now.items()},
        f"{SUPPLY}/hidpp_battery_0/type": "Battery",
        f"{SUPPLY}/hidpp_battery_0/scope": "Device",
        f"{SUPPLY}/hidpp_battery_0/status": "Discharging",
        f"{SUPPLY}/hidpp_battery_0/power_now": "50000",
        f"{SUPPLY}/AC/type": "Mains",
    }
    found_w, name = powered(tmp_path, {**PACKAGE, **files})
    assert found_w == pytest.approx(watts)
    assert name == "battery: BAT0"


def test_a_battery_that_is_charged_says_nothing(tmp_path: Path) -> None:
    write(tmp_path, {**BATTERY, f"{SUPPLY}/BAT0/status": "Charging"})
    assert find_power_source(tmp_path) == (None, NO_SENSOR)


def test_rapl_adds_package_and_memory_over_an_overflow(tmp_path: Path) -> None:
    meter, clock, name = metered(write(tmp_path, PACKAGE))
    assert name == "RAPL: package-0, dram"
    package = tmp_path / RAPL / "intel-rapl:0/energy_uj"
    package.write_text(f"{RANGE_UJ - 1_000_000}\n")
    clock.advance(1_000_000)
    assert meter.sample() == pytest.approx(1e-6 * (RANGE_UJ - 2_000_000))
    # 25 J later the counter of the package has begun again; the memory took 3 J.
    package.write_text("24000000\n")
    (tmp_path / RAPL / "intel-rapl:0:2/energy_uj").write_text("3200000\n")
    clock.advance(2_000_000)
    assert meter.sample() == pytest.approx((25.0 + 3.0) / 2.0)
    assert meter.mean_w == pytest.approx((1e-6 * (RANGE_UJ - 2_000_000) + 28.0) / 3.0)
    assert meter.sample() is None  # No time has passed.


def test_the_whole_platform_counts_before_its_parts(tmp_path: Path) -> None:
    files = {f"{RAPL}/intel-rapl:1/name": "psys", f"{RAPL}/intel-rapl:1/energy_uj": "0"}
    source, name = find_power_source(write(tmp_path, {**PACKAGE, **files}))
    assert source is not None
    assert name == "RAPL: psys"


def test_counters_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    # As of a user without the right: the kernel lists the file, and refuses to read it.
    write(tmp_path, {f"{RAPL}/intel-rapl:0/name": "package-0"})
    (tmp_path / RAPL / "intel-rapl:0/energy_uj").mkdir()
    source, reason = find_power_source(tmp_path)
    assert source is None
    assert "RAPL" in reason
    assert "may not read" in reason


def test_power_that_changes_is_averaged_over_time(tmp_path: Path) -> None:
    meter, clock, _ = metered(write(tmp_path, BATTERY))
    now = tmp_path / SUPPLY / "BAT0/power_now"
    for second in range(1, 11):  # 9.5 W rising by 1 W a second: 14.5 W on average.
        now.write_text(f"{9_500_000 + 1_000_000 * second}")
        clock.advance(1_000_000)
        assert meter.sample() == pytest.approx(9.0 + second)
    assert meter.mean_w == pytest.approx(14.5)
    now.unlink()
    clock.advance(1_000_000)
    assert meter.sample() is None
    assert meter.mean_w is None


def test_a_machine_without_sensors_says_so(tmp_path: Path) -> None:
    assert find_power_source(tmp_path) == (None, NO_SENSOR)


def test_a_thread_samples_until_the_end(tmp_path: Path) -> None:
    source, _ = find_power_source(write(tmp_path, ORIN_NX))
    assert source is not None
    with PowerSampling(source, WallClock()) as meter:
        pass
    assert meter.mean_w == pytest.approx(5.016 * 1.2)
