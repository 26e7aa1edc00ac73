"""ONBOARD_COMPUTER_STATUS: what the ground station is told of the computer, once a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import psutil

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.machine import temperature_c
from companion.periodic import every

MESSAGE = "ONBOARD_COMPUTER_STATUS"

PERIOD_US = US_PER_S

NOT_KNOWN_8, NOT_KNOWN_16, NOT_KNOWN_32 = 2**8 - 1, 2**15 - 1, 2**32 - 1
"""What says "not known" in fields of uint8, int16 and uint32 (common.xml)."""

NO_TEMPERATURE = 2**7 - 1
"""The same of temperatures, int8 [°C]."""

CORES, BYTES_PER_MIB = 8, 2**20


class Sender(Protocol):
    """What sends MAVLink messages to the vehicle's network; `MavsdkLink` is one."""

    def send_message(self, name: str, fields: Mapping[str, Any]) -> bool:
        """Send a message by its name and fields; return whether it was sent."""
        ...


def computer_status(
    now_us: int, cores_percent: Sequence[float], ram_bytes: tuple[int, int], celsius: float | None
) -> dict[str, Any]:
    """Return the fields of the message at a time since the start [µs].

    The loads of 8 cores count. `ram_bytes` is memory in use and all.
    """
    cores = [round(percent) for percent in cores_percent[:CORES]]
    temperature = NO_TEMPERATURE if celsius is None else max(-128, min(126, round(celsius)))
    return {
        "time_usec": now_us,
        "uptime": now_us // US_PER_MS,
        "type": 0,  # the mission computer
        "cpu_cores": cores + [NOT_KNOWN_8] * (CORES - len(cores)),
        "cpu_combined": [NOT_KNOWN_8] * 10,
        "gpu_cores": [NOT_KNOWN_8] * 4,
        "gpu_combined": [NOT_KNOWN_8] * 10,
        "temperature_board": NO_TEMPERATURE,
        "temperature_core": [temperature] + [NO_TEMPERATURE] * (CORES - 1),
        "fan_speed": [NOT_KNOWN_16] * 4,
        "ram_usage": ram_bytes[0] // BYTES_PER_MIB,
        "ram_total": ram_bytes[1] // BYTES_PER_MIB,
        "storage_type": [NOT_KNOWN_32] * 4,
        "storage_usage": [NOT_KNOWN_32] * 4,
        "storage_total": [NOT_KNOWN_32] * 4,
        "link_type": [NOT_KNOWN_32] * 6,
        "link_tx_rate": [NOT_KNOWN_32] * 6,
        "link_rx_rate": [NOT_KNOWN_32] * 6,
        "link_tx_max": [NOT_KNOWN_32] * 6,
        "link_rx_max": [NOT_KNOWN_32] * 6,
    }


def _measured(now_us: int) -> dict[str, Any]:
    memory = psutil.virtual_memory()
    ram_bytes = memory.total - memory.available, memory.total
    return computer_status(now_us, psutil.cpu_percent(percpu=True), ram_bytes, temperature_c())


def present(
    link: Sender, clock: Clock, measure: Callable[[int], dict[str, Any]] = _measured
) -> AbstractContextManager[None]:
    """Send the computer's status (`measure`) from a thread while the context lasts."""
    return every(
        PERIOD_US,
        lambda: link.send_message(MESSAGE, measure(clock.time_us())),
        clock,
        "presence",
    )
