"""What `airl profile` measures, and everything that can be wrong with it before it starts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.common import GREATEST_SEED, check_installed, check_ports, check_range
from airl_mav.cli.companion_command import GREATEST_THREADS
from airl_mav.cli.profile_command import ProfileCommand
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.provenance import describe_machine
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.card import PolicyCard, PolicyFacts, vehicle_mismatch
from airl_mav.policy.layouts import LayoutName, ObservationSpec, camera_mismatch
from airl_mav.policy.registry import find_policy
from airl_mav.policy.template import write_template
from airl_mav.profiles.computer import ComputerProfile, Network, existing_profile
from airl_mav.profiles.loading import list_profiles
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.model import DEFAULT_POLICY, PilotSettings

FLOWN_HOLD_S = 0.05
"""t3 while stages are measured in flight [s]: 1,000 decisions are over in less than two minutes."""

PAPER_IMAGE = (256, 154)
"""Image of the paper's networks, width x height [px]; its layout has a strip of 10 rows on top."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
RUNTIME_PACKAGES = {"onnx": ("ONNX Runtime", "onnxruntime"), "torch": ("torch", "torch")}


@dataclass(frozen=True)
class ProfilePlan:
    """What is measured, and where it goes."""

    command: ProfileCommand
    folder: Path
    """Where policy.onnx and card.json lie."""
    policy: str
    """As `--policy` takes it."""
    card: PolicyCard
    template: tuple[int, int] | None
    """Layers and filters of a random network."""
    vehicle: str
    """Name or path of the vehicle profile."""
    camera: Intrinsics
    label: str
    workload: str
    path: Path
    """Of the computer profile."""
    existing: ComputerProfile | None
    cpu: str

    @property
    def hold_s(self) -> float:
        """t3 while stages are measured in flight [s]."""
        return FLOWN_HOLD_S if self.command.hold is None else self.command.hold

    @property
    def runtime(self) -> str:
        """What runs the network, with its version and threads."""
        name, package = RUNTIME_PACKAGES[self.command.runtime]
        threads = self.command.threads
        return f"{name} {version(package)}, {threads} thread{'s' if threads > 1 else ''}"

    @property
    def network(self) -> Network:
        """The network, as a computer profile describes it."""
        layers, filters = self.template or (None, None)
        spec = self.card.observation
        return Network(
            layers=layers,
            filters=filters,
            image_height_px=spec.height_px,
            image_width_px=spec.width_px,
            parameters=self.card.parameters,
            macs=self.card.macs,
            runtime=self.runtime,
        )


@dataclass(frozen=True)
class Measured:
    """What was measured; the warm-up is left out."""

    flights: tuple[dict[str, NDArray[np.int64]], ...]
    """Stamps [µs] by column, one a decision, of each flight (bare: of the one run)."""
    seen: str | None
    """Stamp at which what a decision rests on was seen; None: no command was flown."""
    load_us: int
    """Opening the network [µs]."""
    first_us: int
    """The first decision ever [µs]."""
    remarks: tuple[str, ...] = ()
    """How it was measured, and what was not."""


@contextmanager
def planned(command: ProfileCommand) -> Iterator[ProfilePlan]:
    """Check everything and give the plan; a random network lives as long as it is needed.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    check_range("--decisions", command.decisions, 10, 100_000)
    check_range("--warm-up", command.warm_up, 1, 10_000)
    check_range("--threads", command.threads, 1, GREATEST_THREADS)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    for option, value, low, high in (
        ("--hold", command.hold, 0.0, 1.0),
        ("--watts", command.watts, 0.0, 10_000.0),
        ("--price", command.price, 0.0, 1_000_000.0),
    ):
        if value is not None:
            check_range(option, value, low, high)
    for option, name in (("--on", command.on), ("--workload", command.workload)):
        if name is not None and not NAME.fullmatch(name):
            raise UsageError(f"{option} {name!r}: accepted: letters, digits, '.', '_', '-'")
    if command.policy is not None and command.network is not None:
        raise UsageError(f"--network {command.network} with a policy: accepted: one of them")
    if command.level == "sitl":
        check_installed("sim")
        check_ports(command.ports, free=False)
    with TemporaryDirectory(prefix="airl-profile-") as scratch:
        yield _plan(command, Path(scratch))


def _plan(command: ProfileCommand, scratch: Path) -> ProfilePlan:
    machine = describe_machine()
    cpu = f"{machine['cores']} x {machine['cpu']}"
    label = command.on or _slug(str(machine["cpu"]))
    path = command.out / f"{label}.toml"
    # Before anything is measured: what cannot be written is better found now.
    existing = existing_profile(path, cpu)
    if command.network is not None:
        template = _template(command)
        card, vehicle = _random_network(command, template, scratch)
        policy, folder, name = str(scratch), scratch, card.name
    else:
        template, policy = None, command.policy or DEFAULT_POLICY
        info = find_policy(policy)
        if info.card is None or info.folder is None:
            raise UsageError(f"POLICY {policy}: has no network; accepted: a learned policy")
        card, folder, name = info.card, info.folder, info.name
        vehicle = _vehicle_for(card, command.vehicle)
    parts = [name, command.level]
    parts += [command.runtime] if command.runtime != "onnx" else []
    parts += [f"{command.threads}threads"] if command.threads > 1 else []
    return ProfilePlan(
        command=command,
        folder=folder,
        policy=policy,
        card=card,
        template=template,
        vehicle=vehicle,
        camera=Intrinsics.of(load_vehicle(vehicle).camera),
        label=label,
        workload=command.workload or "-".join(parts),
        path=path,
        existing=existing,
        cpu=cpu,
    )


def _slug(text: str) -> str:
    """Return a processor's name as the name of a file."""
    words = re.sub(r"\((?:r|tm|c)\)", "", text.lower())
    return re.sub(r"[^a-z0-9]+", "-", words).strip("-")[:48].strip("-") or "computer"


def _template(command: ProfileCommand) -> tuple[int, int]:
    """Return layers and filters of --network. Raises UsageError."""
    size = re.fullmatch(r"(\d{1,2})x(\d{1,3})", command.network or "")
    if size is None or not (1 <= int(size[1]) <= 20 and 1 <= int(size[2]) <= 256):
        raise UsageError(
            f"--network {command.network}: accepted: LAYERSxFILTERS, 1..20 x 1..256, as 5x32"
        )
    if command.runtime != "onnx":
        raise UsageError(f"--runtime {command.runtime} with --network: accepted: onnx")
    check_installed("profile")
    return int(size[1]), int(size[2])


def _random_network(
    command: ProfileCommand, template: tuple[int, int], folder: Path
) -> tuple[PolicyCard, str]:
    """Write a random network and its card; return the card and the vehicle that it fits.

    Raises:
        UsageError: The image is none, or no vehicle's camera has it.
    """
    image = re.fullmatch(r"(\d{1,4})x(\d{1,4})", command.image)
    if image is None:
        raise UsageError(f"--image {command.image}: accepted: WIDTHxHEIGHT in px, as 256x154")
    width, height = int(image[1]), int(image[2])
    layout: LayoutName = "paper" if (width, height) == PAPER_IMAGE else "body"
    names = list_profiles("vehicles") if command.vehicle is None else [command.vehicle]
    vehicles = {name: load_vehicle(name) for name in sorted(names, key=len)}
    refused = ""
    for name, vehicle in vehicles.items():
        spec = _observation(command.image, layout, width, height, vehicle)
        reason = camera_mismatch(spec, Intrinsics.of(vehicle.camera))
        # Alone, nothing is seen through a camera: any will do.
        if reason is None or (command.level == "bare" and name == list(vehicles)[-1]):
            break
        refused = reason
    else:
        raise UsageError(
            f"--image {command.image}: vehicle {list(vehicles)[-1]}: {refused} (or --level bare)"
        )
    layers, filters = template
    suffix = "" if (width, height) == PAPER_IMAGE else f"-{width}x{height}"
    facts = PolicyFacts(
        name=f"template-{layers}x{filters}{suffix}",
        description="the paper's template with random weights: it flies nowhere, it takes its time",
        observation=spec,
        hold_s=PilotSettings.hold_s,
        goal_radius_m=GOAL_RADIUS_M,
        altitude_m=PilotSettings.altitude_m,
    )
    rng = np.random.default_rng(command.seed)
    return write_template(folder, layers, filters, facts, rng), name


def _observation(
    option: str, layout: LayoutName, width: int, height: int, vehicle: VehicleProfile
) -> ObservationSpec:
    fields = {
        "layout": layout,
        "width_px": width,
        "height_px": height,
        "horizontal_fov_deg": vehicle.camera.horizontal_fov_deg,
        "range_m": vehicle.camera.range_m,
    }
    return validated(ObservationSpec, fields, f"--image {option}")


def _vehicle_for(card: PolicyCard, asked: str | None) -> str:
    """Return the vehicle whose camera serves a policy. Raises UsageError when none does."""
    names = sorted(list_profiles("vehicles"), key=len) if asked is None else [asked]
    reason: str | None = None
    for name in names:
        reason = vehicle_mismatch(card, load_vehicle(name).camera)
        if reason is None:
            return name
    raise UsageError(f"--vehicle {names[-1]}: {reason}")
