"""Flight log of the vehicle: ULog (.ulg), PX4's log format, beside the MAVLink log of each flight.

Contains uORB topics with PX4's names, units and intervals, texts and parameters. `pyulog`, Flight
Review and PlotJuggler read it; ground stations download it with the add-on
`ground_station_services`.
Depends on: `firmware_sim.autopilot`, `firmware_sim.engine`; `airl_mav.addons.export_log` uses it.
Guide: docs/reference/run-folder.md.
"""

FLIGHT_LOGS = {"ulog": "firmware_sim.addons.flight_log.flight_log:open_flight_log"}
TOPICS = {"uorb": "firmware_sim.addons.flight_log.topics"}
