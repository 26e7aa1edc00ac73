"""Files of an identification: loadable profiles that document their sources."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import tomli_w

from airl_mav.addons.identification.air import Air, Thrust
from airl_mav.addons.identification.flown import FittedQuantity
from airl_mav.addons.identification.response import ResponseFit
from airl_mav.black_box.mcap_file import BlackBox
from airl_mav.core import errors, fields, files
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.computer import (
    ComputerProfile,
    LatencyDistribution,
    Network,
    Workload,
    write_samples,
)
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import VehicleProfile

DIGITS = 4
"""Significant digits of written values: no interval is narrower."""

TUNED = ("MC_", "MPC_")
"""Name prefixes of parameters that affect flight."""


@dataclass(frozen=True)
class Override:
    """Modified field of a profile."""

    table: str
    key: str
    value: float
    remark: str


def overrides_of(
    profile: VehicleProfile,
    flying: VehicleProfile,
    response: ResponseFit,
    thrust: Thrust,
    air: Air,
    logged: Mapping[str, float],
) -> tuple[Override, ...]:
    """Return the vehicle parameters that differ between a flight and its profile."""
    found: list[Override] = []
    carried_kg = flying.body.mass_kg - profile.body.mass_kg
    mass_kg = flying.body.mass_kg
    if thrust.mass_kg.value is not None:
        mass_kg = thrust.mass_kg.value
        remark = _remark(thrust.mass_kg)
        if carried_kg > 0.0:
            remark += f"; without the computer's {carried_kg:.3f} kg"
        found.append(Override("body", "mass_kg", _round(mass_kg - carried_kg), remark))
    if thrust.thrust_max_n.value is not None:
        value = thrust.thrust_max_n.value
        found.append(Override("rotor", "thrust_max_n", _round(value), _remark(thrust.thrust_max_n)))
    drag_1_s = profile.drag.linear_n_s_m / flying.body.mass_kg
    if air.drag_1_s.value is not None:
        drag_1_s = air.drag_1_s.value
        remark = f"{_remark(air.drag_1_s)}; times {mass_kg:.3f} kg"
        found.append(Override("drag", "linear_n_s_m", _round(drag_1_s * mass_kg), remark))
    table = response.response(drag_1_s, profile.response)
    if table is not None:
        fitted: dict[str, FittedQuantity] = {
            "dead_time_s": response.dead_time_s,
            "velocity_time_s": response.velocity_time_s,
            "yaw_rate_time_s": response.yaw_rate_time_s,
            "drag_1_s": air.drag_1_s,
        }
        for key, value in table.model_dump().items():
            if key in fitted:
                found.append(Override("response", key, _round(value), _remark(fitted[key])))
    return (*found, *_parameters(profile, logged))


def identified_profile(profile: VehicleProfile, overrides: Sequence[Override]) -> VehicleProfile:
    """Return a profile with a flight's overrides. Raises FieldError if it cannot fly."""
    data: dict[str, Any] = profile.model_dump()
    for each in overrides:
        data[each.table] = {**(data[each.table] or {}), each.key: each.value}
    return fields.validated(VehicleProfile, data)


def _parameters(profile: VehicleProfile, logged: Mapping[str, float]) -> list[Override]:
    """Return the flight controller's changed gains and limits, without out-of-range values."""
    release = px4_release(profile.px4_release)
    held = release.parameter_values(profile.parameters)
    remark = "as the flight controller's log has it"
    return [
        Override("parameters", spec.name, _round(logged[spec.name]), remark)
        for spec in release.specs
        if spec.is_used
        and spec.name.startswith(TUNED)
        and spec.low <= logged.get(spec.name, math.nan) <= spec.high
        and abs(logged[spec.name] - held[spec.name]) > 1e-6 * max(1.0, abs(held[spec.name]))
    ]


def _remark(estimate: FittedQuantity) -> str:
    if estimate.value is None:
        return f"not observable in this flight, as it was: {estimate.unobservable}"
    return (
        f"95 %: {_round(estimate.low):g} to {_round(estimate.high):g} {estimate.unit}, from"
        f" {estimate.source}"
    )


def _round(value: float | None) -> float:
    return float(f"{value or 0.0:.{DIGITS}g}")


VEHICLE_FILE, COMPUTER_FILE, LATENCY_FILE = "vehicle.toml", "computer.toml", "latency.txt"
SCENARIO_FILE, IDENTIFICATION_FILE = "scenario.toml", "identification.json"

WORKLOAD = "flown"
"""Workload name in the computer's profile."""


def vehicle_toml(
    base: str, description: str, overrides: Sequence[Override], remarks: Sequence[str]
) -> str:
    """Return a vehicle profile as TOML: its base, and a flight's overrides."""
    path = Path(base)
    named = str(path.absolute()) if base.endswith(".toml") else base
    lines = [f"# {remark}" for remark in remarks]
    lines += [tomli_w.dumps({"base": named, "description": description}).rstrip()]
    for table, held in groupby(overrides, key=lambda each: each.table):
        lines += ["", f"[{table}]"]
        for each in held:
            lines += [f"# {each.remark}", f"{each.key} = {each.value!r}"]
    return "\n".join(lines) + "\n"


def computer_profile(
    box: BlackBox, board: ComputerProfile, samples: int, source: str
) -> ComputerProfile | None:
    """Return the computer with its policy's latency as a workload; None without the network."""
    config = box.run.get("config", {})
    network = _network(str(config.get("policy")), str(config.get("runtime", "onnx")), box)
    if network is None:
        return None
    machine = box.run.get("machine", {})
    setup = box.run.get("setup", {})
    injected = setup.get("injection", {}).get("origin") != "measured"
    how = "injected as asked for" if injected else "the computer's own"
    workload = Workload(
        network=network[0],
        policy_sha256=network[1],
        latency=LatencyDistribution(distribution="samples", samples_file=LATENCY_FILE),
        source=f"measured in flight: {samples} decisions, {source}",
        assumed=f"latency in that flight: {how}",
    )
    cpu = board.cpu if injected else f"{machine.get('cores', 1)} x {machine.get('cpu', 'unknown')}"
    return board.model_copy(
        update={
            "description": f"{board.description}, as measured in flight",
            "cpu": cpu,
            "workloads": {WORKLOAD: workload},
        }
    )


def _network(policy: str, runtime: str, box: BlackBox) -> tuple[Network, str] | None:
    """Return the network of a policy and its digest; None if missing or not installed."""
    try:
        card = find_policy(policy).card
    except errors.UsageError:
        return None
    if card is None:
        return None
    package = {"onnx": "onnxruntime"}.get(runtime, runtime)
    version = box.run.get("versions", {}).get(package, "")
    network = Network(
        image_height_px=card.observation.height_px,
        image_width_px=card.observation.width_px,
        parameters=card.parameters,
        macs=card.macs,
        runtime=f"{runtime} {version}".strip(),
    )
    return network, card.sha256


def write_identification(
    out: Path,
    data: Mapping[str, Any],
    vehicle: str,
    computer: ComputerProfile | None,
    samples_ms: Sequence[float],
    remarks: Sequence[str],
) -> None:
    """Write the files into a new or empty folder; `identification.json`, from `data`, last."""
    out.mkdir(parents=True, exist_ok=True)
    files.replace_file(out / VEHICLE_FILE, vehicle.encode())
    scenario: dict[str, Any] = {"vehicle": str((out / VEHICLE_FILE).absolute())}
    if samples_ms:
        write_samples(out / LATENCY_FILE, samples_ms, ("t2 of the decisions, ms", *remarks))
        scenario["latency"] = str((out / LATENCY_FILE).absolute())
    if computer is not None:
        files.replace_file(out / COMPUTER_FILE, _commented(computer, remarks).encode())
    if data["wind"] is not None:
        scenario["wind"] = data["wind"]
    head = "".join(f"# {remark}\n" for remark in remarks)
    files.replace_file(out / SCENARIO_FILE, (head + tomli_w.dumps(scenario)).encode())
    files.write_json(out / IDENTIFICATION_FILE, data)


def _commented(computer: ComputerProfile, remarks: Sequence[str]) -> str:
    plain = computer.model_dump(mode="json", exclude_none=True)
    head = "".join(f"# {remark}\n" for remark in (*remarks, "Fly it with --workload flown."))
    return head + tomli_w.dumps(plain, multiline_strings=False)
