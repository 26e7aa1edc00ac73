"""Conformance test: checks a flight controller against the rehearsal's assumptions.

`check_conformance` makes the checks of `ground_checks` and `flight_checks` on a `Vehicle` in their
order, flies the step responses of `steps`, and always lands.
"""

from airl_mav.conformance.result import ConformanceResult
from airl_mav.conformance.run import check_conformance

__all__ = ["ConformanceResult", "check_conformance"]
