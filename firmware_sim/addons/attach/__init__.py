"""Attached vehicle: its autopilot and simulator run elsewhere, for example PX4 in Gazebo.

Its telemetry moves the vehicle of the arena, whose images, verdicts and records are as usual.
Option: `--firmware attach`.
Depends on: `firmware_sim.external`, the add-on `kernel_plant`.
Guide: docs/how-to/real-firmware.md.
"""

FIRMWARE = {"attach": "firmware_sim.addons.attach.vehicle:ATTACH"}
