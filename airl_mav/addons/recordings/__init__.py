"""Recordings of real flights as runs: reports, comparisons and replays of black boxes.

Converts a companion's black box (.mcap), with the vehicle's log (.ulg) if given, to a run folder
beside it. Used by every command that takes a run: `airl report FLIGHT.mcap --ulg LOG.ulg`.
Depends on: `airl_mav.black_box`, `airl_mav.vehicle_log`; the extras `black-box` and `identify`.
Guide: docs/how-to/after-the-flight.md.
"""

RECORDINGS = {".mcap": "airl_mav.addons.recordings.recorded_flight:take_in"}
