"""Scenario: the model of all rehearsal settings.

Shared by command-line options, scenario files, `run.json` and the processes of a rehearsal.
Meaning, unit, range and default of a setting are defined only here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tomli_w
from pydantic import Field, ModelWrapValidatorHandler, ValidationError, model_validator

from airl_mav.core.constants import CommandKind
from airl_mav.core.fields import COMMON, ProfileModel, field_error, optional, quantity, switch
from airl_mav.core.files import replace_file
from airl_mav.core.plugins import names_file
from airl_mav.flight.judge import TIME_LIMIT_S, GoalRadius, TimeLimit
from airl_mav.policy.actions import KINDS, UPRIGHT_S, DecisionTiming
from airl_mav.scenario.aircraft import FREE, NOT_IN_GYM, Aircraft

Place = tuple[
    Annotated[float, Field(ge=-90.0, le=90.0)],
    Annotated[float, Field(ge=-180.0, le=180.0)],
    Annotated[float, Field(gt=-12_000.0, lt=100_000.0)],
]
"""Latitude, longitude [deg], altitude above mean sea level [m]; PX4's limits for an origin."""

ArenaName = Annotated[
    str, Field(description="arena profile: a shipped name, or a path to a .toml"), COMMON, "arena"
]
PolicyName = Annotated[
    str,
    Field(
        description="policy: a name, a path to a folder with policy.onnx and"
        " card.json, or a Python class as FILE.py:CLASS or MODULE:CLASS"
    ),
    COMMON,
    "policy",
]

DEFAULT_POLICY, DEFAULT_ARENA = "generalist", "static-obstacles"
"""Default policy and arena of a scenario."""
ONBOARD_COMPUTER, REFERENCE_COMPUTER = "ras-pi-4", "workstation"
"""Default computers of experiments that compare an onboard computer with a reference."""

GREATEST_SEED = 2**31
GREATEST_EPISODES = 100_000
GREATEST_WORKERS = 256
GREATEST_SLOTS = 4096
GREATEST_ZONE = 100

LevelName = Literal["gym", "lockstep", "sitl"]
RuntimeName = Literal["onnx", "torch"]
AblationName = Literal["depth", "rgb", "grey", "velocity", "goal"]
StartName = Literal["ground", "hover"]


def _seed(description: str, default: Any = 1) -> Any:
    return quantity(description, "1", ge=0, le=GREATEST_SEED, default=default)


DECISION_TIMEOUT_S = 2.0
"""Default timeout of a velocity command [s]."""


class WatchdogSettings(ProfileModel):
    """Timeouts for a silent policy, in simulated time."""

    GROUP: ClassVar[str] = "limits"
    decision_timeout_s: float | None = quantity(
        "time since the last action after which the velocity is zeroed; longer than the hold time;"
        f" by default as the policy's card says, or {DECISION_TIMEOUT_S:g}, and {UPRIGHT_S:g}"
        " beyond the hold time for a policy that commands attitudes or body rates",
        "s",
        ge=0.1,
        le=60,
        default=None,
    )
    leave_after_s: float = quantity(
        "further time after which the companion leaves offboard mode",
        "s",
        ge=0.1,
        le=60,
        default=2.0,
    )
    hover_after_s: float | None = quantity(
        "zero the velocity this long after an action's hold time, whether or not a decision has"
        " come (AirSim: 0.06); by default as the policy's card says, or never: the last setpoint"
        " persists, as with PX4 and MAVSDK",
        "s",
        ge=0,
        le=60,
        default=None,
    )

    def timeout_s(
        self,
        commands: CommandKind = "velocity",
        hold_s: float = 0.0,
        on_card: float | None = None,
    ) -> float:
        """Return the decision timeout [s]: configured, from the card, or the default."""
        if self.decision_timeout_s is not None:
            return self.decision_timeout_s
        if on_card is not None:
            return on_card
        return DECISION_TIMEOUT_S if KINDS[commands].steady else hold_s + UPRIGHT_S


class LimitSettings(ProfileModel):
    """Limits on telemetry, camera and flight; a violation ends the flight."""

    GROUP: ClassVar[str] = "limits"
    silence_s: float = quantity(
        "telemetry that stays the same for longer, and frames that come later, are rejected",
        "s",
        ge=0.5,
        le=60,
        default=2.0,
    )
    image_s: float = quantity(
        "new frames that show the same image for longer are rejected",
        "s",
        ge=0.1,
        le=60,
        default=0.5,
    )
    drift_m: float = quantity(
        "a position and a velocity that part by more within 5 s are rejected",
        "m",
        ge=0.5,
        le=20,
        default=1.0,
    )
    radius_m: float | None = quantity(
        "maximum horizontal distance from the start; by default twice that of the goal plus 50 m",
        "m",
        gt=0,
        le=20_000,
        default=None,
    )
    height_m: float | None = quantity(
        "maximum height above the start; by default 10 m above the flight altitude and the goal",
        "m",
        gt=0,
        le=1000,
        default=None,
    )
    flight_s: float | None = quantity(
        "maximum navigation time; by default 120 s and ten times the time straight to the goal,"
        " in a rehearsal at least 10 s more than its time limit",
        "s",
        ge=1,
        le=36_000,
        default=None,
    )
    battery: float | None = quantity(
        "minimum battery charge, 1 is full; by default only the flight controller checks it",
        "1",
        gt=0,
        lt=1,
        default=None,
    )


@dataclass(frozen=True)
class PilotSettings:
    """Resolved settings for flying a policy."""

    hold_s: float = 0.5
    """Duration t3 for which an action is held before the next observation [s]."""
    goal_radius_m: float = 2.0
    """Horizontal goal radius [m]."""
    altitude_m: float = 2.5
    """Height above the start during the flight [m]."""
    max_speed_m_s: float = 5.0
    """Horizontal speed limit of all actions [m/s]."""
    decisions: DecisionTiming = "sequential"
    """Start of a decision: after the previous hold, or once the previous decision is ready."""
    compensate: bool = False
    """True to predict state and image at the time of effect."""
    commands: CommandKind = "velocity"
    """Kind of setpoint that the policy commands."""
    origin: tuple[float, float, float] | None = None
    """Start position: latitude, longitude [deg], altitude [m]; None = from GPS."""


class Inference(ProfileModel):
    """Settings of network inference."""

    GROUP: ClassVar[str] = "policy"
    runtime: RuntimeName = Field(
        default="onnx", description="runtime of a learned policy; torch needs its policy.pt2"
    )
    threads: int = quantity("threads of one inference", "1", ge=1, le=64, default=1)
    trust: bool = switch(
        "run policy.pt2, or code that the card names, of a folder that is not shipped:"
        " both execute what its author wrote"
    )


class Decisions(Inference):
    """Policy settings and flight settings of its actions."""

    GROUP: ClassVar[str] = "policy"
    hold_s: float | None = quantity(
        "hold time (t3) of an action before the next observation; by default that of the"
        " policy's card, or 0.5",
        "s",
        ge=0,
        le=10,
        default=None,
    )
    altitude_m: float | None = quantity(
        "height above the start that is flown; by default that of the policy's card, or 2.5",
        "m",
        ge=0.5,
        le=100,
        default=None,
    )
    goal_radius_m: GoalRadius | None = optional(
        "the goal is reached closer than this: seen from above, if it has no height; by"
        " default that of the policy's card, or 3"
    )
    max_speed_m_s: Annotated[float | None, NOT_IN_GYM] = quantity(
        "horizontal speed limit of all actions; by default the fastest action of the policy's card,"
        " or 5",
        "m/s",
        ge=0.1,
        le=30,
        default=None,
    )
    decisions: DecisionTiming | None = optional(
        "sequential: a decision begins after the hold of the one before; pipelined:"
        " with the newest frame as soon as the one before is ready; by default as the policy's card"
        " says, or sequential"
    )
    compensate: Annotated[bool | None, "latency"] = optional(
        "compensate the latency: state and depth image are carried forward to when the"
        " decision is expected to act, by the vehicle's response to the setpoints in flight; by"
        " default as the policy's card says, or not"
    )
    origin: Annotated[Place | None, NOT_IN_GYM] = optional(
        "start position: latitude, longitude (degrees), altitude above mean sea level (m)."
        " A flight controller without GPS receives it before arming, as Hold requires a position;"
        " by default, in a rehearsal without GPS, the start of all rehearsals"
    )
    watchdog: WatchdogSettings = Field(
        default_factory=WatchdogSettings, description="bounds on silence"
    )
    limits: LimitSettings = Field(
        default_factory=LimitSettings,
        description="limits on telemetry, camera and distance that the companion enforces",
    )
    ablate: AblationName | None = optional(
        "input of the network that is made zero; not at level sitl"
    )


class Lateness(ProfileModel):
    """Decision latency t2, in simulated time."""

    GROUP: ClassVar[str] = "latency"
    computer: Annotated[str, COMMON] = Field(
        default="workstation",
        description="computer profile: a shipped name, or a path to a .toml",
    )
    workload: Annotated[str | None, COMMON] = optional(
        "workload of the computer profile, for its decision latency (t2); estimate:"
        " scaled to this policy; by default what was measured for this very policy, or else what"
        " this machine takes (sitl) or 1 ms (gym, lockstep)"
    )
    latency: Annotated[str | None, COMMON] = optional(
        "decision latency (t2) to inject, in place of the workload's: 150ms, lognormal:396ms,20ms"
        " (mean, standard deviation), COMPUTER/WORKLOAD, or a file with a latency [ms] per line;"
        " also normal:396ms,20ms; a file is replayed in order"
    )
    latency_seed: int = _seed(
        "draws the same latency anew on the same episodes; 0: from the episodes' own seeds", 0
    )


class Workers(ProfileModel):
    """Execution of an experiment's jobs; has no effect on results."""

    GROUP: ClassVar[str] = "execution"
    executor: Annotated[Literal["process", "ray"], FREE] = Field(
        default="process",
        description="executor of the jobs: processes of this machine, or a Ray cluster",
    )
    workers: Annotated[int | None, FREE] = quantity(
        "jobs at a time, each on one core; decides the pace, not the results; by default one for"
        " each core, here or in the cluster (at level gym one; level sitl flies one at a time)",
        "1",
        ge=1,
        le=GREATEST_WORKERS,
        default=None,
    )
    ray_address: Annotated[str, FREE] = Field(
        default="local",
        description="with executor ray: local starts a Ray on this machine, auto takes the one that"
        " runs here, else HOST:PORT of the head of a cluster whose machines all see the folder",
    )
    mixed_code: Annotated[bool, FREE] = switch(
        "continue a folder whose flights have another version of the code; reports list all"
    )


class Flights(Workers):
    """Episodes of a run and their execution."""

    GROUP: ClassVar[str] = "episodes"
    level: Annotated[LevelName, COMMON, "execution"] = Field(
        default="sitl",
        description="fidelity level. gym: the vectorized simulator, some hundred episodes a"
        " second. lockstep: plant, autopilot and MAVSDK in one process on one simulated clock, the"
        " same flight every time, bit by bit. sitl: two processes over UDP, in real time times the"
        " speed",
    )
    episodes: Annotated[int, COMMON] = quantity(
        "number of episodes", "1", ge=1, le=GREATEST_EPISODES, default=3
    )
    seed: Annotated[int, COMMON] = _seed("random seed; episode i uses seed + i for everything")
    arena_seed: Annotated[int | None, "arena"] = _seed(
        "every episode in the arena, and with the goal, of this one seed; by default of its own",
        None,
    )
    zone: Annotated[int | None, "arena"] = quantity(
        "curriculum zone of the arena that every goal is drawn in: 0 is the smallest, around the"
        " start; by default the largest, the whole arena",
        "1",
        ge=0,
        le=GREATEST_ZONE,
        default=None,
    )
    start: StartName = Field(
        default="ground",
        description="ground: the companion arms, takes off and lands; hover: the episode begins in"
        " Hold at the altitude, above the start, and at level lockstep ends at the verdict. Level"
        " gym always begins in a hover",
    )
    time_limit_s: TimeLimit = TIME_LIMIT_S
    speed: Annotated[float | None, FREE, NOT_IN_GYM, "execution"] = quantity(
        "simulated seconds per wall second: level sitl 0.5 to 10 (default 1), level lockstep 0.01"
        " to 1000 (default: as fast as it goes)",
        "1",
        ge=0.01,
        le=1000,
        default=None,
    )
    validity: bool = Field(
        default=True,
        description="level sitl: fly again what the host disturbed, as it is no test of the policy;"
        " without, every flight counts, and the report says so",
    )
    ground_station: bool = switch(
        "level sitl: a ground station may command the vehicle and change parameters; the record"
        " names each message, and the flight stays valid"
    )
    slots: Annotated[int, FREE, "execution"] = quantity(
        "level gym: flights at a time; decides the pace, not the results",
        "1",
        ge=1,
        le=GREATEST_SLOTS,
        default=128,
    )
    tlogs: Annotated[bool, FREE, "output"] = switch(
        "level lockstep: write the logs of every flight (.tlog, .ulg); level sitl always does"
    )


class Scenario(Flights, Lateness, Decisions, Aircraft):
    """Configuration of a rehearsal.

    The fields are flat, except the tables `payload`, `wind`, `spread`, `sensors`, `watchdog`,
    `limits`, `real` and `ports`. `airl_mav.scenario.resolve.resolve` sets fields at None, mostly
    from the policy's card. Raises FieldError if a field is unknown, of the wrong type, or out of
    range.
    """

    policy: PolicyName = DEFAULT_POLICY
    arena: ArenaName = DEFAULT_ARENA

    @model_validator(mode="wrap")
    @classmethod
    def _told_in_one_line(cls, data: Any, handler: ModelWrapValidatorHandler[Scenario]) -> Scenario:
        """Raise a one-line FieldError, as `resolve` does, in place of pydantic's error."""
        try:
            return handler(data)
        except ValidationError as error:
            raise field_error(error, cls) from None

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seed of each episode, by index."""
        return tuple(range(self.seed, self.seed + self.episodes))

    def arena_seed_of(self, seed: int) -> int:
        """Return the arena seed of the episode with this seed."""
        return seed if self.arena_seed is None else self.arena_seed


def free_fields(level: LevelName) -> frozenset[str]:
    """Return the names of the fields without effect on flights at a level."""
    free = {name for name, field in Scenario.model_fields.items() if FREE in field.metadata}
    # At level sitl, the effect of this machine's compute time scales with the speed.
    return frozenset(free - {"speed"} if level == "sitl" else free)


SCENARIO_FILE = "scenario.toml"
"""Scenario file in a run folder."""


def save_scenario(scenario: Scenario, path: Path) -> None:
    """Write a scenario with absolute paths; fields at None are omitted."""
    data = anchored(scenario).model_dump(mode="json", exclude_none=True)
    replace_file(path, tomli_w.dumps(data).encode())


def anchored(scenario: Scenario) -> Scenario:
    """Return a scenario with absolute paths, independent of the working directory."""
    # Late import: reading a command line or a run folder needs no policy.
    from airl_mav.policy.registry import policy_names

    policy, latency = scenario.policy, scenario.latency or ""
    named = {name: getattr(scenario, name) for name in ("vehicle", "arena", "computer")}
    paths = {name: value for name, value in named.items() if value.endswith(".toml")}
    if names_file(policy) or (policy not in policy_names() and Path(policy).is_dir()):
        paths["policy"] = policy
    if ".toml/" in latency or Path(latency).is_file():
        paths["latency"] = latency
    real = {name: value.absolute() for name, value in scenario.real if isinstance(value, Path)}
    changes: dict[str, Any] = {name: f"{Path(value).absolute()}" for name, value in paths.items()}
    return scenario.model_copy(update={**changes, "real": scenario.real.model_copy(update=real)})
