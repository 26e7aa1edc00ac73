"""Request of `profile`: meaning, unit, range and default of each field."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import quantity
from airl_mav.latency.injection import duration_ms
from airl_mav.scenario.aircraft import Ports
from airl_mav.scenario.model import GREATEST_SEED, Inference
from airl_mav.scenario.stand_alone import CompanionAddresses

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

FLOWN_SPEED_M_S = 0.1
"""Speed limit in flight: too slow to reach a goal or a wall."""

SHORTEST_SOAK_MS, LONGEST_SOAK_MS = 10e3, 24 * 3600e3

ProfileLevel = Literal["bare", "sitl", "hil"]


class ProfileRequest(CompanionAddresses, Inference):
    """Subject and method of a measurement."""

    policy: str | None = Field(
        default=None,
        description="policy to measure: a name, or a path to a folder with policy.onnx and"
        " card.json; by default the default policy, or with a network a random one",
    )
    network: str | None = Field(
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
    level: ProfileLevel = Field(
        default="bare",
        description="bare: inference alone, on this computer. sitl: in flight, through the"
        " processes of airl-sitl, all stages. hil: the companion on this computer, against an"
        " airl-firmware that runs elsewhere",
    )
    decisions: int = quantity(
        "decisions to measure, after the warm-up", "1", ge=10, le=100_000, default=1000
    )
    warm_up: int = quantity(
        "decisions at the start of each flight that are left out; the very first one is reported"
        " separately",
        "1",
        ge=1,
        le=10_000,
        default=50,
    )
    hold_s: float = quantity(
        "levels sitl and hil, t3: how long an action is held before the next observation; short,"
        " and flown at walking pace, because timing is measured and not the quality of flight",
        "s",
        ge=0,
        le=1,
        default=0.05,
    )
    soak: str | None = Field(
        default=None,
        description="after the measurement, run inference alone for this time, as 90s, 10min or 1h,"
        " and record latency, frequency and temperature, to detect thermal throttling",
    )
    on: str | None = Field(
        default=None,
        pattern=NAME,
        description="name of the computer, and of its profile's file; by default after its"
        " processor",
    )
    workload: str | None = Field(
        default=None,
        pattern=NAME,
        description="name of the workload in the profile; replaces an existing one; default: from"
        " policy, level, runtime and threads",
    )
    watts: float | None = quantity(
        "power that the computer draws; by default as measured, where this computer tells it,"
        " or that of an existing profile, or 0",
        "W",
        ge=0,
        le=10_000,
        default=None,
    )
    price_usd: float | None = quantity(
        "price of the computer; by default that of an existing profile, or 0",
        "USD",
        ge=0,
        le=1_000_000,
        default=None,
    )
    seed: int = quantity(
        "seed of the random network, of the observations at level bare, and of the flights",
        "1",
        ge=0,
        le=GREATEST_SEED,
        default=1,
    )
    vehicle: str | None = Field(
        default=None,
        description="vehicle profile that gives the camera: a shipped name, or a path to a .toml;"
        " by default the first shipped one whose camera fits",
    )
    ports: Ports = Field(default_factory=Ports, description="ports of level sitl")

    @field_validator("soak")
    @classmethod
    def _known_duration(cls, soak: str | None) -> str | None:
        if (
            soak is not None
            and not SHORTEST_SOAK_MS <= (duration_ms(soak) or 0.0) <= LONGEST_SOAK_MS
        ):
            raise FieldError("soak", soak, "10s to 24h, as 90s, 10min or 1h")
        return soak

    @property
    def soak_s(self) -> float | None:
        """Duration of the soak [s]; None: no soak."""
        given_ms = None if self.soak is None else duration_ms(self.soak)
        return None if given_ms is None else given_ms * US_PER_MS / US_PER_S

    @property
    def flown_as(self) -> dict[str, Any]:
        """Scenario fields for the flight at levels sitl and hil."""
        shared = {*Inference.model_fields, "hold_s", "seed"}
        limits = {"goal_radius_m": 0.5, "max_speed_m_s": FLOWN_SPEED_M_S}
        return {**self.model_dump(include=shared), **limits}
