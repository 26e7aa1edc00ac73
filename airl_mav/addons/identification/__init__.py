"""System identification: vehicle and computer profiles estimated from recorded flights.

`identify` estimates drag, thrust, response, wind and latencies; `rehearse_flight` repeats
the flight in simulation.
Commands: `airl identify`, `airl rehearse-flight`. From Python: `identification.identify.identify`.
Depends on: black boxes and vehicle logs (`airl_mav.black_box`, `airl_mav.vehicle_log`), lockstep.
Guide: docs/how-to/after-the-flight.md.
"""

COMMANDS = {
    "identify": (
        "logs",
        "estimate vehicle and computer from a recorded flight",
        "airl_mav.addons.identification.identify_command",
    ),
    "rehearse-flight": (
        "logs",
        "repeat a recorded flight in simulation, and compare",
        "airl_mav.addons.identification.rehearse_flight_command",
    ),
}
