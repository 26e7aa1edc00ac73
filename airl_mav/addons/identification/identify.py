"""Fit of a vehicle and a computer profile to one or several recorded flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from airl_mav.addons.identification import files
from airl_mav.addons.identification.air import (
    WIND,
    Air,
    Known,
    Thrust,
    fit_air,
    fit_thrust,
    thrust_of,
)
from airl_mav.addons.identification.files import (
    identified_profile,
    overrides_of,
    vehicle_toml,
    write_identification,
)
from airl_mav.addons.identification.flown import (
    LEVEL,
    RESAMPLES,
    Array,
    FittedQuantity,
    Flown,
    flown_by_log,
    flown_of,
)
from airl_mav.addons.identification.response import TIMES, ResponseFit, fit_response
from airl_mav.addons.recordings.recorded_flight import stamps_of
from airl_mav.black_box.mcap_file import BlackBox, read_black_box
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.machine import package_versions
from airl_mav.flight.statistics import QUANTILE
from airl_mav.latency.stages import integrated_time
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.computer import ComputerProfile, load_computer
from airl_mav.profiles.vehicle import Payload, VehicleProfile, load_vehicle, loaded
from airl_mav.vehicle_log import ClockAlignment, read_vehicle_log

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


SCHEMA = 1

LOG_SUFFIX = ".ulg"

DEFAULT_COMPUTER = "workstation"
"""Computer on the ground, without mass on the vehicle."""


@dataclass(frozen=True)
class Identification:
    """Result of an identification: vehicle, computer and wind."""

    black_box: Path | None
    """Path of the black box; None: only the vehicle's log is available."""
    ulg: Path | None
    base: str
    """Identified profile: a built-in name, or a path."""
    known: Known
    """Quantity taken from that profile: mass or thrust."""
    vehicle: VehicleProfile
    overrides: tuple[files.Override, ...]
    response: ResponseFit
    thrust: Thrust
    air: Air
    latencies: Latencies
    notes: tuple[str, ...]
    parameters: Mapping[str, float]
    """Logged parameters of the flight controller; empty without a log."""
    flights: tuple[Identification, ...] = ()
    """Results of the single flights in a joint fit."""

    @property
    def estimates(self) -> tuple[FittedQuantity, ...]:
        """All fitted or unobservable quantities."""
        parts = (self.response, self.thrust, self.air, self.latencies)
        found = (value for part in parts for value in vars(part).values())
        return tuple(value for value in found if isinstance(value, FittedQuantity))

    def estimate(self, key: str) -> FittedQuantity:
        """Return an estimate by key. Raises KeyError."""
        return {each.key: each for each in self.estimates}[key]

    def as_json(self) -> dict[str, Any]:
        """Return the identification in the format of `identification.json`."""
        flights = [each._told() for each in self.flights]
        return {
            "schema": SCHEMA,
            **self._told(),
            "overrides": [asdict(each) for each in self.overrides],
            "notes": list(self.notes),
            "versions": package_versions(),
            **({"flights": flights} if flights else {}),
        }

    def _told(self) -> dict[str, Any]:
        """Return the estimates of one flight, or of the joint fit."""
        wind = self.air.wind
        estimates = {each.key: asdict(each) for each in self.estimates}
        for fields in estimates.values():
            del fields["key"]
        return {
            "black_box": None if self.black_box is None else str(self.black_box),
            "ulg": None if self.ulg is None else str(self.ulg),
            "vehicle": self.base,
            "known": self.known,
            "estimates": estimates,
            "wind": None if wind is None else {"north_m_s": wind[0], "east_m_s": wind[1]},
        }


def identify(
    path: Path,
    *,
    ulg: Path | None = None,
    vehicle: str | None = None,
    known: Known = "thrust",
    out: Path | None = None,
    seed: int = 1,
) -> Identification:
    """Fit vehicle, computer and wind to a flight.

    Args:
        path: Black box, or a vehicle's log (.ulg) alone, which contains nothing about the computer.
        ulg: The vehicle's log of the black box's flight; without it mass, thrust and link stay
            unknown.
        vehicle: Profile to identify: name or path; None = the black box's vehicle, or `quad`.
        known: Quantity to take from the profile: a flight shows only thrust per mass.
        out: New folder for `vehicle.toml`, `computer.toml`, `latency.txt`, `scenario.toml` and
            `identification.json`; None = no files.
        seed: Seed of the intervals' resamples.

    Raises:
        UsageError: A file cannot be read, has no navigation, or is the log of another flight.
            `FieldError`s name the field.
    """
    check_out(out)
    box: BlackBox | None = None
    if path.suffix.lower() == LOG_SUFFIX:
        if ulg is not None:
            raise FieldError("ulg", f"{ulg}", f"nothing beside {path}, which is a log already")
        ulg = path
        flown = flown_by_log(read_vehicle_log(path))
    else:
        box = read_black_box(path)
        flown = flown_of(box, None if ulg is None else read_vehicle_log(ulg))
    config = {} if box is None else box.run.get("config", {})
    base = vehicle or str(config.get("vehicle", "quad"))
    profile = load_vehicle(base)
    board, remarks = _board(str(config.get("computer", DEFAULT_COMPUTER)))
    flying = loaded(profile, board, Payload())
    rng = np.random.default_rng(seed)
    streams = rng.spawn(4)
    air = fit_air(flown, flying, streams[0])
    thrust = fit_thrust(flown, flying, air, known, streams[1])
    response = fit_response(flown, profile.response, streams[2])
    parameters = {} if flown.log is None else flown.log.parameters
    overrides = files.overrides_of(profile, flying, response, thrust, air, parameters)
    found = Identification(
        black_box=None if box is None else path,
        ulg=ulg,
        base=base,
        known=known,
        vehicle=files.identified_profile(profile, overrides),
        overrides=overrides,
        response=response,
        thrust=thrust,
        air=air,
        latencies=no_latencies()
        if box is None
        else fit_latencies(stamps_of(box), flown.clocks, streams[3]),
        notes=(*remarks, *_notes(flown, box, board)),
        parameters=parameters,
    )
    if out is not None:
        _write(found, box, board, out)
    return found


def check_out(out: Path | None) -> None:
    """Raise FieldError for a non-empty folder."""
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FieldError("out", f"{out}", "a new or empty folder: it holds something else")


def _board(name: str) -> tuple[ComputerProfile, tuple[str, ...]]:
    """Return the computer that flew; without its profile, the default and a note."""
    try:
        return load_computer(name), ()
    except UsageError as error:
        note = f"the computer's mass is not known here, it counts to the vehicle's: {error}"
        return load_computer(DEFAULT_COMPUTER), (note,)


def _write(found: Identification, box: BlackBox | None, board: ComputerProfile, out: Path) -> None:
    sources = [each for each in (found.black_box, found.ulg) if each is not None]
    from_what = " and ".join(each.name for each in sources)
    remarks = (f"airl identify {from_what}", *found.notes)
    samples_ms = found.latencies.samples_ms
    files.write_identification(
        out,
        found.as_json(),
        files.vehicle_toml(
            found.base,
            f"{found.base}, identified to {sources[0].stem}",
            found.overrides,
            remarks,
        ),
        None
        if box is None
        else files.computer_profile(box, board, len(samples_ms), f"airl identify {from_what}"),
        samples_ms,
        remarks,
    )


def _notes(flown: Flown, box: BlackBox | None, board: ComputerProfile) -> tuple[str, ...]:
    notes = []
    if box is None:
        start_us, end_us = flown.airborne_us
        notes.append(
            f"fitted to the longest stretch off the ground, {(end_us - start_us) / US_PER_S:.0f} s"
            f" from {start_us / US_PER_S:.1f} s on in the log"
        )
    if box is not None and not box.whole:
        notes.append("the recording ends early: only what it holds was fitted")
    if box is not None and box.damaged:
        notes.append("the recording is damaged: its checksum is wrong")
    if flown.clocks is not None:
        clocks = flown.clocks
        notes.append(
            "clocks aligned by attitude and velocity: telemetry of the log's time t is in the"
            f" recording at t {clocks.told_us / US_PER_MS:+.1f} ms, velocities agree to"
            f" {clocks.error_m_s:.3f} m/s"
        )
    if flown.log is not None and len(flown.log.wind):
        first_us, last_us = (flown.logged_us(each) for each in flown.airborne_us)
        told = flown.log.wind.between(first_us, last_us)
        if len(told):
            north, east = told.values.mean(axis=0)
            notes.append(
                f"the flight controller's own estimate of the wind: {north:.1f} m/s towards north,"
                f" {east:.1f} m/s towards east"
            )
    if board.onboard_mass_kg:
        notes.append(f"the computer on board has {board.onboard_mass_kg:.3f} kg of the mass")
    return tuple(notes)


OWN_WIND = "each flight has its own"


def identify_together(
    logs: Sequence[Path],
    *,
    vehicle: str | None = None,
    known: Known = "thrust",
    out: Path | None = None,
    seed: int = 1,
) -> Identification:
    """Fit the vehicle that flew several logged flights.

    Args:
        logs: Two or more logs (.ulg), the newest last; gains are taken from it.
        vehicle: Profile to identify: name or path; None = `quad`.
        known: Quantity to take from the profile: a flight shows only thrust per mass.
        out: New folder for `vehicle.toml`, `scenario.toml` and `identification.json`; None = no
            files.
        seed: Seed of the intervals' resamples.

    Raises:
        UsageError: A file cannot be read, or contains no flight. `FieldError`s name the field.
    """
    check_out(out)
    for path in logs:
        if path.suffix.lower() != LOG_SUFFIX:
            accepted = "vehicle's logs (.ulg) where there are several; a black box (.mcap) alone"
            raise FieldError("flights", f"{path}", accepted)
    if len(set(logs)) < len(logs):
        raise FieldError("flights", f"{logs[0]}...", "each log once")
    flights = tuple(identify(path, vehicle=vehicle, known=known, seed=seed) for path in logs)
    base = flights[0].base
    profile = load_vehicle(base)
    response = ResponseFit(
        *(pooled([getattr(each.response, name) for each in flights]) for name in TIMES)
    )
    thrust = thrust_of(pooled([each.thrust.ratio_m_s2 for each in flights]), profile, known)
    north, east = (each.without(OWN_WIND) for each in WIND)
    drag = pooled([each.air.drag_1_s for each in flights])
    air = Air(drag, north, east, flights[0].air.quadratic_1_m)
    parameters = flights[-1].parameters
    overrides = overrides_of(profile, profile, response, thrust, air, parameters)
    changed = sorted(
        each.key
        for each in overrides
        if each.table == "parameters"
        and len({flight.parameters.get(each.key) for flight in flights}) > 1
    )
    notes = [f"fitted to {len(logs)} flights together; a flight's wind is its own"]
    if changed:
        notes.append(f"of {logs[-1].name}, as other logs have others: {', '.join(changed)}")
    found = Identification(
        black_box=None,
        ulg=None,
        base=base,
        known=known,
        vehicle=identified_profile(profile, overrides),
        overrides=overrides,
        response=response,
        thrust=thrust,
        air=air,
        latencies=no_latencies(),
        notes=tuple(notes),
        parameters=parameters,
        flights=flights,
    )
    if out is not None:
        remarks = (f"airl identify {' '.join(path.name for path in logs)}", *notes)
        description = f"{base}, identified to {len(logs)} flights"
        text = vehicle_toml(base, description, overrides, remarks)
        write_identification(out, found.as_json(), text, None, (), remarks)
    return found


def pooled(alone: Sequence[FittedQuantity]) -> FittedQuantity:
    """Return a vehicle's quantity, pooled from several flights."""
    told = [each for each in alone if each.value is not None and each.half_width]
    if not told:
        return replace(alone[0], unobservable=f"in none of {len(alone)}: {alone[0].unobservable}")
    values = np.array([each.value for each in told])
    sigma = np.array([each.half_width for each in told]) / QUANTILE
    value, error = random_effects(values, sigma)
    half = QUANTILE * error
    source = f"{len(told)} of {len(alone)} flights: {told[0].source}"
    return told[0].found((value, value - half, value + half), source)


def random_effects(values: Array, sigma: Array) -> tuple[float, float]:
    """Return mean and standard error of values (n,) with standard deviations (n,)."""
    weight = sigma**-2.0
    mean = float(np.sum(weight * values) / np.sum(weight))
    spread = float(np.sum(weight * (values - mean) ** 2)) - (len(values) - 1)
    scale = float(np.sum(weight) - np.sum(weight**2) / np.sum(weight))
    between = max(0.0, spread / scale) if len(values) > 1 else 0.0
    weight = 1.0 / (sigma**2 + between)
    total = float(np.sum(weight))
    return float(np.sum(weight * values) / total), math.sqrt(1.0 / total)
