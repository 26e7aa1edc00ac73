"""The files of a refit: profiles that load as they are, and say what was fitted from what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import tomli_w

from airl_mav.black_box.reading import BlackBox
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file, write_json
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.computer import (
    ComputerProfile,
    Latency,
    Network,
    Workload,
    write_samples,
)
from airl_mav.refitting.overrides import Override

VEHICLE_FILE, COMPUTER_FILE, LATENCY_FILE = "vehicle.toml", "computer.toml", "latency.txt"
SCENARIO_FILE, REFIT_FILE = "scenario.toml", "refit.json"

WORKLOAD = "flown"
"""Name of the workload in the computer's profile."""


def vehicle_toml(
    base: str, description: str, overrides: Sequence[Override], remarks: Sequence[str]
) -> str:
    """Return the profile of a vehicle: its base, and what a flight says otherwise."""
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
        latency=Latency(distribution="samples", samples_file=LATENCY_FILE),
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
    """Return the network of a policy and its digest; None where it has none, or is not here."""
    try:
        card = find_policy(policy).card
    except UsageError:
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


def write_refit(
    out: Path,
    data: Mapping[str, Any],
    vehicle: str,
    computer: ComputerProfile | None,
    samples_ms: Sequence[float],
    remarks: Sequence[str],
) -> None:
    """Write the files of a refit into a folder, `refit.json` last.

    Args:
        out: New or empty folder.
        data: Content of `refit.json`.
        vehicle: The vehicle's profile as TOML.
        computer: The computer; None = not written.
        samples_ms: t2 of the decisions; empty = not written.
        remarks: Sources of the data.

    Raises:
        OSError: They cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / VEHICLE_FILE, vehicle.encode())
    scenario: dict[str, Any] = {"vehicle": str((out / VEHICLE_FILE).absolute())}
    if samples_ms:
        write_samples(out / LATENCY_FILE, samples_ms, ("t2 of the decisions, ms", *remarks))
        scenario["latency"] = str((out / LATENCY_FILE).absolute())
    if computer is not None:
        replace_file(out / COMPUTER_FILE, _commented(computer, remarks).encode())
    if data["wind"] is not None:
        scenario["wind"] = data["wind"]
    head = "".join(f"# {remark}\n" for remark in remarks)
    replace_file(out / SCENARIO_FILE, (head + tomli_w.dumps(scenario)).encode())
    write_json(out / REFIT_FILE, data)


def _commented(computer: ComputerProfile, remarks: Sequence[str]) -> str:
    plain = computer.model_dump(mode="json", exclude_none=True)
    head = "".join(f"# {remark}\n" for remark in (*remarks, "Fly it with --workload flown."))
    return head + tomli_w.dumps(plain, multiline_strings=False)
