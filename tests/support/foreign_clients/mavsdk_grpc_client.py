"""Flies the vehicle with MAVSDK's gRPC API. Run by an interpreter that has mavsdk-grpc.

Prints one line of JSON with its readings.
"""

from __future__ import annotations

import asyncio
import json
import sys

from mavsdk_grpc import System
from mavsdk_grpc.offboard import VelocityNedYaw


async def fly(port: int, server_port: int) -> dict[str, object]:
    drone = System(port=server_port)
    await drone.connect(system_address=f"udpin://127.0.0.1:{port}")
    async for state in drone.core.connection_state():
        if state.is_connected:
            break
    async for health in drone.telemetry.health():
        if health.is_armable and health.is_home_position_ok:
            break
    parameters = await drone.param.get_all_params()
    await drone.action.set_takeoff_altitude(4.0)
    await drone.action.arm()
    await drone.action.takeoff()
    async for position in drone.telemetry.position():
        if position.relative_altitude_m > 3.0:
            break
    await drone.offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    moved_m = 0.0
    async for place in drone.telemetry.position_velocity_ned():
        moved_m = place.position.north_m
        if moved_m > 2.0:
            break
    await drone.offboard.stop()
    await drone.action.land()
    async for flying in drone.telemetry.in_air():
        if not flying:
            break
    number = len(parameters.int_params) + len(parameters.float_params)
    return {"parameters": number, "moved_m": moved_m, "landed": True}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asyncio.run(fly(int(sys.argv[1]), int(sys.argv[2])))) + "\n")
