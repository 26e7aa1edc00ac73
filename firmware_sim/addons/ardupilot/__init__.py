"""ArduPilot SITL in place of the built-in flight controller.

ArduCopter flies the vehicle through its JSON simulator interface, in real time.
Option: `--firmware ardupilot`; parameters for it: `airl parameters ardupilot`.
Depends on: `firmware_sim.external`; an ArduCopter build.
Guide: docs/how-to/real-firmware.md.
"""

FIRMWARE = {"ardupilot": "firmware_sim.addons.ardupilot.program:ARDUPILOT"}
