"""Black box: a recording of the flight on the aircraft, which survives a crash.

Writes images, decisions, setpoints, telemetry and resources to an MCAP file.
Options: `--black-box FOLDER`, `--black-box-images-hz` of the companion.
Depends on: `airl_mav.black_box`, the file format; the extra `black-box`.
Guide: docs/how-to/after-the-flight.md.
"""

RECORDERS = {"black_box": "companion.addons.black_box.recorder:recorded"}
