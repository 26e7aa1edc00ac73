"""Policy whose decisions are timed: an existing one, or a random network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from airl_mav.addons.profiling.request import ProfileRequest
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import validated
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.card import PolicyCard, PolicyFacts, vehicle_mismatch
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch
from airl_mav.policy.registry import find_policy
from airl_mav.policy.template import write_template
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
    with TemporaryDirectory(prefix="airl-profile-") as scratch:
        if request.network is not None:
            layers, filters = (int(size) for size in request.network.split("x"))
            vehicle = _write_random_network(request, layers, filters, vehicles, Path(scratch))
            name = scratch
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
