"""Measurement: stamps of every decision, a computer profile, and their files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.profiling.request import ProfileRequest
from airl_mav.addons.profiling.soak import Soak
from airl_mav.core.clock import utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.files import save_arrays, write_json
from airl_mav.core.machine import MachineState, package_versions
from airl_mav.latency.percentiles import CommandAges, ages_in_closed_loop, command_ages, summarize
from airl_mav.latency.stages import Samples, pool, stage_samples
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

SCHEMA = 1
"""Version of the facts file."""

ROUND_TRIP = "mavlink_round_trip"
"""Key of the TIMESYNC exchanges in flight."""

PAGE_NEEDS = frozenset({"jinja2", "matplotlib"})
"""Packages that draw the page of a soak, included in the [sim] extra."""

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
            return ages_in_closed_loop(self.stages["t2"], round(hold_s * US_PER_S))
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
    more: tuple[Path, ...] = ()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if measured.soak is not None:
            more = _save_soak(measured, measured.soak, path.with_name(f"{stem}.soak.npz"))
        write_samples(samples, workload.latency.samples_ms or (), (title, workload.source))
        save_arrays(arrays, {**recording.columns, "flight": recording.flight_numbers})
        write_json(facts, _facts(measured, path.parent))
        write_profile(path, with_workload(profile, measured.workload, written))
    except OSError as error:
        raise UsageError(f"--out {path.parent}: {error.strerror}") from None
    return path, samples, arrays, facts, *more


def share(measured: ComputerMeasurement, path: Path) -> Path:
    """Write computer, workload, samples and provenance as one portable file."""
    workload = measured.profile.workloads[measured.workload]
    samples_ms = tuple(round(each, 3) for each in workload.latency.samples_ms or ())
    machine, soaked = measured.machine, measured.soak
    how = MeasurementConditions(
        date_utc=utc_now().isoformat(timespec="seconds"),
        machine=f"{machine['os']}, {machine['architecture']}, {machine['python']}",
        state=dict(measured.before.rows()),
        soak="" if soaked is None else soaked.sentence(),
        versions=package_versions(),
        samples_sha256=samples_digest(samples_ms),
    )
    inline = LatencyDistribution(distribution="samples", samples_ms=samples_ms)
    told = workload.model_copy(update={"latency": inline, "measured": how})
    profile = measured.profile.model_copy(update={"workloads": {measured.workload: told}})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_profile(path, profile)
    except OSError as error:
        raise UsageError(f"--share {path}: {error.strerror}") from None
    return path


def _save_soak(measured: ComputerMeasurement, soaked: Soak, series: Path) -> tuple[Path, ...]:
    """Write the series of a soak and, with the packages installed, its page; return both."""
    save_arrays(series, soaked.series)
    if not PAGE_NEEDS.issubset(name for name in PAGE_NEEDS if find_spec(name)):
        return (series,)
    # Imported late: a drone's computer need not draw.
    from airl_mav.addons.profiling.soak_page import write_soak_page

    facts = (
        ("policy", measured.card.name),
        ("network", measured.card.network),
        ("processor", measured.profile.cpu),
        ("runtime", measured.network.runtime),
        ("power", measured.power.source),
    )
    title = f"{measured.card.name} on {measured.computer}"
    page = write_soak_page(
        soaked, series.parent, series.stem, title, facts, machine=measured.machine
    )
    return series, page


def _facts(measured: ComputerMeasurement, out: Path) -> dict[str, Any]:
    recording, request = measured.recording, measured.request
    return {
        "schema": SCHEMA,
        "computer": measured.computer,
        "workload": measured.workload,
        "level": request.level,
        "command": {**request.model_dump(mode="json"), "out": str(out)},
        "network": measured.network.model_dump(),
        "date_utc": utc_now().isoformat(timespec="seconds"),
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
