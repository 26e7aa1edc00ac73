"""Request and result of a measurement: stamps of every decision, computer profile, files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from airl_mav.addons.profiling.soak import Soak
from airl_mav.core import clock, constants, errors, fields
from airl_mav.core.files import save_arrays, write_json
from airl_mav.core.machine import MachineState, package_versions
from airl_mav.latency.injection import duration_ms
from airl_mav.latency.stages import (
    CommandAges,
    Samples,
    ages_in_closed_loop,
    command_ages,
    pool,
    stage_samples,
    summarize,
)
from airl_mav.policy.card import PolicyCard
from airl_mav.profiles.computer import (
    ComputerProfile,
    LatencyDistribution,
    MeasurementConditions,
    Network,
    samples_digest,
    with_workload,
    write_profile,
    write_samples,
)
from airl_mav.scenario import aircraft, model, stand_alone

SCHEMA = 1
"""Version of the facts file."""

ROUND_TRIP = "mavlink_round_trip"
"""Key of the TIMESYNC exchanges in flight."""

T1_UNCERTAINTY = "t1_uncertainty"
"""Key of the maximum error of each decision's t1."""

Stamps = dict[str, NDArray[np.int64]]


class ProfilingError(RuntimeError):
    """The measurement failed: a process or the link was lost, or the flight ended too early."""


@dataclass(frozen=True)
class Recording:
    """Stamps of the decisions after the warm-up, and their method."""

    flights: tuple[Stamps, ...]
    """Stamps [µs] by column, one row per decision, of each flight; at level bare of the one run."""
    exposure: str | None
    """Stamp from which command age counts; None: no command was flown."""
    load_us: int
    """Load time of the network [µs]."""
    first_us: int
    """Duration of the very first decision [µs]."""
    remarks: tuple[str, ...] = ()
    """Remarks on the method and on missing figures."""

    @cached_property
    def stages(self) -> dict[str, Samples]:
        """Durations [µs] by stage of all flights; hil adds `ROUND_TRIP` and `T1_UNCERTAINTY`."""
        stages = pool(stage_samples(flight) for flight in self.flights)
        columns = self.columns
        if "exchange_sent_us" in columns:
            stages[ROUND_TRIP] = columns["exchange_received_us"] - columns["exchange_sent_us"]
        if "capture_uncertainty_us" in columns:
            stages[T1_UNCERTAINTY] = columns["capture_uncertainty_us"]
        return stages

    @cached_property
    def columns(self) -> Stamps:
        """Stamps of all flights, concatenated."""
        return {
            name: np.concatenate([flight[name] for flight in self.flights])
            for name in self.flights[0]
        }

    @property
    def flight_numbers(self) -> NDArray[np.int64]:
        """Flight number of each decision."""
        rows = [len(flight["infer_start_us"]) for flight in self.flights]
        return np.repeat(np.arange(len(rows), dtype=np.int64), rows)

    def command_ages(self, hold_s: float) -> CommandAges:
        """Return the ages of the flown command, with a hold of `hold_s` [s] if not flown."""
        if self.exposure is None:
            return ages_in_closed_loop(self.stages["t2"], round(hold_s * constants.US_PER_S))
        columns = self.columns
        return command_ages(columns[self.exposure], columns["sent_us"], self.flight_numbers)


@dataclass(frozen=True)
class DrawnPower:
    """Power consumption of the computer, from its built-in sensors."""

    source: str
    """Power source, or the reason why power is not available."""
    idle_w: float | None = None
    """Mean before the measurement [W]."""
    busy_w: float | None = None
    """Mean during the decisions [W]."""

    def __str__(self) -> str:
        """Return the measured power as text, or the reason why it is missing."""
        idle, busy = (f"{w:.2f} W" for w in (self.idle_w or 0.0, self.busy_w or 0.0))
        return self.source if self.busy_w is None else f"{idle} idle, {busy} busy, {self.source}"


@dataclass(frozen=True)
class ComputerMeasurement:
    """Measured decision latency of a computer for a policy."""

    request: ProfileRequest
    card: PolicyCard
    recording: Recording
    computer: str
    workload: str
    """Name of the workload in the profile."""
    profile: ComputerProfile
    """Computer profile with this workload, whose samples are inline, and earlier workloads."""
    machine: dict[str, Any]
    """Processor, cores, memory, operating system and Python."""
    before: MachineState
    after: MachineState
    power: DrawnPower
    soak: Soak | None = None
    """Result of the soak, if requested."""
    files: tuple[Path, ...] = ()
    """Paths of written files: profile, samples, stamps, facts and soak."""

    @property
    def stages(self) -> dict[str, Samples]:
        """Durations [µs] of each stage, by its key; empty without a measurement."""
        return self.recording.stages

    @property
    def t2_us(self) -> Samples:
        """Durations of the decisions [µs], in order."""
        return self.stages["t2"]

    @property
    def network(self) -> Network:
        """Timed network and its runtime."""
        return self.profile.workloads[self.workload].network


def save(measured: ComputerMeasurement, path: Path) -> tuple[Path, ...]:
    """Write samples, stamps, facts and finally the profile at `path`; return all paths."""
    recording, profile = measured.recording, measured.profile
    stem = f"{measured.computer}.{measured.workload}"
    samples, arrays, facts = (path.with_name(stem + end) for end in (".txt", ".npz", ".json"))
    workload = profile.workloads[measured.workload]
    by_file = LatencyDistribution(distribution="samples", samples_file=samples.name)
    written = workload.model_copy(update={"latency": by_file})
    title = f"t2 of {measured.card.name} on {profile.cpu}, {measured.network.runtime}, ms, in order"
    paths: tuple[Path, ...] = (path, samples, arrays, facts)
    with errors.usage_errors(f"--out {path.parent}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        if measured.soak is not None:
            paths = (*paths, path.with_name(f"{stem}.soak.npz"))
            save_arrays(paths[-1], measured.soak.series)
        write_samples(samples, workload.latency.samples_ms or (), (title, workload.source))
        save_arrays(arrays, {**recording.columns, "flight": recording.flight_numbers})
        write_json(facts, _facts(measured, path.parent))
        write_profile(path, with_workload(profile, measured.workload, written))
    return paths


def share(measured: ComputerMeasurement, path: Path) -> Path:
    """Write computer, workload, samples and provenance as one portable file."""
    workload = measured.profile.workloads[measured.workload]
    samples_ms = tuple(round(each, 3) for each in workload.latency.samples_ms or ())
    machine, soaked = measured.machine, measured.soak
    how = MeasurementConditions(
        date_utc=clock.utc_now().isoformat(timespec="seconds"),
        machine=f"{machine['os']}, {machine['architecture']}, {machine['python']}",
        state=dict(measured.before.rows()),
        soak="" if soaked is None else soaked.sentence(),
        versions=package_versions(),
        samples_sha256=samples_digest(samples_ms),
    )
    inline = LatencyDistribution(distribution="samples", samples_ms=samples_ms)
    told = workload.model_copy(update={"latency": inline, "measured": how})
    profile = measured.profile.model_copy(update={"workloads": {measured.workload: told}})
    with errors.usage_errors(f"--share {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_profile(path, profile)
    return path


def _facts(measured: ComputerMeasurement, out: Path) -> dict[str, Any]:
    recording, request = measured.recording, measured.request
    return {
        "schema": SCHEMA,
        "computer": measured.computer,
        "workload": measured.workload,
        "level": request.level,
        "command": {**request.model_dump(mode="json"), "out": str(out)},
        "network": measured.network.model_dump(),
        "date_utc": clock.utc_now().isoformat(timespec="seconds"),
        "machine": measured.machine,
        "before": asdict(measured.before),
        "after": asdict(measured.after),
        "versions": package_versions(),
        "load_us": recording.load_us,
        "first_us": recording.first_us,
        "stages_us": {key: asdict(summarize(samples)) for key, samples in measured.stages.items()},
        "power": asdict(measured.power),
        "soak": None if measured.soak is None else measured.soak.facts(),
        "remarks": recording.remarks,
    }


NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

FLOWN_SPEED_M_S = 0.1
"""Speed limit in flight: too slow to reach a goal or a wall."""

SHORTEST_SOAK_MS, LONGEST_SOAK_MS = 10e3, 24 * 3600e3

ProfileLevel = Literal["bare", "sitl", "hil"]


class ProfileRequest(stand_alone.CompanionAddresses, model.Inference):
    """Subject and method of a measurement."""

    policy: str | None = Field(
        default=None,
        description="policy to measure: a name, or a path to a folder with policy.onnx and"
        " card.json; by default the default policy, or with a network a random one",
    )
    network: Annotated[str | None, fields.COMMON] = Field(
        default=None,
        pattern=r"^[1-9]\d?x[1-9]\d{0,2}$",
        description="LAYERSxFILTERS of a randomly initialised network of the paper's template to"
        " measure instead of a policy, such as 5x32; needs the [profile] extra; latency depends on"
        " the shapes of the weights, not on their values",
    )
    image: str = Field(
        default="256x154",
        pattern=r"^\d{1,4}x\d{1,4}$",
        description="with a network: WIDTHxHEIGHT of the image that is its input, px",
    )
    level: Annotated[ProfileLevel, fields.COMMON] = Field(
        default="bare",
        description="bare: inference alone, on this computer. sitl: in flight, through the"
        " processes of airl-sitl, all stages. hil: the companion on this computer, against an"
        " airl-firmware that runs elsewhere",
    )
    decisions: Annotated[int, fields.COMMON] = fields.quantity(
        "decisions to measure, after the warm-up", "1", ge=10, le=100_000, default=1000
    )
    warm_up: int = fields.quantity(
        "decisions at the start of each flight that are left out; the very first one is reported"
        " separately",
        "1",
        ge=1,
        le=10_000,
        default=50,
    )
    hold_s: float = fields.quantity(
        "levels sitl and hil, t3: how long an action is held before the next observation; short,"
        " and flown at walking pace, because timing is measured and not the quality of flight",
        "s",
        ge=0,
        le=1,
        default=0.05,
    )
    soak: Annotated[str | None, fields.COMMON] = Field(
        default=None,
        description="after the measurement, run inference alone for this time, as 90s, 10min or 1h,"
        " and record latency, frequency and temperature, to detect thermal throttling",
    )
    on: Annotated[str | None, fields.COMMON] = Field(
        default=None,
        pattern=NAME,
        description="name of the computer, and of its profile's file; by default after its"
        " processor",
    )
    workload: Annotated[str | None, fields.COMMON] = Field(
        default=None,
        pattern=NAME,
        description="name of the workload in the profile; replaces an existing one; default: from"
        " policy, level, runtime and threads",
    )
    watts: Annotated[float | None, fields.COMMON] = fields.quantity(
        "power that the computer draws; by default as measured, where this computer tells it,"
        " or that of an existing profile, or 0",
        "W",
        ge=0,
        le=10_000,
        default=None,
    )
    price_usd: float | None = fields.quantity(
        "price of the computer; by default that of an existing profile, or 0",
        "USD",
        ge=0,
        le=1_000_000,
        default=None,
    )
    seed: int = fields.quantity(
        "seed of the random network, of the observations at level bare, and of the flights",
        "1",
        ge=0,
        le=model.GREATEST_SEED,
        default=1,
    )
    vehicle: str | None = Field(
        default=None,
        description="vehicle profile that gives the camera: a shipped name, or a path to a .toml;"
        " by default the first shipped one whose camera fits",
    )
    ports: aircraft.Ports = Field(default_factory=aircraft.Ports, description="ports of level sitl")

    @field_validator("soak")
    @classmethod
    def _known_duration(cls, soak: str | None) -> str | None:
        if (
            soak is not None
            and not SHORTEST_SOAK_MS <= (duration_ms(soak) or 0.0) <= LONGEST_SOAK_MS
        ):
            raise errors.FieldError("soak", soak, "10s to 24h, as 90s, 10min or 1h")
        return soak

    @property
    def soak_s(self) -> float | None:
        """Duration of the soak [s]; None: no soak."""
        given_ms = None if self.soak is None else duration_ms(self.soak)
        return None if given_ms is None else given_ms * constants.US_PER_MS / constants.US_PER_S

    @property
    def flown_as(self) -> dict[str, Any]:
        """Scenario fields for the flight at levels sitl and hil."""
        shared = {*model.Inference.model_fields, "hold_s", "seed"}
        limits = {"goal_radius_m": 0.5, "max_speed_m_s": FLOWN_SPEED_M_S}
        return {**self.model_dump(include=shared), **limits}
