"""Services for ground stations such as QGroundControl, which a rehearsal does not need.

MAVLink FTP with the vehicle's files, metadata of parameters and events, download of flight logs,
sensor calibration, PX4's shell, and messages that are sent on request only.
Depends on: `firmware_sim.mavlink`, `firmware_sim.autopilot`; logs and topics need `flight_log`.
Guide: docs/how-to/connect.md.
"""

SERVICES = {
    name: f"firmware_sim.addons.ground_station_services.{name}"
    for name in ("ftp", "component_metadata", "calibration", "shell", "logs", "information")
}
STREAMS = {"information": SERVICES["information"]}
CAPABILITIES = {"ftp": 1 << 5}
"""MAV_PROTOCOL_CAPABILITY_FTP."""
