"""Which filter carries the estimator's covariance: the fast one, or its reference."""

from __future__ import annotations

from airl_mav.scenario.model import EstimatorName
from firmware_sim.autopilot.estimator import NewFilter
from firmware_sim.autopilot.filter_kernel import KernelFilter


def filter_named(name: EstimatorName) -> NewFilter:
    """Return the filter of a name: `kernel` is compiled, `filterpy` is the library's.

    Both give the same estimates to rounding.
    """
    if name == "kernel":
        return KernelFilter
    # Imported late: it brings scipy's statistics along.
    from firmware_sim.autopilot.filter_filterpy import FilterpyFilter

    return FilterpyFilter
