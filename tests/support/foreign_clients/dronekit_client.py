"""Flies the vehicle with dronekit. Run by an interpreter that has dronekit and future.

Prints one line of JSON with its readings.
"""

from __future__ import annotations

import collections
import collections.abc
import json
import sys
import time
from collections.abc import Callable

# dronekit 2.9 is older than Python 3.10, which took this name away.
collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]

import dronekit  # noqa: E402
from pymavlink import mavutil  # noqa: E402

PATIENCE_S = 120.0


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Wait until a condition is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(what)
        time.sleep(0.05)


def fly(port: int) -> dict[str, object]:
    kinds = ["parameters", "gps_0", "attitude", "armed"]
    vehicle = dronekit.connect(f"udpin:127.0.0.1:{port}", wait_ready=kinds, timeout=PATIENCE_S)

    def command(number: int, *params: float) -> None:
        filled = [*params, *[float("nan")] * (7 - len(params))]
        vehicle.send_mavlink(vehicle.message_factory.command_long_encode(1, 1, number, 0, *filled))

    vehicle.parameters["MIS_TAKEOFF_ALT"] = 4.0
    wait_for(lambda: vehicle.gps_0.fix_type == 3, "a fix")
    # Until the estimator is ready arming is refused, and no repetition does harm.
    deadline = time.monotonic() + PATIENCE_S
    while not vehicle.armed and time.monotonic() < deadline:
        command(mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        time.sleep(0.5)
    command(mavutil.mavlink.MAV_CMD_NAV_TAKEOFF)
    wait_for(lambda: vehicle.location.global_relative_frame.alt > 3.0, "the altitude")
    height_m = vehicle.location.global_relative_frame.alt
    command(mavutil.mavlink.MAV_CMD_NAV_LAND)
    wait_for(lambda: not vehicle.armed, "disarmed")
    number = len(vehicle.parameters)
    vehicle.close()
    return {"parameters": number, "height_m": height_m, "landed": True}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(fly(int(sys.argv[1]))) + "\n")
