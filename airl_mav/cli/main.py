"""`airl` and its subcommands, one module each. Light: `airl --help` loads no option models."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from functools import partial
from typing import NoReturn

from rich.console import Console
from rich.table import Table

from airl_mav import __version__
from airl_mav.core.addons import entries
from airl_mav.core.errors import EXIT_USAGE
from airl_mav.core.progress import new_console
from airl_mav.core.unsupported import refer

SUBCOMMANDS: dict[str, str] = {
    # To add one: write cli/<name>_command.py with OPTIONS and run(), and a line here. Add-ons have
    # a table of their own.
    "sitl": "rehearse a policy: firmware and companion as two processes, a report (airl-sitl)",
    "firmware": "flight controller, vehicle and camera alone, for any client (airl-firmware)",
    "companion": "what runs on the drone's onboard computer (airl-companion)",
    "evaluate": "fly policies through seeded episodes, with intervals",
    "verdict": "does a policy hold on an onboard computer: as few flights as that takes",
    "hardware-gap": "the hardware gap: what a policy loses on an onboard computer, without and with"
    " mitigation",
    "latency-sweep": "the same policy at growing latencies: where it breaks down",
    "compare-levels": "the same policy and seeds at several levels of the fidelity levels",
    "train": "train a policy on the batch twin",
    "export": "turn a stable-baselines3 model into a policy folder",
    "report": "a run's tables and page again, or a comparison of several runs",
    "arena": "look at an arena, or at what its profile draws",
    "parameters": "a vehicle's parameters as a file for firmware that you start",
    "computers": "computer profiles: what each was timed with, by whom, and how late it decides",
    "list": "shipped vehicles, arenas, policies, computers, sweeps",
}
"""Subcommands with their purposes; module `airl_mav.cli.<name>_command`."""


def subcommands() -> dict[str, tuple[str, str]]:
    """Return all subcommands, add-ons last: purpose and module by name."""
    core = {
        name: (purpose, f"airl_mav.cli.{name.replace('-', '_')}_command")
        for name, purpose in SUBCOMMANDS.items()
    }
    return core | entries("airl_mav", "COMMANDS")


def main(words: Sequence[str] | None = None) -> NoReturn:
    """Run a subcommand and exit with its status."""
    words = sys.argv[1:] if words is None else words
    console = new_console(soft_wrap=True)
    if not words or words[0] in ("-h", "--help"):
        _print_help(console)
        sys.exit(0 if words else EXIT_USAGE)
    name, *rest = words
    if name == "--version":
        console.print(f"airl-mav {__version__}", highlight=False)
        sys.exit(0)
    known = subcommands()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"accepted: {', '.join(known)}"
        hint = refer([name]) or hint
        new_console(stderr=True, soft_wrap=True).print(
            f"error: airl {name}: no such command; {hint}", style="red"
        )
        sys.exit(EXIT_USAGE)
    _run(f"airl {name}", known[name][1], rest)


def _print_help(console: Console) -> None:
    console.print("usage: airl COMMAND [OPTIONS]", highlight=False)
    addons = {name: purpose for name, (purpose, _) in entries("airl_mav", "COMMANDS").items()}
    for title, commands in (("Commands", SUBCOMMANDS), ("Add-ons", addons)):
        if not commands:
            continue
        console.print(f"\n{title}:", highlight=False)
        table = Table.grid(padding=(0, 2), pad_edge=True)
        for name, purpose in commands.items():
            table.add_row(name, purpose)
        console.print(table)
    console.print(
        "\nairl COMMAND --help shows its options and examples; airl --version the version.",
        highlight=False,
    )


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
