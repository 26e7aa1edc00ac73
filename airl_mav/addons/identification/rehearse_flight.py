"""Rehearsals of a recorded flight: the same policy, goal and latencies in lockstep."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter
from scipy.spatial.transform import Rotation

from airl_mav.addons.identification.files import IDENTIFICATION_FILE, VEHICLE_FILE
from airl_mav.addons.identification.identify import SCHEMA
from airl_mav.addons.recordings.recorded_flight import episode_of, info_of, settings_of
from airl_mav.black_box.mcap_file import BlackBox, read_black_box
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import read_typed, replace_file, write_json
from airl_mav.core.frames import Goal, goal_height_m, quat_yaw
from airl_mav.core.plugins import names_code
from airl_mav.experiments.experiment import rehearse
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import successful
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.arena import ArenaSpec, Size
from airl_mav.profiles.vehicle import WindSettings
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario.model import Decisions, Scenario
from airl_mav.scenario.resolve import resolve

FLOWN, REHEARSED = "flown", "rehearsed"
"""Folders and names of the two runs."""

ARENA_FILE = "arena.toml"
LATENCIES_FILE = "latencies.txt"

CLEAR_M = 30.0
"""Distance from start and goal to the walls of a generated arena [m]. Exceeds the range of all
shipped cameras."""

SAME_GOAL_M = 1.0
"""Maximum distance between the goals of a flight and of its arena [m]."""


@dataclass(frozen=True)
class Changes:
    """Changes to the flight's settings in its rehearsals."""

    vehicle: str | None = None
    wind: WindSettings | None = None
    """Wind in the flight's frame; None = calm."""
    prompt: bool = False
    """True disables injected latency: decisions take as long as on a desktop computer."""


AS_FLOWN = Changes()


@dataclass(frozen=True)
class Rehearsals:
    """Settings of all rehearsals of a flight."""

    arena: str | None = None
    """Arena profile; None = an empty plain, where both paths start at the origin, heading north."""
    arena_seed: int | None = None
    """Seed of the arena; None = the flight's."""
    episodes: int = 20
    policy: str | None = None
    """Policy; None = the flight's."""
    trust: bool = False
    """True permits code that the policy or the arena names."""
    progress: bool = False


USUAL = Rehearsals()


@dataclass(frozen=True)
class Reflight:
    """Result of a flight and its rehearsals."""

    outcome: Outcome
    flown_s: float
    """Flight time from the start of navigation [s]."""
    rehearsals: int
    rehearsed_s: tuple[float, ...]
    """Flight times of the successful rehearsals [s]."""
    apart_m: NDArray[np.float64]
    """Horizontal distances (n,) from the flown path's points to the nearest point of all rehearsals
    [m]."""
    each_apart_m: tuple[float, ...] = ()
    """Median distance for each rehearsed path alone [m]."""

    @property
    def rehearsed_time_s(self) -> float | None:
        """Median flight time of the successful rehearsals [s]; None = no success."""
        return float(np.median(self.rehearsed_s)) if self.rehearsed_s else None

    @property
    def sentences(self) -> tuple[str, ...]:
        """Summary as sentences."""
        times = sorted(self.rehearsed_s)
        reached = f"{len(times)} of {self.rehearsals} rehearsals reached the goal"
        if times:
            reached += f", in {times[0]:.2f} to {times[-1]:.2f} s (median {np.median(times):.2f} s)"
        apart = (
            f"Its path is {np.median(self.apart_m):.2f} m from the nearest rehearsed one (median), "
            f"{self.apart_m.max():.2f} m at most."
        )
        if self.outcome is not Outcome.SUCCESS or not times:
            return f"The flight: {self.outcome.value}; {reached}.", apart
        slower = sum(time >= self.flown_s for time in times)
        place = f"{slower} of them took as long or longer"
        return f"Flown in {self.flown_s:.2f} s; {reached}; {place}.", apart


def rehearse_flight(
    path: Path, out: Path, asked: Rehearsals = USUAL, changes: Changes = AS_FLOWN
) -> Reflight:
    """Rehearse a recorded flight several times, with different sensor noise.

    Discrete decisions amplify centimetres into another path around a tree. Sensor noise therefore
    varies between rehearsals, and the recorded flight is compared with all of them. With the
    flight's arena, its frame is kept. `out` becomes the folder of the run folders `flown` and
    `rehearsed`.

    Raises UsageError for a recording without navigation or with unusable settings, and if `out` is
    not empty.
    """
    box = read_black_box(path)
    episode, info = episode_of(box), info_of(box)
    quality = episode.record.quality
    # Without decisions there is no latency to replay and no path to compare.
    if quality is None or not len(episode.latency["sent_us"]):
        raise UsageError(f"{path}: no decision was recorded; accepted: a flight that navigated")
    # An older result would be mixed with this one: run folders resume.
    if out.exists() and any(out.iterdir()):
        raise FieldError("out", f"{out}", "a new or empty folder: it holds something else")
    out.mkdir(parents=True, exist_ok=True)
    _write_latencies(episode, out / LATENCIES_FILE)
    wind, arena = changes.wind, asked.arena
    if arena is None:
        # The plain's frame is turned to the first heading: the wind turns with it.
        wind = None if wind is None else turned_wind(wind, -_first_yaw(episode))
        episode = from_its_start(episode)
        arena = _plain(episode, out / ARENA_FILE)
    flew = str(box.run["config"].get("policy"))
    # The recording names the policy, so its author would choose the code that runs here.
    if asked.policy is None and names_code(flew) and not asked.trust:
        accepted = "with --trust, or a --policy of yours: it is code that would run on this machine"
        raise FieldError("policy", flew, accepted)
    # The flight's seed draws the same arena as in the flight.
    seed = episode.record.seed if asked.arena_seed is None else asked.arena_seed
    given = {
        "arena": arena,
        "arena_seed": seed,
        "policy": asked.policy or flew,
        "trust": asked.trust,
        "episodes": asked.episodes,
    }
    scenario = _scenario(box, out / LATENCIES_FILE, given | _changed(changes, wind))
    _check_goal(scenario, episode)
    record = replace(
        episode.record, arena=scenario.arena, arena_seed=scenario.arena_seed_of(scenario.seed)
    )
    # Saved before the rehearsals: an interrupted command leaves the flight readable.
    RunFolder.adopt(out / FLOWN, info, episodes=[replace(episode, record=record)])
    run = rehearse(scenario, out=out / REHEARSED, progress=asked.progress)
    flown = _navigated(episode.trajectory, record)
    paths = [
        distances(flown, _navigated(run.trajectories[each.index], each))
        for each in run.episodes
        if each.navigation_us is not None
    ]
    if not paths:
        raise UsageError(f"{run.path}: no rehearsal navigated: {run.episodes[0].reason}")
    return Reflight(
        record.outcome,
        quality.flight_time_s,
        len(run.episodes),
        tuple(each.flight_time_s for each in successful(run.episodes)),
        # Nearest of all rehearsals: discrete decisions choose different sides of an obstacle.
        np.min(paths, axis=0),
        tuple(float(np.median(each)) for each in paths),
    )


def from_its_start(episode: FlownEpisode) -> FlownEpisode:
    """Return a flight moved to start navigation at the origin, heading north; heights stay."""
    path, record = episode.trajectory, episode.record
    # Heights stay: they are above the ground in both frames.
    origin = path.position[_begun(episode)] * (1.0, 1.0, 0.0)
    turn = Rotation.from_euler("z", -_first_yaw(episode))
    north, east, *down = record.goal
    goal = turn.apply(np.array([north, east, 0.0]) - origin)
    attitude = turn * Rotation.from_quat(path.quaternion, scalar_first=True)
    moved = replace(
        path,
        position=turn.apply(path.position - origin),
        velocity=turn.apply(path.velocity),
        quaternion=attitude.as_quat(scalar_first=True),
    )
    turned: Goal = (float(goal[0]), float(goal[1]))
    if down:
        turned = (*turned[:2], down[0])
    return replace(episode, trajectory=moved, record=replace(record, goal=turned))


def turned_wind(wind: WindSettings, angle_rad: float) -> WindSettings:
    """Return a wind with its direction rotated by an angle about down [rad]."""
    north, east = wind.north_m_s, wind.east_m_s
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turned = {"north_m_s": cos * north - sin * east, "east_m_s": sin * north + cos * east}
    return wind.model_copy(update=turned)


def _begun(episode: FlownEpisode) -> int:
    """Return the index of the newest sample at the start of navigation."""
    navigation_us = episode.record.navigation_us or 0
    before = int(np.searchsorted(episode.trajectory.time_us, navigation_us, side="right")) - 1
    # A flight that begins with navigation has no earlier sample.
    return max(before, 0)


def _first_yaw(episode: FlownEpisode) -> float:
    """Return the heading at the start of navigation [rad]."""
    return quat_yaw(episode.trajectory.quaternion[_begun(episode)])


def _changed(changes: Changes, wind: WindSettings | None) -> dict[str, Any]:
    """Return changes as fields of a scenario."""
    late = {"latency": None} if changes.prompt else {}
    aircraft = {} if changes.vehicle is None else {"vehicle": changes.vehicle}
    return {**late, **aircraft, **({} if wind is None else {"wind": wind})}


def distances(flown: Trajectory, rehearsed: Trajectory) -> NDArray[np.float64]:
    """Return the horizontal distances (n,) of a path's points from the nearest of another [m]."""
    between = flown.position[:, None, :2] - rehearsed.position[None, :, :2]
    return np.asarray(np.linalg.norm(between, axis=2).min(axis=1), np.float64)


def _navigated(path: Trajectory, record: Any) -> Trajectory:
    return path.between(record.navigation_us, record.ended_us)


def _write_latencies(episode: FlownEpisode, path: Path) -> None:
    """Write the latencies of all decisions in the format of `--latency FILE`."""
    t2_us = episode.latency["action_ready_us"] - episode.latency["infer_start_us"]
    lines = [f"{value / US_PER_MS:.3f}\n" for value in t2_us]
    replace_file(path, "".join(lines).encode())


def _plain(episode: FlownEpisode, path: Path) -> str:
    """Write the profile of an empty arena around a flight, and return its path."""
    # Start and goal must be inside even if the flight ended early.
    here = np.vstack([episode.trajectory.position[:, :2], [0.0, 0.0], episode.record.goal[:2]])
    low, high = here.min(axis=0) - CLEAR_M, here.max(axis=0) + CLEAR_M
    (north, east), (start_north, start_east) = high - low, -low
    goal_north, goal_east = episode.record.goal[:2]
    goal_up = goal_height_m(episode.record.goal)
    profile: dict[str, Any] = {
        "description": "an empty plain",
        # One zone over the diagonal: a plain has no obstacles to grade.
        "zones_m": [float(max(np.hypot(north, east), 1.0))],
        "size": {"north_m": float(north), "east_m": float(east)},
        "start": {"north_m": float(start_north), "east_m": float(start_east)},
        "goal": {"north_m": goal_north, "east_m": goal_east},
        "static": {"count": [0, 0]},
    }
    if goal_up is not None:
        profile["goal"] |= {"height_m": goal_up}
        # The walls must reach the goal, or the profile is rejected.
        profile["size"] |= {"height_m": max(Size().height_m, goal_up)}
    try:
        ArenaSpec.model_validate(profile)
    except ValueError:
        raise UsageError(
            f"a flight over {north - 2 * CLEAR_M:.0f} x {east - 2 * CLEAR_M:.0f} m; accepted: "
            f"at most {500 - 2 * CLEAR_M:.0f} m each way"
        ) from None
    replace_file(path, tomli_w.dumps(profile).encode())
    return str(path)


def _scenario(box: BlackBox, latencies: Path, given: dict[str, Any]) -> Scenario:
    """Return the scenario of a flight's rehearsals: the companion's settings, at level lockstep."""
    asked = box.run["config"]
    names = (*Decisions.model_fields, "vehicle", "policy", "seed")
    # Recordings of other programs may lack settings: defaults apply.
    kept = {name: asked[name] for name in names if name in asked}
    how = {
        "level": "lockstep",
        "latency": str(latencies),
        "time_limit_s": settings_of(box).limits.flight_s,
    }
    return validated(Scenario, {**kept, **how, **given}, box.path)


def _check_goal(scenario: Scenario, episode: FlownEpisode) -> None:
    resolved = resolve(scenario)
    # Paths in different frames have no meaningful distance.
    goal = resolved.arena_of(scenario.seed).goal
    flown = episode.record.goal
    if math.hypot(goal[0] - flown[0], goal[1] - flown[1]) > SAME_GOAL_M:
        raise FieldError(
            "arena",
            scenario.arena,
            f"one with the goal of the flight, {flown[0]:.1f} m north and {flown[1]:.1f} m east of"
            f" the start, not {goal[0]:.1f} and {goal[1]:.1f}",
        )


PARTS_FOLDER, PARTS_FILE = "parts", "parts.json"
"""Folder of the rehearsals with one part each, and file of their results."""

NOTHING, LATENCY, VEHICLE, WIND, ALL = "nothing", "latency", "vehicle", "wind", "all"
"""Parts of an identification in a rehearsal; `nothing`: profile, calm air, no injected latency."""

PARTS_SCHEMA = 1


@dataclass(frozen=True)
class _Wind:
    """Wind in `identification.json`."""

    north_m_s: Annotated[float, Field(ge=-50, le=50)]
    east_m_s: Annotated[float, Field(ge=-50, le=50)]


@dataclass(frozen=True)
class _Identification:
    """Fields of `identification.json` that rehearsals need."""

    vehicle: str
    wind: _Wind | None


@dataclass(frozen=True)
class PartFlown:
    """Rehearsals with a part of an identification, compared with the flight."""

    part: str
    rehearsals: int
    reached: int
    time_s: float | None
    """Median time of the successful rehearsals [s]; None = no success."""
    time_share: float | None
    """Difference from the flight's time, as a share of the flight's time; None = no success."""
    apart_m: float
    """Median distance of the flown path from a rehearsed path [m], median of the rehearsals."""


def changes_of(folder: Path) -> Changes:
    """Return the changes by an identification. Raises UsageError if the folder has none."""
    told = _read(folder)
    wind = None if told.wind is None else WindSettings(**vars(told.wind))
    return Changes(vehicle=str(folder / VEHICLE_FILE), wind=wind)


def rehearse_flight_parts(
    path: Path, out: Path, folder: Path, asked: Rehearsals = USUAL
) -> tuple[Reflight, tuple[PartFlown, ...]]:
    """Rehearse a recorded flight with all identified values, each part, and none, on equal seeds.

    The change made by one part alone is the contribution of that part. Contributions need not add
    up. `out` gets `parts` beside the folders of `rehearse_flight`.
    """
    everything, base = changes_of(folder), _read(folder).vehicle
    # Baseline: the profile before the identification, calm air, no injected latency.
    nothing = Changes(vehicle=base, prompt=True)
    parts = {
        NOTHING: nothing,
        LATENCY: replace(nothing, prompt=False),
        VEHICLE: replace(nothing, vehicle=everything.vehicle),
        WIND: replace(nothing, wind=everything.wind),
    }

    # All values first: an error in its settings shows before the parts are flown.
    whole = rehearse_flight(path, out, asked, everything)
    found = [
        _figures(part, rehearse_flight(path, out / PARTS_FOLDER / part, asked, changes))
        for part, changes in parts.items()
    ]
    figures = (*found, _figures(ALL, whole))
    data = {
        "schema": PARTS_SCHEMA,
        "flown_s": whole.flown_s,
        "parts": [vars(each) for each in figures],
    }
    write_json(out / PARTS_FILE, data)
    return whole, figures


def _read(folder: Path) -> _Identification:
    told = read_typed(
        folder / IDENTIFICATION_FILE,
        TypeAdapter(_Identification),
        SCHEMA,
        "identification of a flight",
    )
    if not (folder / VEHICLE_FILE).is_file():
        raise UsageError(f"{folder}: accepted: a folder of airl identify, with {VEHICLE_FILE}")
    return told


def _figures(part: str, flown: Reflight) -> PartFlown:
    time_s = flown.rehearsed_time_s
    return PartFlown(
        part=part,
        rehearsals=flown.rehearsals,
        reached=len(flown.rehearsed_s),
        time_s=time_s,
        # Relative, so that parts of short and long flights compare.
        time_share=None if time_s is None else (time_s - flown.flown_s) / flown.flown_s,
        apart_m=float(np.median(flown.each_apart_m)),
    )
