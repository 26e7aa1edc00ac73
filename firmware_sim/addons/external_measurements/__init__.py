"""Measurements that clients send: poses, distances, optical flow, obstacles and landing targets.

Handles ODOMETRY, VISION_POSITION_ESTIMATE, DISTANCE_SENSOR, OPTICAL_FLOW_RAD, OBSTACLE_DISTANCE and
LANDING_TARGET. The vehicle's own sensors are in its profile and do not need this.
Depends on: `firmware_sim.autopilot`, `firmware_sim.mavlink`.
Guide: docs/how-to/gps-denied.md.
"""

SERVICES = {"measurements": "firmware_sim.addons.external_measurements.measurements"}
