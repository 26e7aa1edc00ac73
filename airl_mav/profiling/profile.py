"""How long does this computer take for a policy's decisions?"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.core.clock import utc_now
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.machine import MachineState, machine_state
from airl_mav.core.progress import Bar, Progress
from airl_mav.core.provenance import describe_machine
from airl_mav.profiles.computer import (
    LONGEST_MS,
    ComputerProfile,
    Latency,
    Workload,
    existing_profile,
    with_workload,
)
from airl_mav.profiling.measurement import ComputerMeasurement, ProfilingError, Recording, save
from airl_mav.profiling.policy_under_test import PolicyUnderTest, open_policy
from airl_mav.profiling.request import ProfileRequest

BUSY_SHARE = 0.25
"""Load average over one minute, per usable core, above which a machine is not idle."""

UNKNOWN = {"watts": "watts: not measured", "price_usd": "price: not known"}
"""What the source of a profile says of a field that was not given."""


def profile(
    request: ProfileRequest, *, out: Path | None = None, progress: Progress | None = None
) -> ComputerMeasurement:
    """Measure how long this computer takes for a policy's decisions.

    Args:
        request: What is measured, and how.
        out: Folder of computer profiles to which this one and its samples are written, at the very
            end; a profile that it holds keeps its other workloads. None: nothing is written.
        progress: Who looks on.

    Returns:
        The measurement; its `profile` can be flown as, by `Scenario.computer`, once it is written.

    Raises:
        UsageError: The input cannot be used; nothing was measured. `FieldError`s name the field.
        ProfilingError: The measurement broke off: a process or the link was lost. Nothing was
            written.
        ImportError: Level sitl or a random network without the extra that it needs.
        KeyboardInterrupt: Ctrl-C; nothing was written, and a vehicle in flight is being landed.
    """
    progress = progress or Progress()
    machine = describe_machine()
    computer = request.on or _file_name(str(machine["cpu"]))
    cpu = f"{machine['cores']} x {machine['cpu']}"
    # Before anything is measured: a file that must not be changed is better found now.
    path = None if out is None else out / f"{computer}.toml"
    held = None if path is None else existing_profile(path, cpu)
    with open_policy(request) as policy:
        card, network = policy.card, policy.network
        progress.note(f"profile    {card.name} at level {request.level}, {network.runtime}")
        progress.note(f"network    {card.network}")
        before = machine_state()
        bar = progress.bar("decisions", request.warm_up + request.decisions, unit="decisions")
        try:
            recording = _measure(request, policy, bar)
        finally:
            bar.close()
        after = machine_state()
    if remark := busy_remark(before, int(machine["cores_usable"])):
        recording = replace(recording, remarks=(*recording.remarks, remark))
    date = f"{utc_now():%Y-%m-%d}"
    t2_us = recording.stages["t2"]
    if (longest_ms := t2_us.max() / US_PER_MS) > LONGEST_MS:
        raise ProfilingError(f"a decision took {longest_ms:.0f} ms; accepted: {LONGEST_MS:g} ms")
    # A clock of whole µs may give 0 for what is faster.
    samples_ms = (np.maximum(t2_us, 1) / US_PER_MS).tolist()
    workload = Workload(
        network=network,
        policy_sha256=None if request.network is not None else card.sha256,
        latency=Latency(distribution="samples", samples_ms=tuple(samples_ms)),
        source=f"airl profile --level {request.level}, {len(t2_us)} decisions after "
        f"{request.warm_up} of warm-up, {date}",
        assumed="; ".join(recording.remarks),
    )
    name = request.workload or _workload_name(request, card.name)
    known = _computer(request, computer, cpu, held, date)
    measured = ComputerMeasurement(
        request=request,
        card=card,
        recording=recording,
        computer=computer,
        workload=name,
        profile=with_workload(known, name, workload),
        machine=machine,
        before=before,
        after=after,
    )
    return measured if path is None else replace(measured, files=save(measured, path))


def _measure(request: ProfileRequest, policy: PolicyUnderTest, bar: Bar) -> Recording:
    """Measure at the level that was asked for. Imported late: only sitl needs the simulator."""
    if request.level == "bare":
        from airl_mav.profiling.bare import measure
    elif request.level == "hil":
        from airl_mav.profiling.hil import measure
    else:
        from airl_mav.profiling.sitl import measure
    try:
        return measure(request, policy, bar)
    except ProfilingError:
        raise
    except RuntimeError as error:  # of what runs the network
        raise ProfilingError(str(error)) from error


def busy_remark(before: MachineState, cores: int) -> str | None:
    """Return a warning if other programs used the processor at the start, None if not."""
    if before.load is None or before.load[0] <= BUSY_SHARE * cores:
        return None
    return (
        f"the machine was busy with something else: load average {before.load[0]:.2f} on {cores} "
        "usable cores at the start; measure again when it is idle"
    )


def _computer(
    request: ProfileRequest, name: str, cpu: str, held: ComputerProfile | None, date: str
) -> ComputerProfile:
    """Return the computer as its file has it, with the watts and the price of the request."""
    given = {"watts": request.watts, "price_usd": request.price_usd}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    unknown = [remark for name, remark in UNKNOWN.items() if name not in changes]
    if held is None:
        return ComputerProfile(
            description=f"{name}, as measured by airl profile",
            cpu=cpu,
            source="; ".join((f"airl profile, {date}", *unknown)),
            **{"watts": 0.0, "price_usd": 0.0, **changes},
        )
    source = held.source
    for remark in set(UNKNOWN.values()).difference(unknown):
        source = source.replace(f"; {remark}", "")
    return held.model_copy(update={**changes, "source": source})


def _workload_name(request: ProfileRequest, policy: str) -> str:
    parts = [policy, request.level]
    parts += [request.runtime] if request.runtime != "onnx" else []
    parts += [f"{request.threads}threads"] if request.threads > 1 else []
    return "-".join(parts)


def _file_name(cpu: str) -> str:
    """Return a processor's name as the name of a file."""
    plain = re.sub(r"\((?:r|tm|c)\)", "", cpu.lower())
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-")[:48].strip("-") or "computer"
