"""Perturbed aircraft in wind and with latency, for tests of an identification."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from airl_mav.addons.identification.flown import flown_of
from airl_mav.addons.identification.identify import Identification
from airl_mav.addons.identification.response import TELEMETRY_AGE_S, fit_response
from airl_mav.black_box.mcap_file import read_black_box
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.recorded_flights import RecordedFlight, fly_recorded


@dataclass(frozen=True)
class Truth:
    """True parameters of a flight, unknown to its companion."""

    seed: int
    mass: float
    """Share of the profile's mass."""
    thrust: float
    """Share of the profile's maximum thrust."""
    drag: float
    """Share of the profile's linear drag."""
    wind: tuple[float, float]
    """Steady, towards north and east [m/s]."""
    gust_m_s: float
    """Standard deviation of the gusts [m/s]."""
    t2_ms: float
    """Mean of a log-normal t2 [ms]; its standard deviation is a tenth of it."""
    uplink_ms: float
    """Delay of setpoints to the flight controller [ms]."""

    def vehicle(self, profile: VehicleProfile) -> VehicleProfile:
        """Return what flies."""
        data = profile.model_dump()
        data["body"]["mass_kg"] *= self.mass
        data["rotor"]["thrust_max_n"] *= self.thrust
        data["drag"]["linear_n_s_m"] *= self.drag
        return VehicleProfile.model_validate(data)

    @property
    def scenario(self) -> Scenario:
        """Scenario known to the companion, with the true wind and link."""
        north, east = self.wind
        return Scenario(
            policy="static-obstacles-fast",
            level="lockstep",
            seed=self.seed,
            latency=f"lognormal:{self.t2_ms:g}ms,{0.1 * self.t2_ms:g}ms",
            wind={"north_m_s": north, "east_m_s": east, "gust_m_s": self.gust_m_s},
            faults=(f"uplink delay {self.uplink_ms:g}ms",) if self.uplink_ms else (),
        )

    def fly(self, folder: Path) -> RecordedFlight:
        """Fly it, recorded into a folder."""
        resolved = resolve(self.scenario)
        return fly_recorded(resolved, self.seed, folder, vehicle=self.vehicle(resolved.vehicle))


def drawn_truth(seed: int) -> Truth:
    """Draw one: mass 0.9 to 1.25, thrust 0.9 to 1.05, drag 0.5 to 2 of the profile; wind."""
    rng = np.random.default_rng(seed)
    towards, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 5.0)
    return Truth(
        seed=seed,
        mass=round(rng.uniform(0.9, 1.25), 3),
        thrust=round(rng.uniform(0.9, 1.05), 3),
        drag=round(math.exp(rng.uniform(math.log(0.5), math.log(2.0))), 3),
        wind=(round(speed * math.cos(towards), 2), round(speed * math.sin(towards), 2)),
        gust_m_s=round(rng.uniform(0.0, 0.5), 2),
        t2_ms=round(math.exp(rng.uniform(math.log(20.0), math.log(300.0))), 1),
        uplink_ms=float(rng.choice([0.0, 0.0, 20.0, 40.0])),
    )


def uplink_s(flight: RecordedFlight) -> float:
    """Return the mean time [s] from sending a setpoint until the flight controller took it."""
    flown, taken = flown_of(read_black_box(flight.black_box), None), flight.part("setpoints")
    passed = []
    for sent_us, setpoint in zip(flown.sent_us, flown.setpoints, strict=True):
        same = np.abs(taken["setpoint"] - setpoint).max(axis=1) < 1e-5
        after = taken["accepted_us"][same & (taken["accepted_us"] >= sent_us)]
        if len(after):
            passed.append(int(after[0]) - int(sent_us))
    return float(np.median(passed)) / US_PER_S


def true_dead_time_s(flight: RecordedFlight) -> tuple[float, float] | None:
    """Return dead time and time constant [s] of the model on the simulator's own path.

    Times count from the flight controller's acceptance of each setpoint, without telemetry and
    link. None if the flight is too short for an estimate.
    """
    path = Trajectory.from_arrays(flight.part("trajectory"))
    setpoints = flight.part("setpoints")
    flown = flown_of(read_black_box(flight.black_box), None)
    new = np.any(np.diff(setpoints["setpoint"], axis=0, prepend=np.nan) != 0.0, axis=1)
    true = replace(
        flown,
        path=path,
        sent_us=setpoints["accepted_us"][new],
        setpoints=np.asarray(setpoints["setpoint"][new], np.float64),
    )
    fit = fit_response(true, None, np.random.default_rng(0))
    dead, lag = fit.dead_time_s.value, fit.velocity_time_s.value
    return None if dead is None or lag is None else (dead + TELEMETRY_AGE_S, lag)


@dataclass(frozen=True)
class IdentificationErrors:
    """Errors of an identification; None = reported as unobservable in the flight."""

    dead_s: float | None
    """Dead time [s]; without a log the link's time counts to it."""
    lag: float | None
    """Time constant of the velocity, as a share."""
    mass: float | None
    """Mass for the profile's thrust, as a share."""
    drag: float | None
    """Linear drag per mass, as a share."""
    wind_m_s: float | None
    """Length of the error [m/s]."""
    t2: float | None
    """Mean t2, as a share of that which was injected."""
    inside: dict[str, bool]
    """True for each interval that contains the truth."""


def errors_of(
    found: Identification, truth: Truth, true_s: tuple[float, float] | None, flight: RecordedFlight
) -> IdentificationErrors:
    """Return the errors of an identification.

    Args:
        found: The identification.
        truth: True parameters of the flight.
        true_s: Its `true_dead_time_s`.
        flight: The flight.
    """
    inside: dict[str, bool] = {}

    def error(name: str, key: str, true: float, share: bool = True) -> float | None:
        each = found.estimate(key)
        if each.value is None or each.low is None or each.high is None or math.isnan(true):
            return None
        inside[name] = inside.get(name, True) and each.low <= true <= each.high
        return (each.value - true) / true if share else each.value - true

    profile = load_vehicle(found.base)
    dead_s, lag_s = true_s or (math.nan, math.nan)
    if found.ulg is None:
        dead_s += uplink_s(flight)
    mass_kg = profile.body.mass_kg * truth.mass / truth.thrust
    drag_1_s = profile.drag.linear_n_s_m * truth.drag / (profile.body.mass_kg * truth.mass)
    wind = [
        error("wind_m_s", key, true, share=False)
        for key, true in zip(("wind_north_m_s", "wind_east_m_s"), truth.wind, strict=True)
    ]
    sampler = resolve(truth.scenario).latency_sampler(truth.seed, native=False)
    if sampler is None:
        raise AssertionError("in lockstep latency is always injected")
    drawn_us = [sampler.sample_us() for _ in found.latencies.samples_ms]
    injected_ms = float(np.mean(drawn_us)) / US_PER_MS if drawn_us else math.nan
    return IdentificationErrors(
        dead_s=error("dead_s", "dead_time_s", dead_s, share=False),
        lag=error("lag", "velocity_time_s", lag_s),
        mass=error("mass", "mass_kg", mass_kg),
        drag=error("drag", "drag_1_s", drag_1_s),
        wind_m_s=None if wind[0] is None or wind[1] is None else math.hypot(wind[0], wind[1]),
        t2=error("t2", "t2_ms", injected_ms),
        inside=inside,
    )
