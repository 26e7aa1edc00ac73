"""Messages to the vehicle's network: the computer's status, and obstacles seen by the camera.

Sends ONBOARD_COMPUTER_STATUS in every flight of a stand-alone companion.
Option: `--tell-obstacles` of the companion: OBSTACLE_DISTANCE for PX4's collision prevention.
Depends on: `companion.frame_source`, psutil.
Guide: docs/how-to/on-board.md.
"""

REPORTS = {"vehicle": "companion.addons.vehicle_reports.reports:reporting"}
