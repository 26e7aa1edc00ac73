"""Fit of network latency by network size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.card_writing import NetworkSize

Array = NDArray[np.float64]

Grid = tuple[int, int]
"""Layers, filters."""


@dataclass(frozen=True)
class Fit:
    """Fit of times by multiply-accumulates (MACs)."""

    n: int
    """Number of networks."""
    intercept_ms: float
    ms_per_gmac: float
    r_squared: float
    """R² of the straight line through all networks (least squares)."""
    estimate_error_median: float
    """Median error of `--workload estimate`, each network from the other one nearest in MACs:
    absolute error as a share."""
    estimate_error_worst: float
    parameters_r_squared: float
    """R² of the line through the numbers of parameters."""
    both_r_squared: float
    """R² of the plane through MACs and parameters: a weight used once must still be read."""
    grows: float
    """Share of neighbour pairs on the grid in which the larger network is slower."""


def fit_times(sizes: Mapping[Grid, NetworkSize], times_ms: Mapping[Grid, float]) -> Fit | None:
    """Fit times [ms] over the sizes of the same networks; None with fewer than four."""
    cells = sorted(times_ms)
    if len(cells) < 4:
        return None
    x = np.array([sizes[cell].macs / 1e9 for cell in cells])
    parameters = np.array([sizes[cell].parameters / 1e6 for cell in cells])
    y = np.array([times_ms[cell] for cell in cells])
    (intercept, slope), r_squared = _least_squares(y, x)
    apart = np.abs(np.log(x[:, None] / x[None, :]))
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(axis=1)
    errors = np.abs(y[nearest] * x / x[nearest] / y - 1.0)
    slower = [times_ms[a] < times_ms[b] for a, b in neighbours(cells)]
    return Fit(
        n=len(cells),
        intercept_ms=float(intercept),
        ms_per_gmac=float(slope),
        r_squared=r_squared,
        parameters_r_squared=_least_squares(y, parameters)[1],
        both_r_squared=_least_squares(y, x, parameters)[1],
        estimate_error_median=float(np.median(errors)),
        estimate_error_worst=float(errors.max()),
        grows=float(np.mean(slower)) if slower else 0.0,
    )


def _least_squares(y: Array, *columns: Array) -> tuple[Array, float]:
    """Fit y = c0 + c1 x1 + ...; return the coefficients and R²."""
    design = np.column_stack([np.ones_like(y), *columns])
    coefficients: Array = np.asarray(np.linalg.lstsq(design, y, rcond=None)[0], np.float64)
    left = y - design @ coefficients
    return coefficients, float(1.0 - (left**2).sum() / ((y - y.mean()) ** 2).sum())


def neighbours(cells: Sequence[Grid]) -> list[tuple[Grid, Grid]]:
    """Return the pairs of cells, smaller one first, with nothing between them on the grid."""
    layers, filters = sorted({cell[0] for cell in cells}), sorted({cell[1] for cell in cells})
    pairs = [((a, f), (b, f)) for a, b in pairwise(layers) for f in filters]
    pairs += [((n, a), (n, b)) for a, b in pairwise(filters) for n in layers]
    known = set(cells)
    return [(a, b) for a, b in pairs if a in known and b in known]
