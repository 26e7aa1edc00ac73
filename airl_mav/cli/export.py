"""`airl export`: turns a Stable-Baselines3 model into a policy that flies."""

from __future__ import annotations

import re
import shlex
import sys

from rich.console import Console

from airl_mav.cli.common import check_train_installed
from airl_mav.cli.export_command import ExportCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.provenance import package_versions
from airl_mav.policy.action_sets import ActionSpec
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyFacts, Training
from airl_mav.policy.layouts import ObservationSpec


def run(command: ExportCommand, console: Console | None = None) -> int:
    """Export, and say what was written.

    Raises:
        UsageError: The model cannot be used; nothing was written.
    """
    console = console or Console()
    check_train_installed()
    described = facts(command)
    if command.out.exists() and not command.out.is_dir():
        raise UsageError(f"--out {command.out}: not a folder")
    # Imported late: torch takes seconds, and a wrong option is found without it.
    from airl_mav.training.sb3_export import export_sb3, load_sb3

    model = load_sb3(command.model, command.algorithm)
    try:
        card = export_sb3(model, described, command.out, with_torch=command.with_torch)
    except UsageError as error:
        raise UsageError(f"{command.model}: {error}") from error
    except OSError as error:
        raise UsageError(f"--out {command.out}: {error.strerror}") from None
    console.print(
        f"{command.out / ONNX_FILE}  {card.network}", soft_wrap=True, markup=False, highlight=False
    )
    console.print(
        f"{command.out / CARD_FILE}  {card.parameters:,} parameters, "
        f"{card.macs:,} multiply-accumulates, SHA-256 {card.sha256[:12]}...",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    return 0


def facts(command: ExportCommand) -> PolicyFacts:
    """Return what the command says about the policy. Raises UsageError."""
    size = re.fullmatch(r"(\d{1,4})x(\d{1,4})", command.image)
    if size is None:
        raise UsageError(f"--image {command.image!r}: accepted: WIDTHxHEIGHT in px, as 32x24")
    name = command.name if command.name is not None else command.out.resolve().name
    image = {
        "layout": command.layout,
        "width_px": int(size[1]),
        "height_px": int(size[2]),
        "horizontal_fov_deg": command.fov,
        "range_m": command.range_m,
    }
    speed = {"set": command.actions, "max_speed_m_s": command.max_speed}
    facts = {
        "name": name,
        "description": command.description,
        "observation": validated(ObservationSpec, image, "--image, --fov, --range"),
        "actions": validated(ActionSpec, speed, "--max-speed"),
        "hold_s": command.hold,
        "goal_radius_m": command.goal_radius,
        "altitude_m": command.altitude,
        "hover_after_s": command.hover_after,
        "algorithm": command.algorithm,
        "epsilon": command.epsilon,
        "training": Training(
            command=shlex.join(["airl", *sys.argv[1:]]),
            versions=package_versions(),
            date_utc=utc_now().isoformat(timespec="seconds"),
        ),
    }
    return validated(PolicyFacts, facts)
