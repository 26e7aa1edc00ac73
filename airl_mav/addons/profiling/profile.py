"""`airl profile`: measure this computer's decision latency for a policy."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator
from rich.console import Console

from airl_mav.addons.profiling import measurement
from airl_mav.addons.profiling.measurement import ProfileRequest, ProfilingError, share
from airl_mav.addons.profiling.policy_under_test import BareLoop, PolicyUnderTest, open_policy
from airl_mav.addons.profiling.report import print_measurement
from airl_mav.addons.profiling.soak import MachineReading, Soak, soak
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.child_process import stop_on_signals
from airl_mav.core.clock import WallClock, utc_now
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.fields import COMMON
from airl_mav.core.machine import (
    MachineState,
    describe_machine,
    machine_state,
    mean_frequency_mhz,
    temperature_c,
)
from airl_mav.core.progress import Bar, Progress, RichProgress, new_console
from airl_mav.core.resource_use import PowerMeter, PowerSampling, PowerSource, find_power_source
from airl_mav.profiles.computer import (
    LONGEST_MS,
    ComputerProfile,
    LatencyDistribution,
    Workload,
    existing_profile,
    with_workload,
)

BUSY_SHARE = 0.25
"""Load average over one minute, per usable core, above which a machine is not idle."""

IDLE_US = 3 * US_PER_S
"""Duration of the idle power measurement."""

WATTS_REMARK = "watts: "
"""Prefix of the profile's source text for watts without a user value."""

UNKNOWN = {"watts": f"{WATTS_REMARK}not measured", "price_usd": "price: not known"}
"""Source texts for missing fields."""


def profile(
    request: ProfileRequest,
    *,
    out: Path | None = None,
    progress: Progress | None = None,
    root: Path = Path("/"),
) -> measurement.ComputerMeasurement:
    """Measure the latency of a policy's decisions on this computer.

    Args:
        request: Subject and method of the measurement.
        out: Folder of computer profiles, written at the end; other workloads are kept. None = no
            files.
        progress: Progress display.
        root: Root of /sys, for the power.

    Returns:
        The measurement; its written `profile` is accepted by `Scenario.computer`.

    Raises:
        UsageError: Invalid input; nothing was measured. `FieldError`s name the field.
        ProfilingError: A process or the link was lost. Nothing was written.
        ImportError: Level sitl or a random network needs an extra.
        KeyboardInterrupt: Ctrl-C; nothing was written, and a vehicle in flight lands.
    """
    progress = progress or Progress()
    machine = describe_machine()
    computer = request.on or _file_name(str(machine["cpu"]))
    cpu = f"{machine['cores']} x {machine['cpu']}"
    # Before measuring: an unchangeable file is reported early.
    path = None if out is None else out / f"{computer}.toml"
    held = None if path is None else existing_profile(path, cpu)
    with open_policy(request) as policy:
        card, network = policy.card, policy.network
        progress.note(f"profile    {card.name} at level {request.level}, {network.runtime}")
        progress.note(f"network    {card.network}")
        source, told_by = find_power_source(root)
        idle_w = None if source is None else _idle_power(source)
        before = machine_state()
        bar = progress.bar("decisions", request.warm_up + request.decisions, unit="decisions")
        try:
            with ExitStack() as sampling:
                meter = source and sampling.enter_context(PowerSampling(source, WallClock()))
                recording = _measure(request, policy, bar)
        finally:
            bar.close()
        after = machine_state()
        power = measurement.DrawnPower(told_by, idle_w, meter.mean_w if meter else None)
        soaked = _soak(request, policy, source, progress) if request.soak else None
    if remark := busy_remark(before, int(machine["cores_usable"])):
        recording = replace(recording, remarks=(*recording.remarks, remark))
    date = f"{utc_now():%Y-%m-%d}"
    t2_us = recording.stages["t2"]
    if (longest_ms := t2_us.max() / US_PER_MS) > LONGEST_MS:
        raise measurement.ProfilingError(
            f"a decision took {longest_ms:.0f} ms; accepted: {LONGEST_MS:g} ms"
        )
    # A clock of whole µs may return 0 for shorter durations.
    samples_ms = (np.maximum(t2_us, 1) / US_PER_MS).tolist()
    workload = Workload(
        network=network,
        policy_sha256=None if request.network is not None else card.sha256,
        latency=LatencyDistribution(distribution="samples", samples_ms=tuple(samples_ms)),
        source=f"airl profile --level {request.level}, {len(t2_us)} decisions after "
        f"{request.warm_up} of warm-up, {date}",
        assumed="; ".join(recording.remarks),
    )
    name = request.workload or _workload_name(request, card.name)
    known = _computer(request, computer, cpu, held, date, power)
    measured = measurement.ComputerMeasurement(
        request=request,
        card=card,
        recording=recording,
        computer=computer,
        workload=name,
        profile=with_workload(known, name, workload),
        machine=machine,
        before=before,
        after=after,
        power=power,
        soak=soaked,
    )
    return measured if path is None else replace(measured, files=measurement.save(measured, path))


def _measure(request: ProfileRequest, policy: PolicyUnderTest, bar: Bar) -> measurement.Recording:
    """Measure at the requested level. Imports late: only sitl needs the simulator."""
    if request.level == "bare":
        from airl_mav.addons.profiling.policy_under_test import measure
    elif request.level == "hil":
        from airl_mav.addons.profiling.hil import measure
    else:
        from airl_mav.addons.profiling.sitl import measure
    try:
        return measure(request, policy, bar)
    except measurement.ProfilingError:
        raise
    except RuntimeError as error:  # Raised by the runtime
        raise measurement.ProfilingError(str(error)) from error


def _idle_power(source: PowerSource) -> float | None:
    """Return the mean power of an idle machine [W]."""
    clock = WallClock()
    meter = PowerMeter(source, clock)
    clock.sleep_until(IDLE_US)
    return meter.sample()


def _soak(
    request: ProfileRequest,
    policy: PolicyUnderTest,
    source: PowerSource | None,
    progress: Progress,
) -> Soak:
    """Repeat decisions without a pause for the requested time; Ctrl-C ends the soak early."""
    seconds = request.soak_s
    assert seconds is not None  # noqa: S101 (the soak was requested)
    loop = BareLoop(request, policy)
    meter = None if source is None else PowerMeter(source, loop.clock)

    def read() -> MachineReading:
        watts = None if meter is None else meter.sample()
        return MachineReading(mean_frequency_mhz(), temperature_c(), watts)

    with stop_on_signals() as stop:
        progress.note(
            f"soak       {request.soak} without a pause; Ctrl-C ends it, and keeps the rest"
        )
        bar = progress.bar("soak", round(seconds), unit="s")
        try:
            return soak(
                loop.decide,
                seconds,
                loop.clock,
                read=read,
                state=machine_state,
                stop=stop,
                progress=lambda passed_s: bar.update(completed=passed_s),
            )
        finally:
            bar.close()


def busy_remark(before: MachineState, cores: int) -> str | None:
    """Return a warning if other programs used the processor at the start, else None."""
    if before.load is None or before.load[0] <= BUSY_SHARE * cores:
        return None
    return (
        f"the machine was busy with something else: load average {before.load[0]:.2f} on {cores} "
        "usable cores at the start; measure again when it is idle"
    )


def _computer(
    request: ProfileRequest,
    name: str,
    cpu: str,
    held: ComputerProfile | None,
    date: str,
    power: measurement.DrawnPower,
) -> ComputerProfile:
    """Return the computer's profile with the request's watts and price.

    Missing watts are measured, except at level sitl, where the simulator draws power too.
    """
    given = {"watts": request.watts, "price_usd": request.price_usd}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    said = {name: remark for name, remark in UNKNOWN.items() if name not in changes}
    nobody_gave = "watts" in said and (held is None or WATTS_REMARK in held.source)
    if nobody_gave and power.busy_w is not None and request.level != "sitl":
        changes["watts"] = round(power.busy_w, 2)
        said["watts"] = f"{WATTS_REMARK}measured while deciding at level {request.level} ({power})"
    if held is None:
        return ComputerProfile(
            description=f"{name}, as measured by airl profile",
            cpu=cpu,
            source="; ".join((f"airl profile, {date}", *said.values())),
            **{"watts": 0.0, "price_usd": 0.0, **changes},
        )
    # The source text of a figure is replaced with the figure.
    replaced = tuple(UNKNOWN[name].partition(" ")[0] for name in changes)
    parts = [part for part in held.source.split("; ") if not part.startswith(replaced)]
    parts += [said[name] for name in changes if name in said]
    return held.model_copy(update={**changes, "source": "; ".join(parts)})


def _workload_name(request: ProfileRequest, policy: str) -> str:
    parts = [policy, request.level]
    parts += [request.runtime] if request.runtime != "onnx" else []
    parts += [f"{request.threads}threads"] if request.threads > 1 else []
    return "-".join(parts)


def _file_name(cpu: str) -> str:
    """Return a processor's name as a file name."""
    plain = re.sub(r"\((?:r|tm|c)\)", "", cpu.lower())
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-")[:48].strip("-") or "computer"


class ProfileOptions(ProfileRequest):
    """Measure this computer's latency for a policy's decisions, and write a computer profile.

    The options --computer and --workload replay the written samples at every level of fidelity.

    Examples:
        airl profile --on my-pi --watts 6.4
        airl profile --network 5x32
        airl profile --soak 10min --share my-pi.toml
        airl profile static-obstacles --level sitl
        airl profile --level hil --insecure --connect udpin://0.0.0.0:14540 \
            --camera tcp://192.168.1.10:5600
    """

    policy: Annotated[str | None, POSITIONAL] = Field(
        default=None, description=ProfileRequest.model_fields["policy"].description
    )
    out: Annotated[Path, COMMON, "output"] = Field(
        default=Path("computers"), description="folder of the profile and its samples"
    )
    share: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="also write one file (.toml) to be passed on, which another machine flies with"
        " --computer FILE: samples, state of the machine, soak, versions, digest",
    )

    @field_validator("share")
    @classmethod
    def _toml(cls, share: Path | None) -> Path | None:
        if share is not None and share.suffix != ".toml":
            raise FieldError("share", f"{share}", "a file whose name ends in .toml")
        return share


OPTIONS = ProfileOptions


def run(options: ProfileOptions, console: Console | None = None) -> int:
    """Measure, print the report, and write the profile unless it failed; return 0, 1 or 130."""
    console = console or new_console()
    if options.level == "sitl":
        check_installed("sim")
    if options.network is not None:
        check_installed("profile")
    request = ProfileRequest.model_validate(options.model_dump(exclude={"out", "share"}))
    with RichProgress(console) as progress:
        try:
            measured = profile(request, out=options.out, progress=progress)
        except ProfilingError as error:
            progress.note(f"error: {error}; nothing was written", "red")
            return EXIT_BROKEN
        except KeyboardInterrupt:
            progress.note(
                "interrupted: nothing was written; the same command starts over", "yellow"
            )
            return EXIT_INTERRUPTED
    if options.share is not None:
        measured = replace(measured, files=(*measured.files, share(measured, options.share)))
    print_measurement(measured, console)
    return EXIT_INTERRUPTED if measured.soak is not None and measured.soak.interrupted else 0
