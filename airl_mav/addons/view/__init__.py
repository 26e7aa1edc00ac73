"""View of flights in a browser: live, or a replay of a run.

A view is a process of its own with a page of viser. Flights send it messages, which a slow view
drops, and read its viewers' requests: pace, latency, compensation.
Commands: `airl view RUN`; option `--view` of `airl-sitl` and `airl evaluate`.
Depends on: the extra `view` (viser); `airl_mav.report.scene`.
Guide: docs/how-to/view-and-export.md.
"""

COMMANDS = {"view": ("show", "replay a run in a browser", "airl_mav.addons.view.command")}

VIEW = {
    "viewer": "airl_mav.addons.view.viewer:Viewer",
    "flights": "airl_mav.addons.view.viewer:request_of",
    "observer": "airl_mav.addons.view.taps:ViewObserver",
    "simulation": "airl_mav.addons.view.taps:SimulationTap",
    "companion": "airl_mav.addons.view.taps:CompanionTap",
    "flight": "airl_mav.addons.view.taps:FlightTap",
}
