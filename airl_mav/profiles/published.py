"""Published results of other projects, shown beside our figures."""

from __future__ import annotations

from functools import cache

from pydantic import Field

from airl_mav.core.fields import ProfileModel, optional
from airl_mav.profiles.loading import load_profile


class PublishedRun(ProfileModel):
    """A column of a published table: means over the flights that reached the goal."""

    label: str = Field(description="computer and policy, as the source calls them")
    latency_ms: float
    flight_time_s: float
    distance_m: float
    energy_kj: float = Field(description="of the vehicle, without its computer")
    success_percent: float | None = optional("None: not given")


class PublishedGap(ProfileModel):
    """Differences of two columns, in percent of the reference; success in percentage points."""

    latency_percent: float | None
    success: float
    flight_time_percent: float
    distance_percent: float
    energy_percent: float


class PublishedTable(ProfileModel):
    """A table that compares runs in one arena."""

    title: str
    arena: str = Field(description="our arena of the same name")
    policy: str = Field(default="", description="layers x filters of the network")
    columns: dict[str, PublishedRun] = Field(description="by role: reference, target, ...")
    printed: dict[str, PublishedGap] = Field(description="gaps as printed, by the target's role")
    note: str = Field(default="", description="how the printed gaps are worked out there")


class PublishedNetwork(ProfileModel):
    """The best network of an architecture search."""

    network: str = Field(description="layers x filters")
    success_percent: float


class Published(ProfileModel):
    """All results of one publication."""

    description: str = Field(description="the source")
    tables: tuple[PublishedTable, ...] = Field(
        description="of one arena the first that fits is shown"
    )
    degradation: tuple[PublishedRun, ...] = Field(description="one policy by growing latency")
    best_networks: dict[str, PublishedNetwork] = Field(description="by arena")
    generalisation: dict[str, dict[str, float]] = Field(
        description="success [%] by the arena trained in, then the arena flown in"
    )
    ablation: dict[str, dict[str, float]] = Field(
        description="success [%] by arena, then the input that was made zero"
    )


@cache
def load_published(name: str = "air-learning") -> Published:
    """Load published results. Raises UsageError."""
    return load_profile("published", name, Published)


def published_gap(reference: PublishedRun, target: PublishedRun) -> PublishedGap:
    """Return the differences of two published columns, signed: percent, success in points."""

    def percent(key: str) -> float:
        first, second = getattr(reference, key), getattr(target, key)
        return float(100.0 * (second - first) / first)

    first, second = reference.success_percent, target.success_percent
    return PublishedGap(
        latency_percent=percent("latency_ms"),
        success=0.0 if first is None or second is None else second - first,
        flight_time_percent=percent("flight_time_s"),
        distance_percent=percent("distance_m"),
        energy_percent=percent("energy_kj"),
    )
