"""Latency of recorded decisions: t1, t2 and the link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.percentiles import integrated_time
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.refitting.quantity import LEVEL, RESAMPLES, FittedQuantity
from airl_mav.vehicle_log.alignment import ClockAlignment

LEAST = 5
"""Minimum decisions for the interval of a mean."""

T1 = FittedQuantity("t1_ms", "t1, mean", "ms")
T2 = FittedQuantity("t2_ms", "t2, mean", "ms")
LINK = FittedQuantity("link_ms", "link, both ways", "ms")


@dataclass(frozen=True)
class Latencies:
    """Latencies of a flight's decisions."""

    t1_ms: FittedQuantity
    """Mean time from a frame's exposure to its decoding."""
    t2_ms: FittedQuantity
    """Mean time from the start of an inference to its action."""
    link_ms: FittedQuantity
    """Round trip: setpoint up, telemetry down, and the age of telemetry."""
    samples_ms: tuple[float, ...]
    """t2 of the decisions, in order."""


def no_latencies() -> Latencies:
    """Return empty latencies for a vehicle's log alone."""
    why = "a vehicle's log holds no decisions: give the black box"
    return Latencies(T1.without(why), T2.without(why), LINK.without(why), ())


def fit_latencies(
    stamps: Mapping[str, NDArray[np.int64]], clocks: ClockAlignment | None, rng: np.random.Generator
) -> Latencies:
    """Return the latencies of a flight's decisions; `clocks` = None without a log."""
    t2_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    stamped = stamps["capture_us"] != NO_STAMP
    t1_us = (stamps["decoded_us"] - stamps["capture_us"])[stamped]
    # A clock of whole microseconds may return 0 for shorter durations.
    samples_ms = np.maximum(t2_us, 1) / US_PER_MS
    unstamped = "the camera does not stamp by the companion's clock"
    t1 = _mean(T1, t1_us / US_PER_MS, unstamped, rng)
    t2 = _mean(T2, samples_ms, "no decision was recorded", rng)
    return Latencies(t1, t2, _link(clocks), tuple(float(each) for each in samples_ms))


def _mean(
    of: FittedQuantity, values_ms: NDArray[np.float64], none: str, rng: np.random.Generator
) -> FittedQuantity:
    """Return the mean with its interval, widened by the autocorrelation of decisions."""
    if len(values_ms) < LEAST:
        why = f"{len(values_ms)} decisions; {LEAST} are needed" if len(values_ms) else none
        return of.without(why)
    mean, source = float(values_ms.mean()), f"stamps of {len(values_ms)} decisions"
    if np.ptp(values_ms) == 0.0:
        return of.found((mean, mean, mean), source)
    found = bootstrap(
        (values_ms,), np.mean, n_resamples=RESAMPLES, confidence_level=LEVEL, rng=rng
    ).confidence_interval
    wider = float(np.sqrt(max(1.0, integrated_time(values_ms))))
    low, high = (mean + wider * (float(end) - mean) for end in (found.low, found.high))
    return of.found((mean, low, high), source)


def _link(clocks: ClockAlignment | None) -> FittedQuantity:
    if clocks is None:
        return LINK.without("a black box knows neither end of it: give the vehicle's log")
    if clocks.round_trip_us is None or clocks.accepted_range_us is None:
        return LINK.without(f"{clocks.setpoints} setpoints were seen in the log")
    low_ms, high_ms = ((clocks.told_us + end) / US_PER_MS for end in clocks.accepted_range_us)
    source = f"{clocks.setpoints} setpoints and the telemetry, found again in the vehicle's log"
    return LINK.found((clocks.round_trip_us / US_PER_MS, low_ms, high_ms), source)
