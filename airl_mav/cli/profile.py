"""`airl profile`: how long this computer takes for a policy's decisions."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from airl_mav.cli.common import EXIT_BROKEN, EXIT_INTERRUPTED
from airl_mav.cli.profile_command import ProfileCommand
from airl_mav.cli.profile_plan import Measured, ProfilePlan, planned
from airl_mav.cli.profile_report import print_measured, say, stages_of
from airl_mav.core.clock import utc_now
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file, save_arrays
from airl_mav.core.machine import MachineState, machine_state
from airl_mav.core.provenance import describe_machine, package_versions
from airl_mav.latency.percentiles import summarize
from airl_mav.profiles.computer import (
    ComputerProfile,
    Latency,
    Workload,
    with_workload,
    write_profile,
    write_samples,
)
from companion.interfaces import LinkError

SCHEMA = 1
"""Version of the .json beside the samples."""

BUSY_SHARE = 0.25
"""Load average over one minute, a usable core, above which a machine is not idle."""

NO_WATTS = "watts: not measured"
NO_PRICE = "price: not known"


def run(command: ProfileCommand, console: Console | None = None) -> int:
    """Measure, say what came out, and write it down.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 measured, 1 it broke off, 130 Ctrl-C; only with 0 is anything written.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    try:
        with planned(command) as plan:
            return _profile(plan, console)
    except KeyboardInterrupt:
        say(console, "interrupted: nothing was written; the same command starts over", "yellow")
        return EXIT_INTERRUPTED


def _profile(plan: ProfilePlan, console: Console) -> int:
    command = plan.command
    say(console, f"profile    {plan.card.name} at level {command.level}, {plan.runtime}")
    say(console, f"network    {plan.card.network}")
    before = machine_state()
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    ) as bar:
        task = bar.add_task("decisions", total=command.warm_up + command.decisions)
        try:
            measured = _level(command)(plan, lambda count: bar.update(task, completed=count))
        except (LinkError, RuntimeError) as error:
            bar.stop()
            say(console, f"error: {error}; nothing was written", "red")
            return EXIT_BROKEN
    states = before, machine_state()
    machine = describe_machine()
    if remark := busy_remark(before, int(machine["cores_usable"])):
        measured = replace(measured, remarks=(*measured.remarks, remark))
    print_measured(plan, measured, states, machine, console)
    for path in _write(plan, measured, states, machine):
        say(console, f"written    {path}")
    name = plan.card.name if plan.template else plan.policy
    flown = "POLICY" if plan.template else shlex.quote(name)
    say(
        console,
        f"fly as it  airl evaluate {flown} --computer {shlex.quote(str(plan.path))} "
        f"--workload {plan.workload}",
    )
    return 0


def busy_remark(before: MachineState, cores: int) -> str | None:
    """Return a warning when others used the processor as it began; None when they did not."""
    if before.load is None or before.load[0] <= BUSY_SHARE * cores:
        return None
    return (
        f"the machine was busy with something else: load average {before.load[0]:.2f} on {cores} "
        "usable cores at the start; measure again when it is idle"
    )


def _level(command: ProfileCommand) -> Callable[[ProfilePlan, Callable[[int], None]], Measured]:
    """Return what measures at a level. Imported late: only sitl needs the simulator."""
    if command.level == "bare":
        from airl_mav.cli import profile_bare

        return profile_bare.measure
    if command.level == "hil":
        from airl_mav.cli import profile_hil

        return profile_hil.measure
    from airl_mav.cli import profile_sitl
    from airl_mav.rehearsal.rehearsal import RehearsalError

    def measure(plan: ProfilePlan, progress: Callable[[int], None]) -> Measured:
        try:
            return profile_sitl.measure(plan, progress)
        except RehearsalError as error:
            raise RuntimeError(str(error)) from error

    return measure


def _write(
    plan: ProfilePlan,
    measured: Measured,
    states: tuple[MachineState, MachineState],
    machine: Mapping[str, Any],
) -> tuple[Path, ...]:
    """Write samples, stamps, facts, and last of all the profile that names them.

    Raises:
        UsageError: The folder cannot be written to.
    """
    command, stages = plan.command, stages_of(measured)
    stem = f"{plan.label}.{plan.workload}"
    samples_file, arrays, facts = (
        plan.path.with_name(f"{stem}{suffix}") for suffix in (".txt", ".npz", ".json")
    )
    date = f"{utc_now():%Y-%m-%d}"
    source = (
        f"airl profile --level {command.level}, {len(stages['t2'])} decisions after "
        f"{command.warm_up} of warm-up, {date}"
    )
    # A clock of µs may give 0 for what is faster.
    t2_ms = np.maximum(stages["t2"], 1) / US_PER_MS
    workload = Workload(
        network=plan.network,
        policy_sha256=None if plan.template else plan.card.sha256,
        latency=Latency(distribution="samples", samples_file=samples_file.name),
        source=source,
        assumed="; ".join(measured.remarks),
    )
    profile = with_workload(_profile_of(plan, date), plan.workload, workload)
    flight = np.repeat(
        np.arange(len(measured.flights)),
        [len(part["infer_start_us"]) for part in measured.flights],
    )
    columns = {
        name: np.concatenate([part[name] for part in measured.flights])
        for name in measured.flights[0]
    }
    described = {
        "schema": SCHEMA,
        "computer": plan.label,
        "workload": plan.workload,
        "level": command.level,
        "command": {key: _plain(value) for key, value in asdict(command).items()},
        "network": plan.network.model_dump(),
        "date_utc": utc_now().isoformat(timespec="seconds"),
        "machine": dict(machine),
        "before": asdict(states[0]),
        "after": asdict(states[1]),
        "versions": package_versions(),
        "load_us": measured.load_us,
        "first_us": measured.first_us,
        "stages_us": {key: asdict(summarize(samples)) for key, samples in stages.items()},
        "remarks": measured.remarks,
    }
    remarks = (f"t2 of {plan.card.name} on {plan.cpu}, {plan.runtime}, ms, in order", source)
    try:
        plan.path.parent.mkdir(parents=True, exist_ok=True)
        write_samples(samples_file, list(t2_ms), remarks)
        save_arrays(arrays, {**columns, "flight": flight.astype(np.int64)})
        text = json.dumps(described, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        replace_file(facts, text.encode())
        write_profile(plan.path, profile)
    except OSError as error:
        raise UsageError(f"--out {command.out}: {error.strerror}") from None
    return plan.path, samples_file, arrays, facts


def _profile_of(plan: ProfilePlan, date: str) -> ComputerProfile:
    """Return the computer: as the file has it, with what was asked for now put over it."""
    command, held = plan.command, plan.existing
    if held is not None:
        asked = {"watts": command.watts, "price_usd": command.price}
        changes: dict[str, Any] = {k: v for k, v in asked.items() if v is not None}
        if command.watts is not None:
            changes["source"] = held.source.replace(f"; {NO_WATTS}", "")
        return held.model_copy(update=changes)
    unknown = [
        remark
        for value, remark in ((command.watts, NO_WATTS), (command.price, NO_PRICE))
        if value is None
    ]
    return ComputerProfile(
        description=f"{plan.label}, as measured by airl profile",
        cpu=plan.cpu,
        watts=command.watts or 0.0,
        price_usd=command.price or 0.0,
        source="; ".join([f"airl profile, {date}", *unknown]),
    )


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value
