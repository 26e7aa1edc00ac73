"""Specification of an environment: arguments of `airl/Navigation-v0`, table of a training file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator

from airl_mav.core.errors import FieldError, UnexpectedArgumentError, UsageError
from airl_mav.core.fields import Each, ProfileModel, later_field, quantity, validated
from airl_mav.core.plugins import REWARDS, part_name
from airl_mav.flight.judge import GOAL_RADIUS_M, TIME_LIMIT_S, GoalRadius, TimeLimit
from airl_mav.policy import layouts, observation_spec
from airl_mav.policy.actions import (
    BODY_RATES,
    MAX_RATE_DEG_S,
    PAPER_SPEED_M_S,
    UPRIGHT_S,
    ActionSetName,
    ActionSpec,
    DecisionTiming,
    MaxRate,
)
from airl_mav.profiles import projections
from airl_mav.profiles.camera import Camera, check_matched, check_rows
from airl_mav.profiles.vehicle import SensorNoise, Spread, WindSettings, load_vehicle

SHIPPED_REWARDS = ("shaped", "timed", "progress", "paced", "paper-scaled", "paper")
"""See `envs.rewards`."""

RewardName = Annotated[str, part_name(REWARDS, SHIPPED_REWARDS)]


class EpisodeRules(ProfileModel):
    """Rules of an episode and the decision period."""

    goal_radius_m: GoalRadius = GOAL_RADIUS_M
    time_limit_s: TimeLimit = TIME_LIMIT_S
    hold_s: float = quantity(
        "t3: how long an action is held before the next observation",
        "s",
        ge=0.02,
        le=10,
        default=0.5,
    )
    hover_after_s: float | None = quantity(
        "zero the velocity so long after the hold time when no new action has come (AirSim: 0.06);"
        " left out: the last one persists (PX4, MAVSDK)",
        "s",
        ge=0,
        le=60,
        default=None,
    )
    decision_timeout_s: float | None = quantity(
        "time since the last action after which body rates are replaced by a stop, as the"
        f" companion's watchdog does; left out: {UPRIGHT_S:g} beyond the hold time. Velocities"
        " persist",
        "s",
        ge=0.1,
        le=60,
        default=None,
        later=True,
    )
    altitude_m: float = quantity(
        "height that is held; with a vertical speed in the actions: that it begins at",
        "m",
        ge=0.5,
        le=100,
        default=2.5,
    )


class CameraChange(ProfileModel):
    """Changes to the vehicle's camera; omitted fields keep the vehicle's values."""

    width_px: int | None = quantity("image width", "px", ge=8, le=640, default=None)
    height_px: int | None = quantity("image height", "px", ge=1, le=480, default=None)
    projection: projections.Projection | None = Field(
        default=None,
        description="pinhole, cylindrical for a field of view of up to 360 deg, or fisheye of up to"
        " 190 deg",
    )
    horizontal_fov_deg: float | None = quantity(
        "horizontal field of view, less than 170 with a pinhole",
        "deg",
        gt=10,
        le=projections.CYLINDER_MOST_DEG,
        default=None,
    )
    range_m: float | None = quantity("farthest depth returned", "m", gt=0.5, le=65, default=None)
    kind: projections.CameraKind | None = Field(
        default=None, description="pixel type: depth, rgb or grey"
    )

    def of(self, camera: Camera) -> Camera:
        """Return a vehicle's camera with the changes. Raises FieldError for a mismatch."""
        made = camera.model_copy(update=self.model_dump(exclude_none=True))
        field, fov_deg = "camera.horizontal_fov_deg", made.horizontal_fov_deg
        projections.check_lens(field, made.projection, fov_deg, made.distortion)
        check_matched("camera.kind", made)
        check_rows("camera.height_px", made)
        return made


class FurtherView(ProfileModel):
    """Image of an additional camera as network input."""

    image_width_px: int | None = quantity(
        "image that the network sees; left out: as wide as the camera's",
        "px",
        ge=4,
        le=640,
        default=None,
    )
    image_height_px: int | None = quantity(
        "image that the network sees; left out: as high as the camera's",
        "px",
        ge=layouts.LEAST_ROWS,
        le=480,
        default=None,
    )
    frames: observation_spec.Frames = 1


class Delay(ProfileModel):
    """Decision latency: the stages of docs/architecture.md, in simulated time."""

    computer: str = Field(default="workstation", description="computer profile to fly as, and with")
    workload: str | None = Field(
        default=None, description="workload whose t2 is drawn; left out: latency, or native_ms"
    )
    latency: tuple[str, ...] = Field(
        default=(),
        description="sources of t2 as --latency takes them, in place of computer and workload; of "
        "several, each episode draws one",
    )
    native_ms: float = quantity(
        "t2 when neither is chosen: inference on a desktop computer",
        "ms",
        ge=0,
        le=60_000,
        default=1.0,
    )
    transport_ms: float = quantity(
        "t1 without the wait for the frame: capture to decoded", "ms", ge=0, le=1000, default=5.0
    )
    link_ms: float = quantity(
        "setpoint sent to accepted, and to the first motor command",
        "ms",
        ge=0,
        le=1000,
        default=4.0,
    )

    @model_validator(mode="after")
    def _one_source(self) -> Delay:
        if self.latency and self.workload is not None:
            raise ValueError(f"latency: with workload = {self.workload!r}: accepted: one of them")
        return self


class SafeVelocity(ProfileModel):
    """Speed limit from the stopping distance, with sensing distance and decision latency.

    Defined in `envs.stopping`.
    """

    sensing_distance_m: float = quantity(
        "depth at which the policy takes notice of an obstacle, from the camera to its surface; the"
        " paper gives none",
        "m",
        gt=0,
        le=1000,
    )


class Randomisation(SensorNoise, Spread):
    """Domain randomization, drawn with every episode around the profile's value; 0 = none.

    Includes the fields of a scenario's tables `spread` and `sensors`.
    """

    estimation: bool = Field(
        default=True,
        description="telemetry carries the estimator's error, where the vehicle's profile has it",
    )
    extra_delay_ms: Annotated[tuple[float, float], Each(0, 10_000, ascending=True)] = quantity(
        "added to t2: one value an episode, drawn from this range", "ms", default=(0.0, 0.0)
    )


class Costs(ProfileModel):
    """Action costs of a decision, subtracted from any reward; 0 = no cost."""

    command_step: float = quantity(
        "per m/s by which the velocity command differs from the one before",
        "1",
        ge=0,
        le=1000,
        default=0.0,
    )
    turn_step: float = quantity(
        "per rad/s by which the yaw rate differs from the one before",
        "1",
        ge=0,
        le=1000,
        default=0.0,
    )
    energy: float = quantity(
        "per kilojoule that the vehicle has drawn, its computer apart",
        "1",
        ge=0,
        le=1000,
        default=0.0,
    )
    failure: float = quantity("of a collision or an empty battery", "1", ge=0, le=1000, default=0.0)


class Curriculum(ProfileModel):
    """Zones of growing radius around the start, as in the paper; goals are drawn inside.

    Obstacles can become more numerous, faster and denser from stage to stage; the last stage is the
    unchanged arena.
    """

    window: int = quantity("last episodes that count", "1", ge=1, le=1_000_000, default=1000)
    threshold: float = quantity(
        "success rate over them from which the next zone opens", "1", gt=0, le=1, default=0.5
    )
    stages: int | None = quantity(
        "stages, over which the zones are spread; left out: as many as the arena has zones",
        "1",
        ge=1,
        le=100,
        default=None,
    )
    count: float = quantity(
        "share of the obstacles that the first stage has; it grows in a straight line to 1",
        "1",
        ge=0,
        le=1,
        default=1.0,
    )
    speed: float = quantity(
        "share of their speed that moving obstacles have in the first stage; it grows to 1",
        "1",
        gt=0,
        le=1,
        default=1.0,
    )
    clearance_m: float = quantity(
        "added to the least gap between obstacles in the first stage; it falls to 0",
        "m",
        ge=0,
        le=50,
        default=0.0,
    )


class EnvironmentSpec(ProfileModel):
    """Environment: vehicle, arena, observation, actions, reward, latency, randomization."""

    vehicle: str = Field(default="quad", description="vehicle profile")
    arena: str = Field(default="static-obstacles", description="arena profile")
    layout: observation_spec.LayoutName = Field(
        default="body",
        description="observation layout: body, paper, scan, or your own as MODULE:NAME or"
        " FILE.py:NAME",
    )
    image_width_px: int = quantity("image that the network sees", "px", ge=4, le=640, default=32)
    image_height_px: int = quantity(
        "image that the network sees; less than 4 only with layout scan",
        "px",
        ge=1,
        le=480,
        default=24,
    )
    frames: observation_spec.Frames = 1
    in_flight: tuple[observation_spec.Told, ...] = Field(
        default=(),
        description="additional inputs of the network: command, latency, age, setpoint, tilt,"
        " rates, height",
    )
    goal_height: observation_spec.GoalHeight = False
    actions: ActionSetName = Field(
        default="arc-25",
        description="action set: arc-25, paper-25, velocity, velocity-fixed-yaw;"
        " with a vertical speed arc3d-75, velocity3d, velocity3d-fixed-yaw,"
        " velocity3d-yaw-rate; body-rates, with a thrust; or your own as"
        " MODULE:NAME or FILE.py:NAME",
    )
    max_speed_m_s: float = quantity("fastest action", "m/s", gt=0, le=30, default=PAPER_SPEED_M_S)
    max_rate_deg_s: MaxRate = later_field(MAX_RATE_DEG_S)
    reward: RewardName = Field(
        default="shaped",
        description="reward: shaped, timed, progress, paced, paper-scaled, paper, or your own as"
        " MODULE:NAME or FILE.py:NAME",
    )
    costs: Costs = Field(
        default_factory=Costs,
        description="of unsteady commands, energy and failures, beside the reward",
    )
    camera: CameraChange = Field(default_factory=CameraChange, description="camera, if another")
    cameras: dict[observation_spec.CameraName, FurtherView] = later_field(
        dict, "further cameras of the vehicle that the network sees by, by their names"
    )
    episode: EpisodeRules = Field(default_factory=EpisodeRules, description="rules")
    delay: Delay = Field(default_factory=Delay, description="how late decisions are")
    decisions: DecisionTiming = Field(
        default="sequential",
        description="when a decision begins: sequential, after the hold of the one before;"
        " pipelined, with the newest frame as soon as that one is ready",
    )
    compensate: bool = Field(
        default=False,
        description="carry what is seen forward to when the decision will act, by the vehicle's"
        " response to the setpoints in flight",
    )
    safe_velocity: SafeVelocity | None = Field(
        default=None, description="bound max_speed_m_s by the safe velocity; left out: do not"
    )
    randomisation: Randomisation = Field(
        default_factory=Randomisation, description="quantities randomized in every episode"
    )
    wind: WindSettings = Field(default_factory=WindSettings, description="wind")
    curriculum: Curriculum | None = Field(
        default=None, description="zones by success; left out: the whole arena from the start"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> EnvironmentSpec:
        if self.episode.hold_s >= self.episode.time_limit_s:
            raise ValueError(
                f"episode.hold_s = {self.episode.hold_s:g}: accepted: value < "
                f"{self.episode.time_limit_s:g} s (episode.time_limit_s)"
            )
        if self.decisions == "pipelined" and self.episode.hover_after_s is not None:
            raise ValueError(
                "decisions = 'pipelined': with episode.hover_after_s: accepted: one of them, as no"
                " hold ends"
            )
        timeout_s, held_s = self.episode.decision_timeout_s, self.episode.hold_s
        if self.decisions == "sequential" and timeout_s is not None and timeout_s <= held_s:
            raise ValueError(
                f"episode.decision_timeout_s = {timeout_s:g}: accepted: value > {held_s:g} s"
                " (episode.hold_s), or every decision is overdue"
            )
        if self.cameras and self.layout == "paper":
            raise ValueError(
                f"cameras = {', '.join(self.cameras)}: accepted: none with layout 'paper'"
            )
        if self.cameras and self.compensate:
            raise ValueError(
                "compensate = true: accepted: false with further cameras, whose images are not"
                " carried forward"
            )
        for name, value, usual in (
            ("compensate", self.compensate, False),
            ("safe_velocity", self.safe_velocity, None),
            ("costs.command_step", self.costs.command_step, 0.0),
            ("costs.turn_step", self.costs.turn_step, 0.0),
        ):
            # These options act on velocities.
            if self.actions == BODY_RATES and value != usual:
                raise ValueError(
                    f"{name} = {value!r}: accepted: {usual!r} with actions {BODY_RATES!r}, which"
                    " command no velocity"
                )
        if self.goal_height and self.layout == "paper":
            raise ValueError("goal_height = true: accepted: false with layout 'paper'")
        return self

    @property
    def action_spec(self) -> ActionSpec:
        """Action set with its maximum speed."""
        return ActionSpec(
            set=self.actions, max_speed_m_s=self.max_speed_m_s, max_rate_deg_s=self.max_rate_deg_s
        )


def spec_of(spec: EnvironmentSpec | None, knobs: Mapping[str, Any]) -> EnvironmentSpec:
    """Return the specification, or create it from its fields, with nested tables as dicts.

    Raises:
        UsageError: A knob is unknown, of the wrong type or out of range, or both are given.
    """
    if spec is not None:
        if knobs:
            raise UsageError(f"spec and {', '.join(knobs)}: accepted: one or the other")
        return spec
    return validated(EnvironmentSpec, dict(knobs))


def gymnasium_spec(spec: EnvironmentSpec | None, knobs: Mapping[str, Any]) -> EnvironmentSpec:
    """Return the specification for environments in Gymnasium's API.

    As `spec_of`, but without an image size the network receives the camera's native image: common
    image networks need larger images than the default of training files, stable-baselines3's at
    least 36 px each way.

    Raises:
        UnexpectedArgumentError: Unknown knob.
        UsageError: As `spec_of`, or the vehicle's profile is invalid.
    """
    try:
        made = spec_of(spec, knobs)
    except FieldError as error:
        # Only unknown keywords become an UnexpectedArgumentError.
        if error.field not in knobs.keys() - EnvironmentSpec.model_fields.keys():
            raise
        hint = error.problem.removeprefix("unknown field")
        raise UnexpectedArgumentError(
            f"unexpected keyword argument {error.field!r}{hint}"
        ) from None
    if spec is not None or {"image_width_px", "image_height_px"} & knobs.keys():
        return made
    camera = made.camera.of(load_vehicle(made.vehicle).camera)
    # Layout `paper` has additional rows.
    rows = camera.height_px + (layouts.STRIP_ROWS if made.layout == "paper" else 0)
    return spec_of(None, {**knobs, "image_width_px": camera.width_px, "image_height_px": rows})
