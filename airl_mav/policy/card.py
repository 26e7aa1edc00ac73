"""Policy card: inputs, outputs, training and measured quality of a policy file.

A policy is a folder with `policy.onnx` and `card.json`. The card contains the file's SHA-256
digest, which binds the card to this file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import Field, Strict, model_validator

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import Level
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, optional, quantity, switch, validated
from airl_mav.core.files import read_json
from airl_mav.policy.actions import ACTION_SETS, ActionSpec, DecisionTiming
from airl_mav.policy.layouts import LAYOUTS, layout_of
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch, further_mismatch
from airl_mav.policy.runtime import OnnxRuntime
from airl_mav.profiles.camera import Camera

SCHEMA = 1
"""Version of the card's fields."""

CARD_FILE = "card.json"
ONNX_FILE = "policy.onnx"
TORCH_FILE = "policy.pt2"
"""Optional copy of the network as a torch program (`torch.export`)."""

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Strict()]


class Training(ProfileModel):
    """Training of a policy; unknown for some external policies."""

    arena: str | None = optional("arena profile it was trained in")
    first_arena_seed: Count | None = optional("first seed of the arenas")
    last_arena_seed: Count | None = optional("last seed of the arenas")
    seed: Count | None = optional("seed of the training")
    env_steps: int | None = quantity("decisions it was trained on", "1", ge=0, default=None)
    config_file: str | None = optional("name of the training's settings")
    config: dict[str, Any] = Field(default_factory=dict, description="the settings in full")
    command: str | None = optional("command that made the policy")
    versions: dict[str, str] = Field(default_factory=dict, description="packages by name")
    date_utc: str | None = optional("when it was exported, ISO 8601")


class Measured(Protocol):
    """A figure with its 95 % interval: `flight.statistics.Estimate`, or a published one."""

    @property
    def value(self) -> float | None:
        """Estimate; None = no data."""

    @property
    def low(self) -> float | None:
        """Lower end of the interval."""

    @property
    def high(self) -> float | None:
        """Upper end of the interval."""

    @property
    def n(self) -> int:
        """Number of flights."""


class MeasuredQuality(Protocol):
    """Figures of flown episodes: `flight.statistics.Aggregate`, or a published run."""

    @property
    def success_rate(self) -> Measured:
        """Fraction, 0 to 1."""

    @property
    def flight_time_s(self) -> Measured:
        """Mean over the successful flights, as are the following properties."""

    @property
    def distance_m(self) -> Measured:
        """Flown distance [m]."""

    @property
    def energy_j(self) -> Measured:
        """Energy of the vehicle without its computer [J]."""


class MeasuredResult(ProfileModel):
    """Measured quality over a set of episodes; means over the successful ones."""

    arena: str = Field(description="arena profile")
    level: Level = Field(description="rung of the fidelity ladder")
    latency: str | None = optional(
        "source of t2 as --latency takes it; none: as fast as a desktop computer"
    )
    episodes: int = quantity("episodes flown", "1", ge=1)
    seed: Count = Field(description="seed of the first episode; each has the next")
    success_rate: float = quantity("share of episodes that reached the goal", "1", ge=0, le=1)
    success_low: float | None = quantity(
        "lower end of its 95 % interval (Wilson)", "1", ge=0, le=1, default=None
    )
    success_high: float | None = quantity(
        "upper end of its 95 % interval (Wilson)", "1", ge=0, le=1, default=None
    )
    flight_time_s: float | None = quantity("flight time", "s", ge=0, default=None)
    distance_m: float | None = quantity("distance flown", "m", ge=0, default=None)
    energy_j: float | None = quantity("energy drawn", "J", ge=0, default=None)
    flown_utc: str | None = optional("when it was flown, ISO 8601")
    behaviour: str | None = optional("fingerprint of the flight behaviour that it was flown with")

    @classmethod
    def of(cls, quality: MeasuredQuality, **conditions: Any) -> MeasuredResult:
        """Return a result with the figures of a quality; `conditions` are the other fields."""
        rate = quality.success_rate
        return cls(
            episodes=rate.n,
            success_rate=rate.value or 0.0,
            success_low=rate.low,
            success_high=rate.high,
            flight_time_s=quality.flight_time_s.value,
            distance_m=quality.distance_m.value,
            energy_j=quality.energy_j.value,
            **conditions,
        )


class PolicyFacts(ProfileModel):
    """Metadata of a policy from its author: all fields that the file does not contain."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        description="short name: letters, digits, '.', '_', '-'",
    )
    description: str = Field(default="", description="one line for people")
    observation: ObservationSpec
    actions: ActionSpec = Field(default_factory=ActionSpec)
    hold_s: float = quantity("t3: how long each action is held", "s", ge=0, le=10)
    goal_radius_m: float = quantity("radius of the goal in training", "m", ge=0.2, le=50)
    altitude_m: float = quantity("height above the start", "m", ge=0.5, le=100)
    hover_after_s: float | None = quantity(
        "the vehicle hovers when a command is this old; none: the last one keeps flying",
        "s",
        ge=0,
        le=60,
        default=None,
    )
    decision_timeout_s: float | None = quantity(
        "a decision is overdue so long after the last one; none: as the companion has it by"
        " default",
        "s",
        ge=0.1,
        le=60,
        default=None,
        later=True,
    )
    decisions: DecisionTiming = Field(
        default="sequential", description="when a decision begins; see airl_mav.scenario.model"
    )
    compensate: bool = switch("it wants its decision latency compensated, as in training")
    algorithm: str = Field(default="", description="training algorithm")
    epsilon: float = quantity("share of random actions in flight", "1", ge=0, le=1, default=0.0)
    training: Training = Field(default_factory=Training)
    results: tuple[MeasuredResult, ...] = Field(default=(), description="how well it flies")

    @model_validator(mode="after")
    def _random_actions_are_discrete(self) -> PolicyFacts:
        # Custom sets are not loaded: reading a card runs no code.
        known = ACTION_SETS.get(self.actions.set)
        if self.epsilon and known is not None and known.discrete is None:
            raise ValueError(
                f"epsilon = {self.epsilon:g}: accepted: 0 with the action set {self.actions.set!r}"
            )
        return self


class Quantisation(ProfileModel):
    """Conversion of a network from floats to 8-bit integers."""

    method: str = Field(description="quantised parts, and the method for the ranges")
    source_sha256: Digest = Field(description=f"SHA-256 digest of the {ONNX_FILE} in floats")
    arena: str = Field(description="arena profile of the calibration's frames")
    first_seed: Count = Field(description="first seed of those flights; no evaluation uses it")
    last_seed: Count = Field(description="last seed of those flights")
    frames: int = quantity("frames that the ranges come from", "1", ge=1)
    checked: int = quantity("other frames on which both were compared", "1", ge=1)
    agreement: float | None = quantity(
        "share of those on which both choose the same action; none: continuous actions",
        "1",
        ge=0,
        le=1,
        default=None,
    )
    error: float = quantity(
        "root mean square of the difference of the outputs, in shares of their spread", "1", ge=0
    )


class PolicyCard(PolicyFacts):
    """Complete policy card."""

    sha256: Digest = Field(description=f"SHA-256 digest of {ONNX_FILE}")
    torch_sha256: Digest | None = optional(f"SHA-256 digest of {TORCH_FILE}, if there is one")
    state: dict[str, tuple[Count, ...]] = Field(
        default_factory=dict,
        description="memory of a recurrent network: shapes by name; input NAME, output next_NAME,"
        " zeros at the start of a flight",
    )
    network: str = Field(description="its layers, as text")
    parameters: int = quantity("weights and biases", "1", ge=1)
    macs: int = quantity("multiply-accumulates of one inference", "1", ge=1)
    quantisation: Quantisation | None = optional(
        "of a network in 8-bit integers; none: one in floats"
    )


def digest(data: bytes) -> str:
    """Return the SHA-256 of a file's bytes as in a card."""
    return hashlib.sha256(data).hexdigest()


def read_card(folder: Path) -> PolicyCard:
    """Read the card of a policy without the network. Raises UsageError."""
    path = folder / CARD_FILE
    data = read_json(path, SCHEMA, "policy")
    del data["schema"]
    return validated(PolicyCard, data, path)


def read_model(folder: Path, card: PolicyCard) -> bytes:
    """Return the network of a card. Raises UsageError if the digest differs."""
    return _read_bound(folder / ONNX_FILE, card.sha256)


def read_torch_program(folder: Path, card: PolicyCard) -> bytes:
    """Return the torch program of a card. Raises UsageError if missing or the digest differs."""
    if card.torch_sha256 is None:
        raise UsageError(
            f"{folder / TORCH_FILE}: the card names none; export the policy with --with-torch"
        )
    return _read_bound(folder / TORCH_FILE, card.torch_sha256)


def load_card(folder: Path, *, trust: bool = False) -> PolicyCard:
    """Read the card of a policy and check the policy against it.

    Raises UsageError as `read_card`, and if the digest, inputs or outputs of the file differ from
    the card, or the card names untrusted code.
    """
    card = read_card(folder)
    open_model(folder, card, trust=trust)
    return card


def check_trust(folder: Path, card: PolicyCard, *, trust: bool) -> None:
    """Raise UsageError for a card that names code, unless its author is trusted.

    Cards of this package name no code.
    """
    named = {"actions.set": card.actions.set} if card.actions.set not in ACTION_SETS else {}
    if card.observation.layout not in LAYOUTS:
        named["observation.layout"] = card.observation.layout
    if named and not trust:
        listed = ", ".join(f"{field} = {name!r}" for field, name in named.items())
        raise UsageError(
            f"{folder / CARD_FILE}: {listed} is code that would run on this machine; accepted: with"
            " --trust, if you trust its maker"
        )


def open_model(
    folder: Path, card: PolicyCard, threads: int = 1, *, trust: bool = False
) -> OnnxRuntime:
    """Return the policy of a card, ready for inference. Raises UsageError as `load_card`."""
    check_trust(folder, card, trust=trust)
    model = read_model(folder, card)
    try:
        return OnnxRuntime(model, card.observation, card.actions, threads, card.state)
    except ValueError as error:
        raise UsageError(f"{folder / ONNX_FILE}: {error}") from None


def vehicle_mismatch(
    card: PolicyCard, camera: Camera, further: Mapping[str, Camera] | None = None
) -> str | None:
    """Return why a vehicle's cameras cannot serve a policy, or None; `further` are by name."""
    seen, others = card.observation, further or {}
    lenses = {name: Intrinsics.of(each) for name, each in others.items()}
    if (reason := further_mismatch(seen, lenses)) is not None:
        return reason
    if layout_of(seen.layout).looks_ahead and camera.yaw_deg != 0.0:
        return f"camera with yaw_deg = {camera.yaw_deg:g}; accepted: 0 with layout {seen.layout!r}"
    for name, each in seen.cameras.items():
        if each.kind == "depth" and others[name].range_m < each.range_m:
            return (
                f"camera {name!r} with a range of {others[name].range_m:g} m;"
                f" accepted: {each.range_m:g} m or more"
            )
    if (reason := camera_mismatch(card.observation, Intrinsics.of(camera))) is not None:
        return reason
    # Objects beyond the camera's range would look free, unlike in training. Colour has no range.
    if camera.kind == "depth" and camera.range_m < card.observation.range_m:
        return (
            f"camera with a range of {camera.range_m:g} m; "
            f"accepted: {card.observation.range_m:g} m or more"
        )
    return None


def _read_bound(path: Path, sha256: str) -> bytes:
    """Return a file's bytes if they match the digest. Raises UsageError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    if (found := digest(data)) != sha256:
        raise UsageError(
            f"{path}: SHA-256 {found[:12]}...; accepted: {sha256[:12]}..., that of {CARD_FILE}"
        )
    return data
