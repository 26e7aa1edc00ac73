"""From what `airl gap` was asked for to the evaluations that it compares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from airl_mav.cli.cells import Cell
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.gap_command import (
    DEFAULT_MITIGATED,
    DEFAULT_WORKLOAD,
    NOT_MITIGATED,
    GapCommand,
)
from airl_mav.core.errors import UsageError
from airl_mav.envs.spec import Delay
from airl_mav.policy.card import PolicyCard
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import explain
from airl_mav.report.comparison.gap import Role

TRAINING_LATENCY_SEED = 1
"""The latencies of the training's conditions are other draws than those of the target: with the
same ones the mitigated policy would be compared with itself."""


@dataclass(frozen=True)
class Place:
    """A computer with its latency."""

    name: str
    """For people and folders: the computer, or the latency where that was given."""
    computer: str
    workload: str | None
    latency: str | None = None

    def on(self, base: EvaluateCommand) -> EvaluateCommand:
        """Return an evaluation as flown there."""
        return replace(base, computer=self.computer, workload=self.workload, latency=self.latency)


@dataclass(frozen=True)
class PlannedCell:
    """An evaluation, and what it is in the tables."""

    role: Role
    arena: str
    title: str
    """Without the arena."""
    cell: Cell


@dataclass(frozen=True)
class GapPlan:
    """Everything that is flown, in the order of the tables."""

    policy: PolicyInfo
    mitigated: PolicyInfo | None
    target: Place
    reference: Place
    cells: tuple[PlannedCell, ...]
    facts: dict[str, Any]
    remarks: tuple[str, ...]
    """What a person should know before it flies."""


def plan_gap(command: GapCommand) -> GapPlan:
    """Say what is flown.

    Raises:
        UsageError: A policy, a computer, a workload or an arena cannot be used.
    """
    policy = find_policy(command.policy)
    mitigated = _mitigated(command.mitigated)
    if mitigated is not None and mitigated.name == policy.name:
        raise UsageError(
            f"--mitigated {command.mitigated}: the same name as --policy; accepted: another policy,"
            f" or {NOT_MITIGATED}"
        )
    names = [Path(arena).stem for arena in command.arena]
    if not names or len(set(names)) < len(names):
        raise UsageError(f"--arena {' '.join(names)}: accepted: one or more, each once")
    target, reference = _target(command), _reference(command)
    training, remarks = _training(mitigated, target)
    base = EvaluateCommand(
        (command.policy,),
        episodes=command.episodes,
        seed=command.seed,
        level=command.level,
        vehicle=command.vehicle,
        workers=command.workers,
        speed=command.speed,
        ports=command.ports,
    )
    return GapPlan(
        policy=policy,
        mitigated=mitigated,
        target=target,
        reference=reference,
        cells=tuple(
            planned
            for arena in command.arena
            for planned in _cells(
                replace(base, arena=(arena,)),
                policy.name,
                None if mitigated is None else (mitigated.name, command.mitigated),
                (reference, target, training),
            )
        ),
        facts={
            "policy": policy.name,
            "mitigated": None if mitigated is None else mitigated.name,
            "computer": target.computer,
            "workload": target.workload,
            "latency": target.latency,
            "reference": reference.computer,
            "reference_workload": reference.workload,
            "level": command.level,
            "vehicle": command.vehicle,
            "episodes": command.episodes,
            "seed": command.seed,
            "remarks": list(remarks),
        },
        remarks=remarks,
    )


def _mitigated(name: str) -> PolicyInfo | None:
    """Return the mitigated policy; None: not asked for."""
    if name == NOT_MITIGATED:
        return None
    try:
        return find_policy(name)
    except UsageError as error:
        if name != DEFAULT_MITIGATED or "no such policy" not in f"{error}":
            raise
        raise UsageError(
            f"--mitigated {name}: not among the shipped policies; accepted: the folder of a policy "
            f"that was trained with --computer and --workload, or {NOT_MITIGATED}"
        ) from None


def _target(command: GapCommand) -> Place:
    """Return the onboard computer as it is flown."""
    if command.latency is None:
        workload = DEFAULT_WORKLOAD if command.workload is None else command.workload
        return Place(Path(command.computer).stem, command.computer, workload)
    if command.workload is not None:
        raise UsageError(
            f"--latency {command.latency} with --workload {command.workload}: accepted: one of them"
        )
    return Place(command.latency, command.computer, None, command.latency)


def _reference(command: GapCommand) -> Place:
    """Return the computer that the gap is measured from."""
    workload = command.reference_workload
    if workload is None and command.latency is None:
        same = DEFAULT_WORKLOAD if command.workload is None else command.workload
        workload = same if same in load_computer(command.reference).workloads else None
    return Place(Path(command.reference).stem, command.reference, workload)


def _training(
    mitigated: PolicyInfo | None, target: Place
) -> tuple[tuple[Place, ...], tuple[str, ...]]:
    """Return the conditions that a policy was trained in, one a source of latency, and remarks.

    The computer is the target's: it decides what its watts cost, and nothing else.
    """
    if mitigated is None:
        return (), ()
    environment = None if mitigated.card is None else training_environment(mitigated.card)
    if environment is None:
        return (), (
            f"{mitigated.name} does not say how late its decisions were in training: it is not "
            "compared with that.",
        )
    delay = environment.get("delay", {})
    try:
        found = Delay.model_validate(delay)
    except ValidationError as error:
        raise UsageError(f"{mitigated.name}: environment.delay: {explain(error, Delay)}") from None
    remarks: tuple[str, ...] = ()
    extra = environment.get("randomisation", {}).get("extra_delay_ms", (0.0, 0.0))
    if any(extra):
        remarks = (
            f"{mitigated.name} was trained with {extra[0]:g} to {extra[1]:g} ms on top of that: "
            "not in its column.",
        )
    if found.latency:
        sources = found.latency
    elif found.workload is None:
        sources = (f"{found.native_ms:g}ms",) if found.native_ms else ()
    elif found.workload in load_computer(found.computer).workloads:
        sources = (f"{found.computer}/{found.workload}",)
    else:  # An estimate: it needs the policy beside the computer.
        return (Place("training", found.computer, found.workload),), remarks
    return tuple(Place(source, target.computer, None, source) for source in sources), remarks


def training_environment(card: PolicyCard) -> Mapping[str, Any] | None:
    """Return the environment that a policy was trained in; None: its card does not say."""
    environment = card.training.config.get("environment")
    return environment if isinstance(environment, Mapping) else None


def _cells(
    base: EvaluateCommand,
    policy: str,
    mitigated: tuple[str, str] | None,
    places: tuple[Place, Place, tuple[Place, ...]],
) -> list[PlannedCell]:
    """Return the evaluations of one arena."""
    (arena,) = base.arena
    reference, target, training = places
    short = Path(arena).stem

    def planned(role: Role, title: str, command: EvaluateCommand, number: int = 1) -> PlannedCell:
        key = f"{short}-{role}" if number == 1 else f"{short}-{role}-{number}"
        return PlannedCell(role, arena, title, Cell(key, f"{title}, {short}", command))

    def at(place: Place) -> str:
        return f"on {place.name}" if place.latency is None else f"at {Path(place.name).name}"

    cells = [
        planned("reference", f"{policy} {at(reference)}", reference.on(base)),
        planned("target", f"{policy} {at(target)}", target.on(base)),
    ]
    if mitigated is None:
        return cells
    name, path = mitigated
    other = replace(base, policies=(path,))
    cells.append(planned("mitigated", f"{name} {at(target)}", target.on(other)))
    as_trained = replace(other, latency_seed=TRAINING_LATENCY_SEED)
    cells += [
        planned("training", f"{name} as trained{_of(place, training)}", place.on(as_trained), i)
        for i, place in enumerate(training, start=1)
    ]
    cells.append(planned("mitigated-reference", f"{name} {at(reference)}", reference.on(other)))
    return cells


def _of(place: Place, training: tuple[Place, ...]) -> str:
    """Return which of several conditions of a training it is."""
    return f" ({place.name})" if len(training) > 1 else ""
