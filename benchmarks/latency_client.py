"""Client that stamps its setpoints and its telemetry. Started by `bench_mavsdk.py`, not by hand.

    PYTHON latency_client.py KIND PORT SETPOINTS RATE_HZ OUT

Uses only the standard library and the client library, as mavsdk-grpc needs a separate Python.
Writes its stamps to OUT: `sent`, when a setpoint was passed to the library [ns, CLOCK_MONOTONIC],
with its number / 1024 m/s as velocity to the north; and `heard`, when a position reached the
callback, with the position (three float32, hexadecimal).
"""

from __future__ import annotations

import asyncio
import json
import struct
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

HOST = "127.0.0.1"
SETTLE_S = 1.0


class Notes:
    """Sent setpoints and received positions of a client."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, int]] = []
        self.heard: list[tuple[str, int]] = []

    def hear(self, north: float, east: float, down: float) -> None:
        now = time.monotonic_ns()
        self.heard.append((struct.pack("<fff", north, east, down).hex(), now))

    def send(self, number: int) -> float:
        """Note a setpoint, and return its velocity to the north [m/s]."""
        self.sent.append((number, time.monotonic_ns()))
        return number / 1024.0


def in_turn(setpoints: int, rate_hz: float, send: Callable[[int], object]) -> None:
    """Send at a rate, from now on."""
    begun = time.monotonic()
    for number in range(1, setpoints + 1):
        time.sleep(max(0.0, begun + number / rate_hz - time.monotonic()))
        send(number)
    time.sleep(SETTLE_S)


def mavsdk_sync(notes: Notes, port: int, setpoints: int, rate_hz: float) -> None:
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.offboard import Offboard, VelocityNedYaw
    from mavsdk.plugins.telemetry import Telemetry

    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    mavsdk.add_any_connection(f"udpin://{HOST}:{port}")
    system = mavsdk.first_autopilot(30.0)
    telemetry, offboard = Telemetry(system), Offboard(system)

    def hear(now: Any, _: object) -> None:
        place = now.position
        notes.hear(place.north_m, place.east_m, place.down_m)

    telemetry.set_rate_position_velocity_ned(rate_hz)
    telemetry.subscribe_position_velocity_ned(hear)
    time.sleep(SETTLE_S)

    def send(number: int) -> None:
        # Created before the stamp: only the transmission is measured.
        setpoint = VelocityNedYaw(number / 1024.0, 0.0, 0.0, 0.0)
        notes.send(number)
        offboard.set_velocity_ned(setpoint)

    in_turn(setpoints, rate_hz, send)


async def in_turn_async(notes: Notes, setpoints: int, rate_hz: float, make: Any, send: Any) -> None:
    begun = time.monotonic()
    for number in range(1, setpoints + 1):
        await asyncio.sleep(max(0.0, begun + number / rate_hz - time.monotonic()))
        setpoint = make(number / 1024.0, 0.0, 0.0, 0.0)
        notes.send(number)
        await send(setpoint)
    await asyncio.sleep(SETTLE_S)


async def listening(notes: Notes, positions: AsyncIterator[Any]) -> None:
    async for now in positions:
        notes.hear(now.position.north_m, now.position.east_m, now.position.down_m)


async def mavsdk_asyncio(notes: Notes, port: int, setpoints: int, rate_hz: float) -> None:
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
    from mavsdk.asyncio.plugins.offboard import OffboardAsync, VelocityNedYaw
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    await mavsdk.add_any_connection(f"udpin://{HOST}:{port}")
    system = await mavsdk.first_autopilot(30.0)
    telemetry, offboard = TelemetryAsync(system), OffboardAsync(system)
    await telemetry.set_rate_position_velocity_ned(rate_hz)
    task = asyncio.create_task(listening(notes, telemetry.subscribe_position_velocity_ned()))
    await asyncio.sleep(SETTLE_S)
    await in_turn_async(notes, setpoints, rate_hz, VelocityNedYaw, offboard.set_velocity_ned)
    task.cancel()


async def mavsdk_grpc(notes: Notes, port: int, setpoints: int, rate_hz: float) -> None:
    import socket

    from mavsdk_grpc import System
    from mavsdk_grpc.offboard import VelocityNedYaw

    with socket.socket() as free:
        free.bind((HOST, 0))
        server_port = free.getsockname()[1]
    drone = System(port=server_port)
    await drone.connect(system_address=f"udpin://{HOST}:{port}")
    async for state in drone.core.connection_state():
        if state.is_connected:
            break
    await drone.telemetry.set_rate_position_velocity_ned(rate_hz)
    task = asyncio.create_task(listening(notes, drone.telemetry.position_velocity_ned()))
    await asyncio.sleep(SETTLE_S)
    send = drone.offboard.set_velocity_ned
    await in_turn_async(notes, setpoints, rate_hz, VelocityNedYaw, send)
    task.cancel()


def pymavlink(notes: Notes, port: int, setpoints: int, rate_hz: float) -> None:
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:{HOST}:{port}", source_system=1, source_component=195)
    link.wait_heartbeat()
    ended = threading.Event()

    def hear() -> None:
        while not ended.is_set():
            now = link.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=0.5)
            if now is not None:
                notes.hear(now.x, now.y, now.z)

    every_us = 1e6 / rate_hz
    link.mav.command_long_send(1, 1, 511, 0, 32, every_us, 0, 0, 0, 0, 0)
    thread = threading.Thread(target=hear)
    thread.start()
    time.sleep(SETTLE_S)

    def send(number: int) -> None:
        velocity = notes.send(number), 0.0, 0.0
        nothing = 0.0, 0.0, 0.0
        link.mav.set_position_target_local_ned_send(
            0, 1, 1, 1, 0x9C7, *nothing, *velocity, *nothing, 0.0, 0.0
        )

    in_turn(setpoints, rate_hz, send)
    ended.set()
    thread.join()


KINDS = {
    "pymavlink": pymavlink,
    "mavsdk": mavsdk_sync,
    "mavsdk-asyncio": mavsdk_asyncio,
    "mavsdk-grpc": mavsdk_grpc,
}


def main() -> None:
    kind, port, setpoints, rate_hz, out = sys.argv[1:]
    notes, run = Notes(), KINDS[kind]
    made = run(notes, int(port), int(setpoints), float(rate_hz))
    if made is not None:
        asyncio.run(made)
    Path(out).write_text(json.dumps({"sent": notes.sent, "heard": notes.heard}))


if __name__ == "__main__":
    main()
