"""Stages of a decision: durations, percentiles, deadline misses; the F-1 model of safe speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.vehicle import VehicleProfile


def f1_velocity(period_s: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the maximum speed at which the vehicle stops within its sensing range [m/s].

    The vehicle flies on for a period T and then brakes. v T + v² / (2 a) = d, so v = a (sqrt(T² + 2
    d / a) - T). At T = 0 this is the roof, sqrt(2 d a). T is the period of sensing, computing and
    acting, d the range of obstacle detection, a the maximum deceleration.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    if not (period_s >= 0.0 and d > 0.0 and a > 0.0):
        raise ValueError(f"period {period_s} s, distance {d} m, acceleration {a} m/s²")
    return a * (math.sqrt(period_s**2 + 2.0 * d / a) - period_s)


def f1_knee_hz(share: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the decision rate at which the safe velocity is a share q of its roof, 0..1 [Hz].

    From v = q sqrt(2 d a): f = 1 / T = sqrt(a / (2 d)) 2 q / (1 - q²). Beyond it faster decisions
    gain little.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    return math.sqrt(a / (2.0 * d)) * 2.0 * share / (1.0 - share**2)


def max_acceleration(vehicle: VehicleProfile) -> float:
    """Return the maximum horizontal acceleration of a vehicle at constant height [m/s²].

    The minimum of two limits: the autopilot's tilt limit, g tan(tilt), and the thrust, sqrt((F /
    m)² - g²).
    """
    tilt_max_deg = vehicle.flown_parameters()["MPC_TILTMAX_AIR"]
    lift = vehicle.thrust_n / vehicle.body.mass_kg
    by_thrust = math.sqrt(lift**2 - GRAVITY_M_S2**2)
    return min(GRAVITY_M_S2 * math.tan(tilt_max_deg * DEG), by_thrust)


Samples = NDArray[np.int64]


@dataclass(frozen=True)
class Stage:
    """Measured interval."""

    key: str
    title: str
    start: str
    """Stamp of the start."""
    end: str
    """Stamp of the end."""
    meaning: str


STAGES = (
    Stage("t1", "t1 fetch", "capture_us", "decoded_us", "frame exposed → decoded on the companion"),
    Stage("wait", "wait", "decoded_us", "infer_start_us", "frame decoded → inference starts"),
    Stage("t2", "t2 infer", "infer_start_us", "action_ready_us", "inference starts → action ready"),
    Stage("send", "send", "action_ready_us", "sent_us", "action ready → handed to MAVSDK"),
    Stage("link", "link", "sent_us", "accepted_us", "handed to MAVSDK → accepted by the autopilot"),
    Stage("control", "control", "accepted_us", "motor_us", "accepted → motors reflect it"),
    Stage(
        "end_to_end", "end to end", "capture_us", "motor_us", "frame exposed → motors reflect it"
    ),
    Stage("t3", "t3 hold", "sent_us", "held_until_us", "action applied → next observation"),
)
"""Stages in order; t1 to control add up to end to end."""

PERIOD = Stage("period", "decision period", "sent_us", "sent_us", "from one action to the next")

SETPOINT_TO_MOTOR = Stage(
    "setpoint_to_motor", "setpoint → motor", "sent_us", "motor_us", "link and control together"
)
"""Duration on the flight side: the real-time figure."""

ALL_STAGES = (*STAGES, SETPOINT_TO_MOTOR, PERIOD)

SHOWN_STAGES = (*STAGES, PERIOD)
"""Rows of a latency table."""


def stage_durations(
    stamps: Mapping[str, NDArray[Any]],
) -> dict[str, tuple[NDArray[np.int64], Samples]]:
    """Return the stages of an episode's decisions, by the stage's key.

    Stamps are the decision log's columns plus `accepted_us` and `motor_us`, each (n,) [µs]. Each
    stage has two arrays (k,): the indices of its decisions, and the durations [µs]. A stage omits
    decisions with `NO_STAMP` in either stamp, and is empty without the column. A decision period
    belongs to the decision that ends it.
    """
    nothing: Samples = np.zeros(0, np.int64)
    found = {}
    for stage in (*STAGES, SETPOINT_TO_MOTOR):
        start, end = (stamps.get(name) for name in (stage.start, stage.end))
        if start is None or end is None:
            found[stage.key] = nothing, nothing
            continue
        there = np.flatnonzero((start != NO_STAMP) & (end != NO_STAMP))
        found[stage.key] = there, (end - start)[there].astype(np.int64)
    sent = stamps.get("sent_us", nothing)
    there = np.flatnonzero(sent != NO_STAMP)
    found[PERIOD.key] = there[1:], np.diff(sent[there]).astype(np.int64)
    return found


def stage_samples(stamps: Mapping[str, NDArray[Any]]) -> dict[str, Samples]:
    """Return the durations [µs] of each stage in one episode; see `stage_durations`."""
    return {key: durations for key, (_, durations) in stage_durations(stamps).items()}


def pool(episodes: Iterable[Mapping[str, Samples]]) -> dict[str, Samples]:
    """Join the samples of several episodes, stage by stage."""
    parts = list(episodes)
    return {
        stage.key: np.concatenate(
            [part[stage.key] for part in parts] or [np.zeros(0, np.int64)], dtype=np.int64
        )
        for stage in ALL_STAGES
    }


def deadline_miss_ratio(latencies: ArrayLike, deadline: float) -> float | None:
    """Return the share of decisions that miss a deadline, 0 to 1; None: no decisions."""
    if not deadline > 0.0:
        raise ValueError(f"deadline={deadline}: must be > 0")
    values = np.asarray(latencies, np.float64)
    return float(np.mean(values > deadline)) if values.size else None


def ages_at_effect(stamps: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the age [µs] of each decision's frame when the decision took effect.

    Equals the stage `end_to_end`: from the frame's exposure to the first motor command that
    reflects the decision. A decision without effect before a later effective one has infinite age.
    Decisions after the last effective one are left out.
    """
    if "capture_us" not in stamps or "motor_us" not in stamps:
        return np.zeros(0)
    captured, moved = stamps["capture_us"], stamps["motor_us"]
    effective = np.flatnonzero(moved != NO_STAMP)
    if not effective.size:
        return np.zeros(0)
    judged = slice(0, int(effective[-1]) + 1)
    ages = np.where(moved == NO_STAMP, np.inf, (moved - captured).astype(np.float64))[judged]
    known: NDArray[np.float64] = ages[captured[judged] != NO_STAMP]
    return known


def decision_series(stamps: Mapping[str, NDArray[Any]]) -> dict[str, Samples]:
    """Return the duration [µs] of each decision's stages (n,), `NO_STAMP` if unknown."""
    names = {name for stage in STAGES for name in (stage.start, stage.end)}
    n = max((len(stamps[name]) for name in names & stamps.keys()), default=0)
    series: dict[str, Samples] = {}
    for key, (there, durations) in stage_durations(stamps).items():
        series[key] = np.full(n, NO_STAMP, np.int64)
        series[key][there] = durations
    return series


MIN_SAMPLES: Final = {50.0: 1, 90.0: 64, 95.0: 130, 99.0: 662, 99.9: 6636}
"""Minimum number of samples for a percentile p. If the true p-quantile lay above the printed bound,
at most one sample over the bound would have a 1 % chance. This is the early-stopping rule of MLPerf
LoadGen at 99 % confidence."""


@dataclass(frozen=True)
class Summary:
    """Summary of durations; times in µs, None with too few samples."""

    n: int
    mean: float | None
    p50: float | None
    p90: float | None
    p99: float | None
    p999: float | None
    max: float | None


def percentile(samples: ArrayLike, p: float) -> float | None:
    """Return the p-th percentile (nearest rank); None: too few samples."""
    values = np.asarray(samples)
    if values.size < MIN_SAMPLES[p]:
        return None
    return float(np.percentile(values, p, method="inverted_cdf"))


def summarize(samples: ArrayLike) -> Summary:
    """Summarise durations (n,) [µs]."""
    values = np.asarray(samples)
    return Summary(
        n=int(values.size),
        mean=float(values.mean()) if values.size else None,
        p50=percentile(values, 50.0),
        p90=percentile(values, 90.0),
        p99=percentile(values, 99.0),
        p999=percentile(values, 99.9),
        max=float(values.max()) if values.size else None,
    )


WINDOW = 5.0
"""Sokal's constant: lags are summed up to this many integrated times."""


def autocorrelation(samples: ArrayLike, lags: int) -> NDArray[np.float64]:
    """Return the autocorrelation of samples (n,) at lags 0 to `lags` (lags + 1,), each in -1..1.

    The biased estimate (every lag divided by n), whose sums stay finite. For constant samples: 1 at
    lag 0, then 0. Raises ValueError unless n > `lags`.
    """
    values = np.asarray(samples, np.float64)
    if not 0 <= lags < values.size:
        raise ValueError(f"lags={lags}: must be below the number of samples, {values.size}")
    centred = values - values.mean()
    power = float(centred @ centred)
    result = np.zeros(lags + 1)
    result[0] = 1.0
    if power > 0.0:
        for lag in range(1, lags + 1):
            result[lag] = float(centred[lag:] @ centred[:-lag]) / power
    return result


def integrated_time(samples: ArrayLike) -> float:
    """Return the integrated autocorrelation time [decisions], 1 for independent samples.

    1 + 2 (rho_1 + ... + rho_M), with Sokal's window: M is the minimum lag of at least 5 of these
    times (Sokal 1997, Monte Carlo methods in statistical mechanics, section 3). n >= 2 samples
    determine the mean as well as n / time independent ones.
    """
    values = np.asarray(samples, np.float64)
    most = values.size // 2
    times = 1.0 + 2.0 * np.cumsum(autocorrelation(values, most)[1:])
    wide = np.flatnonzero(np.arange(1, most + 1) >= WINDOW * times)
    return float(times[wide[0]] if wide.size else times[-1])


def corrected(samples_us: ArrayLike, expected_us: int) -> NDArray[np.int64]:
    """Return latencies [µs] with added samples for decisions that a slow one delayed.

    Each latency longer than the interval is followed by copies, each shorter by one interval, down
    to one interval.
    """
    if expected_us <= 0:
        raise ValueError(f"expected_us={expected_us}: must be > 0")
    samples = np.asarray(samples_us, np.int64)
    # HdrHistogram adds v - i, v - 2i, ... while they are >= i.
    counts = np.maximum(samples // expected_us - 1, 0)
    owner = np.repeat(np.arange(samples.size), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    steps = np.arange(owner.size) - first + 1
    return np.concatenate([samples, samples[owner] - steps * expected_us])


@dataclass(frozen=True)
class CommandAges:
    """Age of the flown command over a flight, increasing with time between commands."""

    youngest_us: NDArray[np.int64]
    """(n,) age of each command at its effect [µs]."""
    oldest_us: NDArray[np.int64]
    """(n,) age of each command at its replacement [µs]."""

    @property
    def time_us(self) -> int:
        """Total time of all commands [µs]."""
        return int((self.oldest_us - self.youngest_us).sum())

    @property
    def mean(self) -> float | None:
        """Mean age at a random time [µs]; None without commands."""
        if not self.time_us:
            return None
        a, b = self.youngest_us.astype(np.float64), self.oldest_us.astype(np.float64)
        return float(((b * b - a * a) / 2.0).sum() / (b - a).sum())

    def percentile(self, p: float) -> float | None:
        """Return the age [µs] not exceeded for p % of the time; None: too few commands."""
        if self.youngest_us.size < MIN_SAMPLES[p] or not self.time_us:
            return None
        return self.quantile(p / 100.0)

    def quantile(self, share: float) -> float:
        """Return the age [µs] not exceeded for a share (0..1) of the time; requires commands.

        A command's age is uniform from its youngest to its oldest. The distribution is therefore a
        sum of ramps, and linear between two neighbouring ends.
        """
        ends = np.sort(np.concatenate([self.youngest_us, self.oldest_us]))
        # Number of commands active just above each end.
        active = np.searchsorted(np.sort(self.youngest_us), ends, "right") - np.searchsorted(
            np.sort(self.oldest_us), ends, "right"
        )
        time = np.concatenate([[0], np.cumsum(active[:-1] * np.diff(ends))])
        wanted = share * time[-1]
        # First of several ends at the same time: ages between them were never flown.
        k = int(np.searchsorted(time, wanted, "left"))
        if k == 0:
            return float(ends[np.flatnonzero(time == 0)[-1]])
        return float(ends[k - 1] + (wanted - time[k - 1]) / active[k - 1])


def command_ages(
    exposed_us: ArrayLike, flown_us: ArrayLike, flight: ArrayLike | None = None
) -> CommandAges:
    """Return the ages of the commands while they were flown.

    The last command of a flight is left out, because its end is unknown.
    """
    exposed, flown = np.asarray(exposed_us, np.int64), np.asarray(flown_us, np.int64)
    flights = np.zeros(exposed.size, np.int64) if flight is None else np.asarray(flight, np.int64)
    same = flights[1:] == flights[:-1]
    return CommandAges(
        youngest_us=(flown - exposed)[:-1][same], oldest_us=(flown[1:] - exposed[:-1])[same]
    )


def ages_in_closed_loop(latency_us: ArrayLike, hold_us: int) -> CommandAges:
    """Return the ages in a loop from ordered latencies [µs] and t3 alone.

    A command's age is `latency` at its effect, and `latency + hold + next latency` at its
    replacement.
    """
    latency = np.asarray(latency_us, np.int64)
    return CommandAges(latency[:-1], latency[:-1] + hold_us + latency[1:])
