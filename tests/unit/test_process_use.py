"""Processor time and memory of this process, against the kernel's other figures."""

from __future__ import annotations

import mmap
import threading
from pathlib import Path

import psutil
import pytest

from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.resource_use import NO_SENSOR, UseMeter
from tests.unit.test_machine_power import ORIN_NX
from tests.unit.test_machine_state import write

MIB = 1 << 20


def test_processor_time_is_that_of_all_threads() -> None:
    meter, before = UseMeter(WallClock()), psutil.Process().cpu_times()
    meter.begin()
    numbers = list(range(100_000))
    threads = [threading.Thread(target=lambda: sorted(numbers, key=hash)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    use, after = meter.end(), psutil.Process().cpu_times()
    by_psutil = after.user + after.system - before.user - before.system
    assert use.cpu_s == pytest.approx(by_psutil, abs=0.05)  # psutil counts in steps of 10 ms.
    assert use.cpu_s > 0.0


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux has it")
def test_the_peak_is_that_of_the_time_between() -> None:
    meter = UseMeter(WallClock())
    # Given back to the system for sure, which an allocator may not do.
    first = mmap.mmap(-1, 64 * MIB)
    for page in range(0, len(first), mmap.PAGESIZE):
        first[page] = 1
    meter.begin()
    large = meter.end()
    first.close()
    meter.begin()
    small = meter.end()
    if small.peak_since != "begin":
        pytest.skip("this system does not let the peak be reset")
    assert large.peak_memory_bytes is not None
    assert small.peak_memory_bytes is not None
    assert large.peak_memory_bytes - small.peak_memory_bytes > 48 * MIB
    assert small.peak_memory_bytes == pytest.approx(psutil.Process().memory_info().rss, abs=8 * MIB)


def test_a_peak_that_cannot_be_reset_is_called_that_of_the_process(tmp_path: Path) -> None:
    write(tmp_path, {"proc/self/status": "Name:\tpython\nVmHWM:\t  2048 kB\nVmRSS:\t 1024 kB"})
    (tmp_path / "proc/self/clear_refs").mkdir()
    clock = SimClock()
    meter = UseMeter(clock, tmp_path)
    meter.begin()
    clock.advance(3_000_000)
    use = meter.end()
    assert (use.peak_memory_bytes, use.peak_since) == (2 * MIB, "process start")
    assert (use.wall_s, use.power_w, use.power_source) == (3.0, None, NO_SENSOR)


def test_power_is_measured_where_it_can_be_read(tmp_path: Path) -> None:
    meter = UseMeter(WallClock(), write(tmp_path, ORIN_NX))
    meter.begin()
    use = meter.end()
    assert use.power_w == pytest.approx(5.016 * 1.2)
    assert use.power_source == "INA monitor: VDD_IN"
    assert use.peak_memory_bytes is None
