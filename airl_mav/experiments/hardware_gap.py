"""Hardware gap: a policy on a workstation and on an onboard computer, also with mitigation.

The verdict is a sequential test of its success rate there, or of its gap (`flight.requirements`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import subfolder
from airl_mav.core.progress import Progress
from airl_mav.envs.spec import Delay
from airl_mav.experiments import experiment
from airl_mav.experiments.campaign import Cell
from airl_mav.experiments.executors import Executor
from airl_mav.experiments.live import Ended, FlownRun
from airl_mav.flight.requirements import LOOKS, Requirement, all_decided
from airl_mav.flight.statistics import pair_by_seed, reached_goals
from airl_mav.policy.card import PolicyCard
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import RUN_FILE, check_folder, load_info
from airl_mav.report.comparison.comparison_model import FLOWN_UNTIL, Comparison, comparison_file
from airl_mav.report.run_verdict import OverallVerdict
from airl_mav.scenario.model import REFERENCE_COMPUTER, Scenario
from airl_mav.scenario.resolve import resolve

if TYPE_CHECKING:
    from airl_mav.report.comparison import show

DEFAULT_UNMITIGATED, DEFAULT_MITIGATED = "static-obstacles", "static-obstacles-ras-pi-4"
"""Shipped policies with equal training except for latency: a workstation's, and the paper's
Raspberry Pi's."""

DEFAULT_WORKLOAD = "template-5x32"
"""The paper's network for No Obstacles and for its mitigation: 396 ms on the Raspberry Pi."""

NOT_MITIGATED = "none"
"""Name that disables the mitigated policy."""

TRAINING_LATENCY_SEED = 1
"""Seed of the latencies of training conditions. It differs from the target's seed: with equal
latencies the mitigated policy would be compared with itself."""


LATENCY_ALONE = "latency-alone"
"""Role of the policy with the target's latency, but on the reference computer."""

COMPENSATED, PIPELINED, BOTH = "compensated", "compensated-pipelined", "mitigated-compensated"

COMPENSATION: dict[str, dict[str, Any]] = {
    COMPENSATED: {"compensate": True},
    PIPELINED: {"compensate": True, "decisions": "pipelined"},
    BOTH: {"compensate": True},
}
"""Runs with latency compensation in flight: scenario fields by role."""

COMPENSATION_TITLES = {
    COMPENSATED: "compensated",
    PIPELINED: "compensated, pipelined",
    BOTH: "compensated",
}


@dataclass(frozen=True)
class ComputerConditions:
    """Computer and its latency."""

    name: str
    """Name in labels and folders: the computer, or the latency if it was given."""
    computer: str
    workload: str | None
    latency: str | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """Scenario fields of the conditions."""
        return {"computer": self.computer, "workload": self.workload, "latency": self.latency}

    @property
    def label(self) -> str:
        """Label in a title."""
        return f"on {self.name}" if self.latency is None else f"at {Path(self.name).name}"


def hardware_gap(
    scenario: Scenario,
    *,
    mitigated: str = DEFAULT_MITIGATED,
    reference: str = REFERENCE_COMPUTER,
    reference_workload: str | None = None,
    arenas: Sequence[str] = (),
    out: Path | str | None = None,
    progress: bool = False,
) -> experiment.ExperimentResult:
    """Measure a policy's loss on an onboard computer, with and without mitigation.

    All runs use the same seeds. The policy flies on the reference, with the onboard computer's
    latency alone, and on the whole onboard computer: with its mass and power. There it flies also
    with latency compensation and with pipelined decisions. A policy trained with that
    latency flies there, compensated, under its training conditions, and on the reference. Raises as
    `evaluate`.

    Args:
        scenario: Policy, onboard computer with workload or latency (default: the paper's network on
            its Raspberry Pi 4), and flight settings.
        mitigated: Name or folder of the mitigated policy, or `none`.
        reference: Reference computer profile.
        reference_workload: Workload of the reference; None = the target's if the reference has it,
            otherwise the measurement of the same policy.
        arenas: Arena profiles, with a table each; empty = the scenario's arena.
        out: Folder to create or resume; None = `runs/<UTC time>-hardware-gap-...`.
        progress: Draw progress bars on standard error.
    """
    declared = declare_hardware_gap(
        scenario,
        mitigated=mitigated,
        reference=reference,
        reference_workload=reference_workload,
        arenas=arenas,
    )
    return experiment.run_and_compare(declared, out, progress=progress)


def declare_hardware_gap(
    scenario: Scenario,
    *,
    mitigated: str = DEFAULT_MITIGATED,
    reference: str = REFERENCE_COMPUTER,
    reference_workload: str | None = None,
    arenas: Sequence[str] = (),
) -> experiment.Experiment:
    """Declare a hardware gap; see `hardware_gap`. Raises UsageError."""
    policy = find_policy(scenario.policy, trust=scenario.trust)
    other = _mitigated(mitigated, trust=scenario.trust)
    if other is not None and other.name == policy.name:
        raise FieldError("mitigated", mitigated, f"another policy, or {NOT_MITIGATED}")
    arenas = list(arenas) or [scenario.arena]
    names = [Path(arena).stem for arena in arenas]
    if len(set(names)) < len(names):
        raise FieldError("arena", " ".join(names), "each arena once")
    if scenario.compensate:
        raise FieldError(
            "compensate", True, "left out: a gap is flown with compensation and without"
        )
    target = _target(scenario)
    undelayed = _reference(reference, reference_workload, target)
    training, remarks = _training(other, target)
    ways, more = _ways_of_compensation(scenario, policy)
    remarks += more
    alone, more = _latency_alone(target, undelayed)
    remarks += more
    planned = [
        ("reference", "reference", policy, undelayed),
        ("target", "target", policy, target),
        *((LATENCY_ALONE, LATENCY_ALONE, policy, place) for place in alone),
        *((role, role, policy, target) for role in ways),
    ]
    if other is not None:
        planned.append(("mitigated", "mitigated", other, target))
        if ways:
            planned.append((BOTH, BOTH, other, target))
        for number, place in enumerate(training, start=1):
            name = "training" if number == 1 else f"training-{number}"
            planned.append((name, "training", other, place))
        planned.append(("mitigated-reference", "mitigated-reference", other, undelayed))
    cells = []
    for arena, short in zip(arenas, names, strict=True):
        for name, role, who, place in planned:
            flown: dict[str, Any] = {"arena": arena, **place.fields}
            label = f"{who.name} {place.label}"
            if who is other:
                flown["policy"] = mitigated
            if role == "training":
                flown["latency_seed"] = TRAINING_LATENCY_SEED
                label = f"{who.name} as trained"
                label += f" ({place.name})" if len(training) > 1 else ""
            if role in COMPENSATION:
                flown |= COMPENSATION[role]
                label += f", {COMPENSATION_TITLES[role]}"
            asked = scenario.model_copy(update=flown)
            title = f"{label}, {short}"
            cells.append(
                experiment.make_cell(
                    f"{short}-{name}", title, asked, label=label, role=role, group=arena
                )
            )
    facts = {
        "policy": policy.name,
        "mitigated": None if other is None else other.name,
        "computer": target.computer,
        "workload": target.workload,
        "latency": target.latency,
        "reference": undelayed.computer,
        "reference_workload": undelayed.workload,
        "level": scenario.level,
        "vehicle": scenario.vehicle,
        "episodes": scenario.episodes,
        "seed": scenario.seed,
        "remarks": list(remarks),
    }
    return experiment.Experiment(
        "hardware-gap", f"{policy.name}-{target.name}", facts, tuple(cells), remarks
    )


def _ways_of_compensation(
    scenario: Scenario, policy: PolicyInfo
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the roles of the policy's compensated runs on the target, and remarks."""
    if scenario.compensate is not None:
        return (), ()
    if policy.commands != "velocity":
        told = f"{policy.name} commands {policy.commands.replace('_', ' ')}: not compensated."
        return (), (told,)
    if load_vehicle(scenario.vehicle).response is None:
        return (), (f"The response of vehicle {scenario.vehicle} is not known: not compensated.",)
    if not load_vehicle(scenario.vehicle).compensable:
        return (), (f"Vehicle {scenario.vehicle} has a camera without depth: not compensated.",)
    on_card = None if policy.card is None else policy.card.hover_after_s
    if (scenario.watchdog.hover_after_s, on_card) != (None, None):
        told = f"{policy.name} hovers after its hold: its decisions are not pipelined."
        return (COMPENSATED,), (told,)
    return (COMPENSATED, PIPELINED), ()


def _mitigated(name: str, *, trust: bool = False) -> PolicyInfo | None:
    """Return the mitigated policy; None = disabled. Raises UsageError."""
    if name == NOT_MITIGATED:
        return None
    try:
        return find_policy(name, trust=trust)
    except UsageError as error:
        if name != DEFAULT_MITIGATED or "no such policy" not in f"{error}":
            raise
        raise FieldError(
            "mitigated",
            name,
            "the folder of a policy that was trained with the computer and workload, or "
            f"{NOT_MITIGATED}: it is not among the shipped policies",
        ) from None


def _target(scenario: Scenario) -> ComputerConditions:
    """Return the onboard computer with its latency."""
    if scenario.latency is None:
        workload = DEFAULT_WORKLOAD if scenario.workload is None else scenario.workload
        return ComputerConditions(Path(scenario.computer).stem, scenario.computer, workload)
    if scenario.workload is not None:
        raise FieldError("latency", scenario.latency, "without a workload")
    return ComputerConditions(scenario.latency, scenario.computer, None, scenario.latency)


def _latency_alone(
    target: ComputerConditions, reference: ComputerConditions
) -> tuple[tuple[ComputerConditions, ...], tuple[str, ...]]:
    """Return the target's latency on the reference computer, and remarks."""
    board = load_computer(target.computer)
    if not board.onboard_mass_kg and not board.onboard_watts:
        if target.latency is None:
            return (), ()
        return (), ("The latency is flown alone. To add mass and power, name a computer.",)
    source = target.latency or f"{target.computer}/{target.workload}"
    if target.latency is None and target.workload not in board.workloads:
        return (), (f"The latency of {source} is an estimate: not flown alone.",)
    name = f"{Path(source).name} alone"
    return (ComputerConditions(name, reference.computer, None, source),), ()


def _reference(
    computer: str, workload: str | None, target: ComputerConditions
) -> ComputerConditions:
    """Return the reference computer with its workload."""
    if workload is None and target.workload in load_computer(computer).workloads:
        workload = target.workload
    return ComputerConditions(Path(computer).stem, computer, workload)


def _training(
    mitigated: PolicyInfo | None, target: ComputerConditions
) -> tuple[tuple[ComputerConditions, ...], tuple[str, ...]]:
    """Return a policy's training conditions per latency source, and remarks."""
    if mitigated is None:
        return (), ()
    environment = None if mitigated.card is None else training_environment(mitigated.card)
    if environment is None:
        return (), (
            f"{mitigated.name} does not say how late its decisions were in training: it is not "
            "compared with that.",
        )
    found = validated(Delay, environment.get("delay", {}), f"{mitigated.name}: environment.delay")
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
    else:  # An estimate needs the policy and the computer.
        return (ComputerConditions("training", found.computer, found.workload),), remarks
    return tuple(ComputerConditions(s, target.computer, None, s) for s in sources), remarks


def training_environment(card: PolicyCard) -> Mapping[str, Any] | None:
    """Return the training environment of a policy; None = not on its card."""
    environment = card.training.config.get("environment")
    return environment if isinstance(environment, Mapping) else None


@dataclass(frozen=True)
class SoughtVerdict:
    """Result of a sequential test."""

    path: Path
    """Folder with a run folder for the onboard computer and one for the reference."""
    ended: Ended
    verdict: OverallVerdict | None = None
    """Verdict; None = the test was interrupted or ended with an error."""
    comparison: Comparison | None = None
    runs: show.Runs | None = None


def seek_verdict(
    scenario: Scenario,
    requirements: Sequence[Requirement],
    *,
    reference: str,
    reference_workload: str | None = None,
    against: str | None = None,
    out: Path | None = None,
    progress: Progress,
) -> SoughtVerdict:
    """Fly a policy on its onboard computer until the tests are decided, then the reference.

    The reference is the same policy on the reference computer, or another policy `against` which it
    is compared on the same computer. A required gap of the success rate is tested while both fly.
    """
    sequential = [each for each in requirements if each.least_rate or each.rate_gap]
    if not sequential:
        raise FieldError(
            "require",
            accepted="at least one least success rate, or gap of it: 'success >= 95 %'"
            " or 'success gap >= -2 points'",
        )
    # Rejects a success rate that no number of flights shows.
    all_decided(requirements, ())
    if against is None:
        declared = declare_hardware_gap(
            scenario,
            mitigated=NOT_MITIGATED,
            reference=reference,
            reference_workload=reference_workload,
        )
    else:
        declared = _declare_rivals(scenario, against)
    both_fly = any(each.rate_gap for each in sequential)
    cells = {cell.role: cell for cell in declared.cells}
    target, undelayed = cells["target"], cells["reference"]
    out = (
        out
        or Path("runs")
        / f"{utc_now():%Y%m%dT%H%M%SZ}-verdict-{experiment.file_name(declared.name)}"
    )
    check_folder(out, comparison_file(out, declared.kind).name)
    for warning in experiment.known_seeds((target, undelayed)):
        progress.note(warning, "yellow")
    with experiment.workers_of(scenario) as executor:
        fly = partial(_fly, out=out, progress=progress, executor=executor)
        for n in _looks(scenario.episodes, _planned(out / target.name)):
            flown, rival = fly(target, n), None
            if both_fly and flown.ended == "complete":
                rival = fly(undelayed, n)
            if (last := rival or flown).ended != "complete":
                return SoughtVerdict(out, last.ended)
            reached = reached_goals(flown.episodes)
            pairs = () if rival is None else pair_by_seed(rival.episodes, flown.episodes)
            # Flights that remain invalid prevent a verdict; further flights do not help.
            missing = len(reached) < n or (both_fly and len(pairs) < n)
            if missing or all_decided(requirements, reached, pairs):
                break
        flown = fly(undelayed, max(n, _planned(out / undelayed.name)))
    if flown.ended != "complete":
        return SoughtVerdict(out, flown.ended)
    # Imported here: flights do not need the figures.
    from airl_mav.report.comparison import show

    facts = {
        **declared.facts,
        "episodes": n,
        FLOWN_UNTIL: f"decided: {', '.join(map(str, sequential))}",
    }
    # The last interim analysis sets the planned number, which the run folder contains.
    entries = [
        replace(experiment.entry_of(cell, cell.name), planned=None) for cell in (undelayed, target)
    ]
    comparison, runs = show.build_comparison(out, declared.kind, facts, entries)
    verdict = show.judge_comparison(comparison, runs, requirements)
    return SoughtVerdict(out, "complete", verdict, comparison, runs)


def _declare_rivals(scenario: Scenario, against: str) -> experiment.Experiment:
    """Declare a comparison of two policies on the same computer and seeds."""
    target = _target(scenario)
    policies = {
        "reference": (against, find_policy(against, trust=scenario.trust)),
        "target": (scenario.policy, find_policy(scenario.policy, trust=scenario.trust)),
    }
    names = {role: found.name for role, (_, found) in policies.items()}
    if names["reference"] == names["target"]:
        raise FieldError("against", against, "another policy")
    cells = []
    for role, (policy, _) in policies.items():
        label = f"{names[role]} {target.label}"
        asked = scenario.model_copy(update={"policy": policy, **target.fields})
        cells.append(experiment.make_cell(role, label, asked, label=label, role=role))
    facts = {"policy": names["target"], "against": names["reference"]}
    return experiment.Experiment("compare", " against ".join(facts.values()), facts, tuple(cells))


def _fly(
    cell: Cell, n: int, *, out: Path, progress: Progress, executor: Executor | None
) -> FlownRun:
    """Fly the missing episodes among the first n of a cell."""
    asked = cell.scenario.scenario.model_copy(update={"episodes": n})
    run = subfolder(out, cell.name)
    return experiment.fly_scenario(resolve(asked), run, progress, executor=executor)


def _planned(run: Path) -> int:
    """Return the planned number of episodes of a run folder; 0 = no run."""
    return len(load_info(run).seeds) if (run / RUN_FILE).exists() else 0


def _looks(most: int, planned: int) -> list[int]:
    """Return the flight counts of interim analyses; FieldError if `most` is below the first."""
    if most < LOOKS[0]:
        raise FieldError("episodes", most, f"value >= {LOOKS[0]}, the first look")
    return [look for look in LOOKS if planned <= look <= max(most, planned)] or [planned]
