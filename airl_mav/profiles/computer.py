"""Computer profile: price, power and decision latency of an onboard computer.

Latencies are given per workload (a network on a runtime), never as a single number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from airl_mav.core.constants import G_PER_KG
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, later_field, optional, quantity, switch
from airl_mav.core.files import read_limited, replace_file
from airl_mav.profiles.loading import load_profile, profiles_dir

LONGEST_MS = 60_000.0
"""Maximum latency [ms]; a decision slower than a minute is assumed to be a mistake in the file."""

SAMPLES_BYTES = 10 << 20
"""Maximum size of a file of measured latencies."""

Distribution = Literal["fixed", "lognormal", "normal-truncated", "samples"]


class Network(ProfileModel):
    """The network of a latency measurement."""

    layers: int | None = quantity(
        "convolution layers of the paper's template (and as many dense ones)",
        "1",
        ge=1,
        le=100,
        default=None,
    )
    filters: int | None = quantity(
        "filters of each convolution and units of each dense layer",
        "1",
        ge=1,
        le=4096,
        default=None,
    )
    image_height_px: int = quantity("image height", "px", ge=1, le=4096)
    image_width_px: int = quantity("image width", "px", ge=1, le=4096)
    parameters: int = quantity("weights and biases", "1", ge=1)
    macs: int = quantity("multiply-accumulates of one inference", "1", ge=1)
    runtime: str = Field(description="framework and version")


class LatencyDistribution(ProfileModel):
    """The distribution of t2: inference start -> action ready.

    `fixed`: always `mean_ms`. `lognormal`: `min_ms` plus a log-normal; `mean_ms` and `std_ms` apply
    to the sum. `normal-truncated`: a normal of `mean_ms` and `std_ms`, truncated below `min_ms` (so
    the resulting mean is slightly higher). `samples`: measured values, replayed in order.
    """

    distribution: Distribution
    mean_ms: float | None = quantity("mean", "ms", gt=0, le=LONGEST_MS, default=None)
    std_ms: float | None = quantity("standard deviation", "ms", ge=0, le=LONGEST_MS, default=None)
    min_ms: float = quantity("least latency", "ms", ge=0, le=LONGEST_MS, default=0.0)
    samples_ms: tuple[Annotated[float, Field(gt=0, le=LONGEST_MS)], ...] | None = Field(
        default=None, description="measured latencies", json_schema_extra={"unit": "ms"}
    )
    samples_file: str | None = optional(
        "text file of measured latencies beside the profile, one a line in ms"
    )

    @model_validator(mode="after")
    def _complete(self) -> LatencyDistribution:
        sampled = (self.samples_ms is not None) + (self.samples_file is not None)
        if self.distribution == "samples":
            if sampled != 1:
                raise ValueError("distribution 'samples' takes one of samples_ms, samples_file")
            if self.samples_ms is not None and not self.samples_ms:
                raise ValueError("samples_ms: empty; accepted: one value or more")
            if self.mean_ms is not None or self.std_ms is not None:
                raise ValueError("mean_ms and std_ms follow from the samples: leave them out")
            return self
        if sampled:
            raise ValueError(f"samples do not go with distribution {self.distribution!r}")
        if self.mean_ms is None:
            raise ValueError(f"distribution {self.distribution!r} needs mean_ms")
        if self.distribution == "fixed":
            if self.std_ms:
                raise ValueError(f"std_ms = {self.std_ms:g}: 'fixed' has no spread")
        elif self.std_ms is None:
            raise ValueError(f"distribution {self.distribution!r} needs std_ms")
        elif self.min_ms >= self.mean_ms:
            raise ValueError(f"min_ms = {self.min_ms:g}: accepted: below mean_ms {self.mean_ms:g}")
        return self


class MeasurementConditions(ProfileModel):
    """Measurement conditions of a workload in a shared profile."""

    date_utc: str = Field(description="when")
    machine: str = Field(description="operating system, architecture and Python")
    state: dict[str, str] = Field(
        description="governor, frequency, temperature, throttling and load before the measurement"
    )
    soak: str = Field(default="", description="how the latency changed while it got warm")
    versions: dict[str, str] = Field(description="versions of the packages that took part")
    samples_sha256: str = Field(
        description="SHA-256 of the samples, one a line in ms with three decimals"
    )


def samples_digest(samples_ms: Sequence[float]) -> str:
    """Return the SHA-256 of samples [ms], as in `MeasurementConditions.samples_sha256`."""
    return hashlib.sha256("".join(f"{each:.3f}\n" for each in samples_ms).encode()).hexdigest()


Origin = Literal["measured", "published"]
"""Measured samples, or published moments."""


class Workload(ProfileModel):
    """Latency of one network on one runtime on this computer."""

    network: Network
    policy_sha256: str | None = optional(
        "digest of the policy file that was timed, if it was one of ours"
    )
    latency: LatencyDistribution
    source: str = Field(description="where the latency comes from")
    assumed: str = Field(default="", description="assumptions beyond the source")
    measured: MeasurementConditions | None = later_field(
        None, "how it was timed, in a profile that airl profile --share wrote"
    )

    @model_validator(mode="after")
    def _as_measured(self) -> Workload:
        if self.measured is None:
            return self
        samples_ms = self.latency.samples_ms
        if samples_ms is None:
            raise ValueError("measured: accepted: with latency.samples_ms, which it is about")
        if samples_digest(samples_ms) != self.measured.samples_sha256:
            raise ValueError("measured.samples_sha256: is not that of latency.samples_ms")
        return self

    @property
    def origin(self) -> Origin:
        """Origin of the latency."""
        return "measured" if self.latency.distribution == "samples" else "published"


class ComputerProfile(ProfileModel):
    """An onboard computer."""

    description: str = Field(description="one line for people")
    cpu: str = Field(description="processor")
    watts: float = quantity("electrical power while flying", "W", ge=0, le=10_000)
    mass_g: float = quantity(
        "mass as flown, with cooling and case; carried in the middle of the rotors",
        "g",
        ge=0,
        le=100_000,
        default=0.0,
    )
    ground_equipment: bool = switch(
        "it stays on the ground: neither its mass nor its watts are the aircraft's"
    )
    price_usd: float = quantity("price", "USD", ge=0, le=1_000_000)
    source: str = Field(description="where the numbers come from")
    workloads: dict[str, Workload] = Field(
        default_factory=dict, description="timed workload, by name"
    )

    @property
    def onboard_watts(self) -> float:
        """Power drawn from the aircraft's battery [W]."""
        return 0.0 if self.ground_equipment else self.watts

    @property
    def onboard_mass_kg(self) -> float:
        """Mass added to the aircraft [kg]."""
        return 0.0 if self.ground_equipment else self.mass_g / G_PER_KG


def load_computer(name: str) -> ComputerProfile:
    """Load a computer profile, shipped or by path, including its sample files.

    Raises UsageError as `load_profile`, and if a sample file is missing or contains anything but
    latencies in (0, 60000] ms.
    """
    profile = load_profile("computers", name, ComputerProfile)
    folder = Path(name).parent if name.endswith(".toml") else profiles_dir() / "computers"
    workloads = {
        key: work.model_copy(update={"latency": _with_samples(work.latency, folder)})
        for key, work in profile.workloads.items()
    }
    return profile.model_copy(update={"workloads": workloads})


def _with_samples(latency: LatencyDistribution, folder: Path) -> LatencyDistribution:
    """Replace `samples_file`, relative to `folder`, by its values."""
    if latency.samples_file is None:
        return latency
    samples = read_samples(folder / latency.samples_file, "samples_file")
    return latency.model_copy(update={"samples_ms": samples, "samples_file": None})


def read_samples(path: Path, option: str) -> tuple[float, ...]:
    """Read a text file of measured latencies in order: one per line in ms, # for comments.

    `option` names the file in messages. Raises UsageError if the file cannot be read, is empty, or
    contains anything but latencies in (0, 60000] ms.
    """
    try:
        lines = read_limited(path, "latencies", SAMPLES_BYTES).decode().splitlines()
        values = np.array([float(text) for line in lines if (text := line.split("#")[0].strip())])
    except OSError as error:
        raise UsageError(f"{path}: {option}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(f"{path}: {error}; accepted: one latency a line, ms") from None
    if not values.size:
        raise UsageError(f"{path}: no samples; accepted: one latency a line, ms")
    # Negated, so that NaN counts as outside.
    outside = values[~((values > 0) & (values <= LONGEST_MS))]
    if outside.size:
        raise UsageError(f"{path}: {outside[0]:g}: accepted: 0 < value <= {LONGEST_MS:g} ms")
    return tuple(float(value) for value in values)


# --- writing measurements to a profile


def existing_profile(path: Path, cpu: str) -> ComputerProfile | None:
    """Return the profile in a .toml file, None without one. Raises UsageError for another CPU."""
    if not path.exists():
        return None
    profile = load_profile("computers", str(path), ComputerProfile)
    if profile.cpu != cpu:
        raise UsageError(
            f"{path}: cpu = {profile.cpu!r}, this is {cpu!r}; accepted: another --on or --out"
        )
    return profile


def write_samples(path: Path, samples_ms: Sequence[float], remarks: Sequence[str]) -> None:
    """Write measured latencies in order, one per line in ms, with comments above them."""
    lines = [f"# {remark}" for remark in remarks] + [f"{value:.3f}" for value in samples_ms]
    replace_file(path, "".join(f"{line}\n" for line in lines).encode())


def write_profile(path: Path, profile: ComputerProfile) -> None:
    """Write a profile as TOML, atomically."""
    plain = profile.model_dump(mode="json", exclude_none=True)
    replace_file(path, tomli_w.dumps(plain, multiline_strings=False).encode())


def with_workload(profile: ComputerProfile, name: str, workload: Workload) -> ComputerProfile:
    """Return the profile with a workload added or replaced."""
    return profile.model_copy(update={"workloads": {**profile.workloads, name: workload}})
