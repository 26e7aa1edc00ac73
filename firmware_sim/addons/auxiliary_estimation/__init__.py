"""Auxiliary estimation: external vision, range finder and optical flow.

A vehicle has these sensors by `sensors.vision`, `rangefinder` and `optical_flow` of its profile, or
a client sends ODOMETRY, VISION_POSITION_ESTIMATE, DISTANCE_SENSOR or OPTICAL_FLOW_RAD. Parameters:
EKF2_EV_*, EKF2_RNG_*, EKF2_OF_*. Depends on: `firmware_sim` alone; needs no other add-on.
Guide: docs/how-to/gps-denied.md.
"""

_HERE = "firmware_sim.addons.auxiliary_estimation"

AIDING = {"auxiliary": f"{_HERE}.auxiliary_aids:AuxiliaryAids"}

SENSORS = {
    "vision": f"{_HERE}.sensors:VISION",
    "rangefinder": f"{_HERE}.sensors:RANGEFINDER",
    "optical_flow": f"{_HERE}.sensors:OPTICAL_FLOW",
}
