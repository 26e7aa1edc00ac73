"""Fly a square through MAVSDK: an ordinary client, nothing of it knows the simulator.

    airl-firmware --arena open-field        # in another terminal
    python examples/mavsdk_client.py

It lives by the wall clock, as on a real aircraft. Another address than MAVSDK's usual one may be
given as the first argument.
"""

import sys
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.offboard import Offboard, VelocityNedYaw
from mavsdk.plugins.telemetry import LandedState, Telemetry

url = sys.argv[1] if len(sys.argv) > 1 else "udpin://127.0.0.1:14540"
mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
mavsdk.add_any_connection(url)
vehicle = mavsdk.first_autopilot(60)
if vehicle is None:
    sys.exit(f"no flight controller heard on {url}")
telemetry, action, offboard = Telemetry(vehicle), Action(vehicle), Offboard(vehicle)

while True:  # the estimator needs some seconds before the vehicle may be armed
    try:
        action.arm()
        break
    except ActionError:
        time.sleep(0.5)
action.set_takeoff_altitude(3.0)
action.takeoff()
while not telemetry.position_velocity_ned().position.down_m < -2.7:  # NaN until the first message
    time.sleep(0.1)

offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
offboard.start()
for north, east in (2.0, 0.0), (0.0, 2.0), (-2.0, 0.0), (0.0, -2.0):
    offboard.set_velocity_ned(VelocityNedYaw(north, east, 0.0, 0.0))
    time.sleep(3.0)
    place = telemetry.position_velocity_ned().position
    print(f"corner at {place.north_m:.1f} m north, {place.east_m:.1f} m east")

action.land()
while telemetry.landed_state() != LandedState.ON_GROUND:
    time.sleep(0.2)
print("landed")
