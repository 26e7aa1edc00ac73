"""`airl` and its subcommands, one module each. Light: `airl --help` loads no option models."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from functools import partial
from typing import NoReturn

from rich.console import Console

from airl_mav import __version__
from airl_mav.core import addons, errors, progress

GROUPS = {
    "fly": "Fly",
    "learn": "Learn",
    "measure": "Measure",
    "judge": "Judge",
    "logs": "Recorded flights and logs",
    "show": "Show",
}
"""Groups of commands with their titles, in the order of `airl --help`."""

SUBCOMMANDS: dict[str, tuple[str, str]] = {
    # To add one: write cli/<name>_command.py with OPTIONS and run(), and a line here. Add-ons have
    # a table of their own.
    "sitl": ("fly", "rehearse a policy and write a report (airl-sitl)"),
    "firmware": ("fly", "run flight controller, vehicle and camera (airl-firmware)"),
    "companion": ("fly", "run the policy on the drone's computer (airl-companion)"),
    "parameters": ("fly", "write a vehicle's parameters for PX4 or ArduPilot"),
    "train": ("learn", "train a policy in the vectorized simulator"),
    "export": ("learn", "convert a stable-baselines3 or PyTorch model to a policy"),
    "evaluate": ("measure", "fly policies on fixed seeds: success, time, energy"),
    "hardware-gap": ("measure", "measure what an onboard computer costs a policy"),
    "latency-sweep": ("measure", "fly policies at increasing latencies"),
    "compare-levels": ("measure", "compare simulation levels on the same seeds"),
    "computers": ("measure", "list computer profiles and their latencies"),
    "verdict": ("judge", "test a success rate with as few flights as possible"),
    "report": ("show", "print and draw a run, or compare runs"),
    "arena": ("show", "list and draw an arena"),
    "list": ("show", "list vehicles, arenas, policies, computers, sweeps"),
}
"""Subcommands with their group and purpose; module `airl_mav.cli.<name>_command`."""


def subcommands() -> dict[str, tuple[str, str, str]]:
    """Return all subcommands, add-ons last: group, purpose and module by name."""
    core = {
        name: (group, purpose, f"airl_mav.cli.{name.replace('-', '_')}_command")
        for name, (group, purpose) in SUBCOMMANDS.items()
    }
    return core | addons.entries("airl_mav", "COMMANDS")


def main(words: Sequence[str] | None = None) -> NoReturn:
    """Run a subcommand and exit with its status."""
    words = sys.argv[1:] if words is None else words
    console = progress.new_console(soft_wrap=True)
    if not words or words[0] in ("-h", "--help"):
        _print_help(console)
        sys.exit(0 if words else errors.EXIT_USAGE)
    name, *rest = words
    if name == "--version":
        console.print(f"airl-mav {__version__}", highlight=False)
        sys.exit(0)
    known = subcommands()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"accepted: {', '.join(known)}"
        hint = errors.refer([name]) or hint
        progress.new_console(stderr=True, soft_wrap=True).print(
            f"error: airl {name}: no such command; {hint}", style="red"
        )
        sys.exit(errors.EXIT_USAGE)
    _run(f"airl {name}", known[name][2], rest)


def _print_help(console: Console) -> None:
    lines = ["usage: airl COMMAND [OPTIONS]", ""]
    for group, title in GROUPS.items():
        lines.append(f"{title}:")
        lines += (
            f"  {name:<17}{purpose}"
            for name, (of, purpose, _) in subcommands().items()
            if of == group
        )
    lines += ["", "airl COMMAND --help shows examples and options; airl --version the version."]
    console.print("\n".join(lines), highlight=False, markup=False)


# --- entry points of the console scripts


def _run(prog: str, module: str, words: Sequence[str] | None = None) -> NoReturn:
    # Imported here: the list of commands does not need the option models.
    from airl_mav.cli.options import run_command

    run_command(prog, module, words)


sitl = partial(_run, "airl-sitl", "airl_mav.cli.sitl_command")
firmware = partial(_run, "airl-firmware", "airl_mav.cli.firmware_command")
companion = partial(_run, "airl-companion", "airl_mav.cli.companion_command")
"""`airl-companion` needs only the light installation."""


def airl() -> None:
    """Run `airl` with its subcommands."""
    main(sys.argv[1:])


if __name__ == "__main__":
    main()
