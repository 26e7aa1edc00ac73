"""Policy under test, existing or random, and its decisions without a flight."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.profiling.measurement import ProfileRequest, Recording
from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import WallClock, processor_time_us
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import validated
from airl_mav.core.files import scratch_folder
from airl_mav.core.progress import Bar
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.actions import flyable
from airl_mav.policy.card import PolicyCard, PolicyFacts, vehicle_mismatch
from airl_mav.policy.card_writing import write_template
from airl_mav.policy.observation import Kinematics, encode
from airl_mav.policy.observation_spec import ObservationSpec, SeenCamera, camera_mismatch
from airl_mav.policy.registry import LearnedPolicy, find_policy, open_network
from airl_mav.profiles.computer import Network
from airl_mav.profiles.loading import list_profiles
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.model import DEFAULT_POLICY, PilotSettings

PAPER_IMAGE = "256x154"
"""Image of the paper's networks, width x height [px]; its layout has a strip of 10 rows on top."""

RUNTIME_PACKAGES = {"onnx": ("ONNX Runtime", "onnxruntime"), "torch": ("torch", "torch")}


@dataclass(frozen=True)
class PolicyUnderTest:
    """Learned policy, and a vehicle whose camera fits the policy."""

    name: str
    """Name of a built-in policy, or path of its folder, as in `Scenario.policy`."""
    folder: Path
    """Folder of policy.onnx and card.json."""
    card: PolicyCard
    network: Network
    """Network description for the computer profile."""
    vehicle: str
    """Name or path of the vehicle profile."""
    camera: Intrinsics


@contextmanager
def open_policy(request: ProfileRequest) -> Iterator[PolicyUnderTest]:
    """Open the policy under test; a random network's files exist only in the context."""
    if request.policy is not None and request.network is not None:
        raise FieldError("network", request.network, "either a policy or a network, not both")
    names = [request.vehicle] if request.vehicle else sorted(list_profiles("vehicles"), key=len)
    vehicles = {name: load_vehicle(name) for name in names}
    layers = filters = vehicle = None
    name = request.policy or DEFAULT_POLICY
    with scratch_folder("airl-profile-") as scratch:
        if request.network is not None:
            layers, filters = (int(size) for size in request.network.split("x"))
            vehicle = _write_random_network(request, layers, filters, vehicles, scratch)
            name = f"{scratch}"
        info = find_policy(name, trust=request.trust)
        if info.card is None or info.folder is None:
            raise FieldError("policy", name, "a learned policy; this one has no network")
        vehicle = vehicle or _vehicle_for(info.card, vehicles)
        runtime, package = RUNTIME_PACKAGES[request.runtime]
        threads = f"{request.threads} thread{'s' if request.threads > 1 else ''}"
        yield PolicyUnderTest(
            name=name,
            folder=info.folder,
            card=info.card,
            network=Network(
                layers=layers,
                filters=filters,
                image_height_px=info.card.observation.height_px,
                image_width_px=info.card.observation.width_px,
                parameters=info.card.parameters,
                macs=info.card.macs,
                runtime=f"{runtime} {version(package)}, {threads}",
            ),
            vehicle=vehicle,
            camera=Intrinsics.of(vehicles[vehicle].camera),
        )


def _vehicle_for(card: PolicyCard, vehicles: dict[str, VehicleProfile]) -> str:
    """Return the first vehicle whose camera fits a policy. Raises FieldError without one."""
    for name, vehicle in vehicles.items():
        reason = vehicle_mismatch(card, vehicle.camera, vehicle.cameras)
        if reason is None:
            return name
    raise FieldError("vehicle", name, problem=reason or "")


def _write_random_network(
    request: ProfileRequest,
    layers: int,
    filters: int,
    vehicles: dict[str, VehicleProfile],
    folder: Path,
) -> str:
    """Write a random network and its card; return the first vehicle whose camera fits it."""
    if request.runtime != "onnx":
        raise FieldError("runtime", request.runtime, "onnx with a random network")
    paper = request.image == PAPER_IMAGE
    width_px, height_px = (int(size) for size in request.image.split("x"))
    tried = []
    for vehicle in vehicles:
        camera = vehicles[vehicle].camera
        fields = {
            "layout": "paper" if paper else "body",
            "width_px": width_px,
            "height_px": height_px,
            "projection": camera.projection,
            "horizontal_fov_deg": camera.horizontal_fov_deg,
            "distortion": camera.distortion,
            "range_m": camera.range_m,
        }
        try:
            spec = validated(ObservationSpec, fields)
        except FieldError as error:
            raise FieldError("image", request.image, problem=error.line(sign=" = ")) from None
        tried.append((vehicle, spec, camera_mismatch(spec, Intrinsics.of(camera))))
    # At level bare the observations are synthetic: any camera will do.
    vehicle, spec, mismatch = next((each for each in tried if each[2] is None), tried[0])
    if mismatch is not None and request.level != "bare":
        problem = f"vehicle {vehicle}: {mismatch} (or level bare)"
        raise FieldError("image", request.image, problem=problem)
    facts = PolicyFacts(
        name=f"template-{layers}x{filters}" + ("" if paper else f"-{request.image}"),
        description="the paper's template with random weights: for timing, not for flying",
        observation=spec,
        hold_s=PilotSettings.hold_s,
        goal_radius_m=GOAL_RADIUS_M,
        altitude_m=PilotSettings.altitude_m,
    )
    write_template(folder, layers, filters, facts, np.random.default_rng(request.seed))
    return vehicle


OBSERVATIONS = 64
"""Number of different observations, used in turn to avoid cache hits."""

GOAL = 20.0, 5.0
"""North, east [m]."""

OBSERVATION_STREAM, ACTION_STREAM = 11, 12
"""Second words of the seed."""

COLD_DECISIONS = 20
"""Number of decisions used to plan a flight's duration."""


class BareLoop:
    """Decisions without a flight: the pilot's work between its two stamps of t2."""

    def __init__(self, request: ProfileRequest, policy: PolicyUnderTest) -> None:
        """Open the network. Raises UsageError if it cannot be run."""
        self.clock = WallClock()
        start_us = self.clock.time_us()
        network = open_network(
            policy.folder, policy.card, request.runtime, request.threads, trust=request.trust
        )
        self.load_us = self.clock.time_us() - start_us
        """Load time of the network [µs]."""
        rng = np.random.default_rng((request.seed, ACTION_STREAM))
        self._policy = LearnedPolicy(policy.card, network, rng=rng)
        self._max_speed_m_s = policy.card.actions.max_speed_m_s
        self._observations = itertools.cycle(random_observations(request, policy))

    def decide(self) -> tuple[int, int]:
        """Make a decision; return its start and end [µs]."""
        frame, state = next(self._observations)
        start_us = self.clock.time_us()
        action = self._policy.act(encode(frame, state, GOAL))
        flyable(action, self._policy.commands, self._max_speed_m_s)
        return start_us, self.clock.time_us()


def measure(request: ProfileRequest, policy: PolicyUnderTest, bar: Bar) -> Recording:
    """Time the policy's decisions, counted by `bar` with warm-up; UsageError if it cannot run."""
    loop = BareLoop(request, policy)
    stamps = []
    used_us = processor_time_us()
    for count in range(request.warm_up + request.decisions + 1):
        stamps.append(loop.decide())
        bar.update(completed=count)
    used_us = processor_time_us() - used_us
    starts, ends = np.array(stamps, np.int64).T
    cores = used_us / max(ends[-1] - starts[0], 1)
    measured = slice(1 + request.warm_up, None)
    threads = f"{request.threads} thread{'s' if request.threads > 1 else ''}"
    return Recording(
        flights=({"infer_start_us": starts[measured], "action_ready_us": ends[measured]},),
        exposure=None,
        load_us=loop.load_us,
        first_us=int(ends[0] - starts[0]),
        remarks=(
            "inference alone, one decision straight after the other: no camera and no telemetry "
            "ran beside it, which may slow it down (--level sitl, --level hil)",
            f"this process used {cores:.2g} cores of processor time with {threads}: less than one "
            "means that it had to wait",
        ),
    )


def cold_start(request: ProfileRequest, policy: PolicyUnderTest) -> tuple[int, int, int]:
    """Return the durations of loading, the first and a typical later decision [µs]."""
    loop = BareLoop(request, policy)
    stamps = [loop.decide() for _ in range(COLD_DECISIONS)]
    first_us, *later_us = (end_us - start_us for start_us, end_us in stamps)
    return loop.load_us, first_us, round(float(np.median(later_us)))


def random_observations(
    request: ProfileRequest, policy: PolicyUnderTest
) -> list[tuple[Frame, Kinematics]]:
    """Return noise images, as large as the camera's, and states of a level vehicle."""
    spec, lens = policy.card.observation, policy.camera
    if camera_mismatch(spec, lens) is not None:
        lens = _lens_for(spec)
    rng = np.random.default_rng((request.seed, OBSERVATION_STREAM))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    others = {name: _lens_for(seen) for name, seen in spec.cameras.items()}

    def noise(lens: Intrinsics) -> NDArray[Any]:
        return rng.integers(0, 20_000 if lens.kind == "depth" else 256, lens.shape, lens.dtype)

    def frame(k: int) -> Frame:
        main = noise(lens)
        further = {name: FurtherImage(noise(each), each) for name, each in others.items()}
        return Frame(k, 0, main, lens, further=further)

    return [
        (
            frame(k),
            Kinematics(rng.normal(0.0, 5.0, 3), rng.normal(0.0, 2.0, 3), level, np.zeros(3)),
        )
        for k in range(OBSERVATIONS)
    ]


def _lens_for(seen: ObservationSpec | SeenCamera) -> Intrinsics:
    """Return a camera whose images match the network's input size."""
    fov = math.radians(seen.horizontal_fov_deg)
    size = seen.width_px, seen.camera_rows
    return Intrinsics.from_fov(*size, fov, seen.projection, seen.kind, seen.distortion)
