"""How late decisions were: t1, t2 and the link, as recorded in flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.autocorrelation import integrated_time
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.refitting.quantity import LEVEL, RESAMPLES, FittedQuantity, unobserved
from airl_mav.vehicle_log.alignment import Alignment

LEAST = 5
"""Decisions below which a mean has no interval."""


@dataclass(frozen=True)
class Latencies:
    """How late the decisions of a flight were."""

    t1_ms: FittedQuantity
    """Mean time from a frame's exposure until it was decoded."""
    t2_ms: FittedQuantity
    """Mean time from the start of an inference until its action was ready."""
    link_ms: FittedQuantity
    """Round trip: setpoint up, telemetry down, and its age."""
    samples_ms: tuple[float, ...]
    """t2 of the decisions, in their order."""


def no_latencies() -> Latencies:
    """Return what a vehicle's log alone tells of them: nothing."""
    why = "a vehicle's log holds no decisions: give the black box"
    return Latencies(
        unobserved("t1_ms", "t1, mean", "ms", why, None),
        unobserved("t2_ms", "t2, mean", "ms", why, None),
        unobserved("link_ms", "link, both ways", "ms", why, None),
        (),
    )


def fit_latencies(
    stamps: Mapping[str, NDArray[np.int64]], clocks: Alignment | None, rng: np.random.Generator
) -> Latencies:
    """Return the latencies of a flight's decisions; `clocks` is None without a log."""
    t2_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    stamped = stamps["capture_us"] != NO_STAMP
    t1_us = (stamps["decoded_us"] - stamps["capture_us"])[stamped]
    # A clock of whole microseconds may give 0 for what is faster.
    samples_ms = np.maximum(t2_us, 1) / US_PER_MS
    stamps_of = "stamps of {} decisions"
    return Latencies(
        _mean(
            "t1_ms",
            "t1, mean",
            t1_us / US_PER_MS,
            stamps_of.format(len(t1_us)),
            "the camera does not stamp by the companion's clock",
            rng,
        ),
        _mean(
            "t2_ms",
            "t2, mean",
            samples_ms,
            stamps_of.format(len(samples_ms)),
            "no decision was recorded",
            rng,
        ),
        _link(clocks),
        tuple(float(each) for each in samples_ms),
    )


def _mean(
    key: str,
    meaning: str,
    values_ms: NDArray[np.float64],
    source: str,
    none: str,
    rng: np.random.Generator,
) -> FittedQuantity:
    """Return the mean with its interval, wider by how much decisions depend on each other."""
    if len(values_ms) < LEAST:
        why = f"{len(values_ms)} decisions; {LEAST} are needed" if len(values_ms) else none
        return unobserved(key, meaning, "ms", why, None)
    mean = float(values_ms.mean())
    if np.ptp(values_ms) == 0.0:
        return FittedQuantity(key, meaning, "ms", mean, mean, mean, source)
    found = bootstrap(
        (values_ms,), np.mean, n_resamples=RESAMPLES, confidence_level=LEVEL, rng=rng
    ).confidence_interval
    wider = float(np.sqrt(max(1.0, integrated_time(values_ms))))
    low, high = (mean + wider * (float(end) - mean) for end in (found.low, found.high))
    return FittedQuantity(key, meaning, "ms", mean, low, high, source)


def _link(clocks: Alignment | None) -> FittedQuantity:
    key, meaning = "link_ms", "link, both ways"
    if clocks is None:
        why = "a black box knows neither end of it: give the vehicle's log"
        return unobserved(key, meaning, "ms", why, None)
    if clocks.round_trip_us is None or clocks.accepted_range_us is None:
        why = f"{clocks.setpoints} setpoints were seen in the log"
        return unobserved(key, meaning, "ms", why, None)
    low_us, high_us = (clocks.told_us + end for end in clocks.accepted_range_us)
    source = f"{clocks.setpoints} setpoints and the telemetry, found again in the vehicle's log"
    value_ms, low_ms, high_ms = (
        each / US_PER_MS for each in (clocks.round_trip_us, low_us, high_us)
    )
    return FittedQuantity(key, meaning, "ms", value_ms, low_ms, high_ms, source)
