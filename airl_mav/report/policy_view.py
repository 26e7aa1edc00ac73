"""Inputs and choices of a policy, recomputed for each decision of a recording.

Images are rendered from the true pose without noise. Telemetry is the recorded estimate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import RANGE_M, Mount, camera_pose, expose
from airl_mav.core import constants, errors, files, frames, plugins
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory, pose_at
from airl_mav.latency.stamps import NO_STAMP, SETPOINT, setpoint_column
from airl_mav.policy import observation, observation_spec, registry
from airl_mav.policy.actions import commands, discrete_actions
from airl_mav.prediction import Compensator, DecisionMemory
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo

ONE = np.zeros(1, np.intp)

SAME_ACTION = 0.01
"""Tolerance for equal commands [m/s, rad/s]."""

MOST = 2000
"""Maximum number of recomputed decisions, from the start of a flight."""


@dataclass(frozen=True)
class PolicyCamera:
    """Camera of the policy."""

    intrinsics: Intrinsics
    range_m: float
    """Maximum depth with a return [m]; for a colour camera, larger than any arena."""
    mount: Mount

    @classmethod
    def of(cls, camera: Camera) -> PolicyCamera:
        """Create the policy camera from a profile's camera."""
        range_m = camera.range_m if camera.kind == "depth" else RANGE_M
        return cls(Intrinsics.of(camera), range_m, Mount.of(camera))

    @property
    def half_angle_rad(self) -> float:
        """Half of the horizontal field of view [rad]."""
        return 0.5 * self.intrinsics.horizontal_fov_rad

    def aside_rad(self, bearing_rad: float) -> float:
        """Return the horizontal angle [rad] from the optical axis to a bearing from the heading."""
        return abs(math.remainder(bearing_rad - self.mount.yaw, math.tau))


@dataclass(frozen=True)
class SeenDecision:
    """Recomputed decision."""

    number: int
    """Row in `latency.npz`."""
    image: NDArray[Any]
    """Input image of the policy, as in `camera.frame.Frame`."""
    scores: NDArray[np.float32] | None
    """Network outputs (k,), one per discrete action; None if unavailable."""
    again: bool | None
    """True if the action with the best score was flown; None without scores."""


@dataclass(frozen=True)
class PolicyAgain:
    """Policy of a run, loaded for recomputing its decisions."""

    policy: registry.LearnedPolicy
    actions: NDArray[np.float64]
    """Commands (k, 3) of the actions: forward, right [m/s], yaw rate [rad/s]. 3D action sets have
    (k, 4) with the downward speed [m/s] last."""

    @property
    def scores_are(self) -> str:
        """Name of the network's outputs."""
        return "Q-value" if "dqn" in self.policy.card.algorithm else "score"


def policy_again(info: RunInfo) -> PolicyAgain | None:
    """Return a run's policy if it has discrete actions, no code, and its file is unchanged."""
    name, digest = info.config.get("policy"), info.config.get("policy_sha256")
    if not isinstance(name, str) or digest is None or plugins.names_code(name):
        return None
    try:
        known = registry.find_policy(name)
        if known.folder is None or known.card is None or known.sha256 != digest:
            return None
        count = discrete_actions(known.card.actions)
        if count is None:
            return None
        policy = registry.load_learned(known.folder, known.card, ablate=info.config.get("ablate"))
        table = commands(known.card.actions, np.arange(count))
    except errors.UsageError:
        return None
    return PolicyAgain(policy, table)


def seen_decisions(
    run: LoadedRun,
    record: EpisodeRecord,
    arena: Arena,
    vehicle: VehicleProfile,
    again: PolicyAgain | None = None,
) -> Iterator[SeenDecision]:
    """Yield the decisions of a flight until its outcome; scores need the policy in `again`."""
    path, stamps = run.trajectories.get(record.index), run.latency.get(record.index, {})
    column = setpoint_column(stamps) or SETPOINT
    needed = ("capture_us", "infer_start_us", "action_ready_us", "sent_us", column)
    if path is None or not len(path) or any(name not in stamps for name in needed):
        return
    lens = PathCamera(arena, PolicyCamera.of(vehicle.camera), path, record.started_us)
    # Only the cameras of the network's input are rendered.
    names = () if again is None else again.policy.card.observation.cameras
    further = {
        name: _Further(PathCamera(arena, PolicyCamera.of(camera), path, record.started_us))
        for name, camera in vehicle.cameras.items()
        if name in names
    }
    pilot, watchdog = run.info.config.get("pilot", {}), run.info.config.get("watchdog", {})
    companion = _Companion(vehicle, lens.camera, compensates=bool(pilot.get("compensate")))
    hover_s, lasts_s = watchdog.get("hover_after_s"), pilot.get("hold_s", 0.0)
    policy = None if again is None else again.policy.with_generator(np.random.default_rng(0))
    for number in range(min(MOST, len(stamps["sent_us"]))):
        captured, began, ready, sent = (int(stamps[name][number]) for name in needed[:4])
        if NO_STAMP in (captured, began, ready, sent) or sent > record.ended_us:
            continue
        image, state = lens.image(captured), _telemetry(stamps, path, began)
        views = {name: each.view(captured) for name, each in further.items()}
        seen = companion.observe(image, state, record.goal, began - captured, began, views)
        setpoint = np.asarray(stamps[column][number], np.float64)
        scores = same = None
        if again is not None and policy is not None:
            scores = policy.outputs(policy.encode(seen.rows(None)))[0]
            best = again.actions[int(np.argmax(scores))]
            flown = setpoint[[0, 1, 3, 2]][: len(best)]
            same = bool(np.abs(best - flown).max() < SAME_ACTION)
        yield SeenDecision(number, seen.image, scores, same)
        stops = None if hover_s is None else sent + round((lasts_s + hover_s) * constants.US_PER_S)
        companion.decided(setpoint, ready - began, sent, stops)


@dataclass(frozen=True)
class PathCamera:
    """Camera along a recorded path."""

    arena: Arena
    camera: PolicyCamera
    path: Trajectory
    started_us: int

    def image(self, time_us: int) -> NDArray[Any]:
        """Return the camera image at a time."""
        position, _, quaternion = pose_at(self.path, time_us)
        eye, attitude = camera_pose(position, quaternion, self.camera.mount)
        centers = self.arena.centers_at(time_us - self.started_us)
        lens, range_m = self.camera.intrinsics, self.camera.range_m
        return expose(self.arena, centers, lens, range_m, eye, attitude)


class _Further:
    """Additional camera along a recorded path, with its images of earlier decisions."""

    def __init__(self, lens: PathCamera) -> None:
        self._lens = lens
        self._earlier: deque[NDArray[Any]] = deque(maxlen=observation_spec.MOST_FRAMES - 1)

    def view(self, time_us: int) -> observation.CameraView:
        """Return a decision's view with the image of a time; store the image for later ones."""
        image, earlier = self._lens.image(time_us), tuple(self._earlier)
        self._earlier.appendleft(image)
        return observation.CameraView(image, self._lens.camera.intrinsics, earlier)


class _Companion:
    """State of a companion between decisions, as in `companion.pilot`."""

    def __init__(self, vehicle: VehicleProfile, camera: PolicyCamera, *, compensates: bool) -> None:
        self._intrinsics = camera.intrinsics
        self._compensator = None
        if compensates and vehicle.compensable:
            self._compensator = Compensator(1, vehicle, camera.intrinsics)
            self._compensator.begin(0)
            self._memory = self._compensator.memory
        else:
            self._memory = DecisionMemory(1)
            self._memory.begin(0)
        self._earlier: observation.Earlier = ()

    def observe(
        self,
        image: NDArray[Any],
        state: observation.Kinematics,
        goal: frames.Goal,
        age_us: int,
        now_us: int,
        further: Mapping[str, observation.CameraView],
    ) -> observation.Observation:
        """Return the policy's observation: current, or predicted for the time of sending."""
        age = np.array([age_us])
        if self._compensator is not None:
            images, states = self._compensator.foresee(
                ONE, image[None], age, np.array([now_us]), state.rows(None)
            )
            image, state = images[0], states.rows(0)
        told = self._memory.in_flight(age).rows(0)
        earlier = self._earlier
        self._earlier = ((image, state), *earlier)[: observation_spec.MOST_FRAMES - 1]
        where = np.asarray(goal, np.float64)
        return observation.observe(image, self._intrinsics, state, where, told, earlier, further)

    def decided(
        self, setpoint: NDArray[np.float64], t2_us: int, sent_us: int, stops_us: int | None
    ) -> None:
        """Store a sent setpoint."""
        command, t2 = setpoint[None], np.array([t2_us])
        if self._compensator is None:
            self._memory.decided(ONE, command, t2)
            return
        stops = None if stops_us is None else np.array([stops_us])
        self._compensator.decided(ONE, command, t2, np.array([sent_us]), stops)


def _telemetry(stamps: files.Arrays, path: Trajectory, time_us: int) -> observation.Kinematics:
    """Return the newest estimate at a time, or the true state without recorded estimates."""
    if not len(stamps.get("estimate/time_us", ())):
        return observation.Kinematics(*pose_at(path, time_us))
    at = max(0, int(np.searchsorted(stamps["estimate/time_us"], time_us, side="right")) - 1)
    return observation.Kinematics(
        *(stamps[f"estimate/{name}"][at] for name in ("position", "velocity", "quaternion"))
    )
