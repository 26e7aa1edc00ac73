"""`airl roofline`: maximum safe speed against reaction rate, with the points of computers."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from rich.console import Console

from airl_mav.addons.roofline.page import (
    LeftOut,
    Roofline,
    RooflinePoint,
    noticed_m,
    roofline_document,
    roofline_point,
)
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, quantity, validated
from airl_mav.core.files import write_json
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.envs.stopping import DecisionLoop, StoppingTask
from airl_mav.experiments.hardware_gap import DEFAULT_WORKLOAD
from airl_mav.latency.injection import ESTIMATE, Injection, choose_injection
from airl_mav.policy.card import vehicle_mismatch
from airl_mav.policy.registry import PolicyInfo, find_policy, load_learned
from airl_mav.profiles.computer import ComputerProfile, load_computer
from airl_mav.profiles.vehicle import Payload, VehicleProfile, load_vehicle, loaded
from airl_mav.report.document import Document, print_document, print_place, write_document
from airl_mav.scenario import aircraft, model

SCHEMA = 1

RESULT_FILE = "roofline.json"

OWN_WORKLOAD = "policy"
"""Workload name for measurements of the policy itself."""


class RooflineRequest(ProfileModel):
    """Vehicle, sensing, policy and candidate computers of a roofline."""

    computers: tuple[str, ...] = Field(
        default=(model.ONBOARD_COMPUTER, model.REFERENCE_COMPUTER),
        description="computer profiles: shipped names, or paths to .toml",
    )
    workload: str = Field(
        default=DEFAULT_WORKLOAD,
        description="workload of these profiles that defines the latency t2; policy: the one"
        " measured there with this policy (airl profile)",
    )
    policy: str = Field(
        # The first decision of `generalist` ignores 30 of 75 boxes: no sensing distance.
        default="static-obstacles-fast",
        description="policy whose hold is flown, and whose sensing distance is measured: a name, or"
        " a path to a folder with policy.onnx and card.json",
    )
    vehicle: aircraft.VehicleName = aircraft.DEFAULT_VEHICLE
    payload: Payload = Field(default_factory=Payload, description="payload")
    sensing_distance_m: float | None = quantity(
        "depth at which an obstacle is taken notice of, from the camera to its surface; by default"
        " the least at which this policy changes its action for a box in its way",
        "m",
        gt=0,
        le=1000,
        default=None,
    )
    hold_s: float | None = quantity(
        "t3: how long an action is held before the next observation; by default that of the"
        " policy's card, or 0.5",
        "s",
        ge=0,
        le=10,
        default=None,
    )
    knee_share: float = quantity(
        "share of the roof at which the knee lies", "1", gt=0, lt=1, default=0.9
    )
    draws: int = quantity("flights at each speed that is tried", "1", ge=1, le=100_000, default=300)
    seed: int = quantity("of the latencies drawn", "1", ge=0, le=2**31, default=1)


@dataclass(frozen=True)
class RooflineResult:
    """Result of `roofline`."""

    found: Roofline
    document: Document
    page: Path
    """Path of roofline.html, in a folder with roofline.json, roofline.md and roofline.png."""


def roofline(
    request: RooflineRequest | None = None, *, out: Path | str | None = None, **knobs: Any
) -> RooflineResult:
    """Compute and fly the roofline of a vehicle.

    Args:
        request: Roofline settings; None = built from `knobs`.
        out: Folder; None = `runs/<UTC time>-roofline-<vehicle>`.
        knobs: Fields of the request.

    Raises:
        UsageError: Invalid input, no computer has the latency, or the folder is not writable.
            `FieldError`s name the field.
    """
    request = request or validated(RooflineRequest, knobs)
    stem = Path(request.vehicle).stem
    folder = Path(out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-roofline-{stem}")
    found = find_roofline(request)
    made = provenance(shlex.join(["airl", *sys.argv[1:]]))
    document = roofline_document(found, made)
    page = write_document(document, folder)
    write_json(folder / RESULT_FILE, {"schema": SCHEMA, **found.model_dump(), **made})
    return RooflineResult(found, document, page)


def find_roofline(request: RooflineRequest) -> Roofline:
    """Compute and fly a roofline without writing files; see `roofline`. Raises UsageError."""
    if request.workload == ESTIMATE:
        raise FieldError("workload", ESTIMATE, f"a measured workload, or {OWN_WORKLOAD}")
    if len(set(request.computers)) < len(request.computers) or not request.computers:
        raise FieldError("computers", " ".join(request.computers), "one or more, each once")
    policy = find_policy(request.policy)
    if policy.commands != "velocity":
        raise FieldError(
            "policy", request.policy, "one that commands velocities, whose fastest is looked for"
        )
    bare = load_vehicle(request.vehicle)
    noticed = () if request.sensing_distance_m is not None else _noticed(policy, bare, request)
    distance_m = request.sensing_distance_m or min(noticed)
    hold_s = request.hold_s
    if hold_s is None:
        hold_s = model.PilotSettings().hold_s if policy.card is None else policy.card.hold_s
    loop = DecisionLoop.of(bare, hold_s)
    points: list[RooflinePoint] = []
    left_out: list[LeftOut] = []
    for name in request.computers:
        computer = load_computer(name)
        injection = _measured(computer, request.workload, policy)
        if isinstance(injection, str):
            left_out.append(LeftOut(computer=name, why=injection))
            continue
        point = roofline_point(
            Path(name).stem,
            computer,
            StoppingTask(loaded(bare, computer, request.payload), loop, distance_m),
            injection,
            request,
        )
        points.append(point)
    if not points:
        told = "; ".join(f"{each.computer}: {each.why}" for each in left_out)
        raise FieldError("computers", " ".join(request.computers), problem=told)
    same = {"vehicle", "workload", "knee_share", "draws", "seed"}
    return Roofline(
        policy=policy.name,
        sensing_distance_m=distance_m,
        noticed_m=noticed,
        frame_rate_hz=bare.camera.rate_hz,
        hold_s=hold_s,
        points=tuple(points),
        left_out=tuple(left_out),
        **request.model_dump(include=same),
    )


def _noticed(
    policy: PolicyInfo, vehicle: VehicleProfile, request: RooflineRequest
) -> tuple[float, ...]:
    """Return the depths at which the policy reacts [m]. Raises UsageError if not measurable."""
    if policy.card is None or policy.folder is None:
        raise FieldError(
            "sensing_distance_m", problem=f"needed: policy {policy.name} is no network"
        )
    if policy.card.observation.kind != "depth":
        kind = policy.card.observation.kind
        raise FieldError("sensing_distance_m", problem=f"needed: policy {policy.name} sees {kind}")
    if policy.card.observation.cameras:
        problem = f"needed: policy {policy.name} sees by further cameras"
        raise FieldError("sensing_distance_m", problem=problem)
    if (reason := vehicle_mismatch(policy.card, vehicle.camera, vehicle.cameras)) is not None:
        raise FieldError("policy", request.policy, problem=f"does not fit the vehicle: {reason}")
    depths = noticed_m(load_learned(policy.folder, policy.card), vehicle)
    if not depths.min() > 0.0:
        raise FieldError(
            "sensing_distance_m",
            problem=f"needed: {policy.name} takes no notice of {np.sum(depths <= 0.0)} of "
            f"{len(depths)} boxes in its way",
        )
    return tuple(float(each) for each in depths)


def _measured(computer: ComputerProfile, workload: str, policy: PolicyInfo) -> Injection | str:
    """Return the latency of a computer, or the reason why it is missing."""
    if workload == OWN_WORKLOAD:
        found = choose_injection(computer, policy_sha256=policy.sha256)
        if found.latency is None:
            return f"no latency measured for {policy.name} (airl profile measures it there)"
        return found
    try:
        return choose_injection(computer, workload)
    except UsageError:
        known = ", ".join(computer.workloads) or "none"
        return f"no workload {workload} measured (measured: {known})"


class RooflineOptions(RooflineRequest):
    """The F-1 roofline: safe velocity against reaction time, for a vehicle and its computers.

    The vehicle carries and powers each computer. The results show the closed-form limit, the limit
    from the vehicle's measured braking, and the flown speed.

    Examples:
        airl roofline
        airl roofline --policy static-obstacles-ras-pi-4 --sensing-distance-m 8
        airl roofline --policy MINE --computers my-pi.toml my-jetson.toml --workload policy
    """

    out: Path | None = Field(
        default=None,
        description="folder of roofline.json, roofline.html and roofline.png; by default"
        " runs/<UTC time>-roofline-<vehicle>",
    )


OPTIONS = RooflineOptions


def run(options: RooflineOptions, console: Console | None = None) -> int:
    """Compute, fly and show the roofline; return 0. Raises UsageError as `roofline` does."""
    asked = {name: getattr(options, name) for name in RooflineRequest.model_fields}
    result = roofline(RooflineRequest(**asked), out=options.out)
    console = console or new_console()
    print_document(result.document, console)
    print_place(result.document.name, result.page, console)
    return 0
