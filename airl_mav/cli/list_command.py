"""`airl list`: built-in policies and profiles, and the policies of installed packages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

from pydantic import BaseModel, Field
from rich.console import Console
from rich.table import Table

from airl_mav.cli.options import POSITIONAL
from airl_mav.core.plugins import POLICIES, announced
from airl_mav.core.progress import new_console
from airl_mav.policy.registry import find_policy, policy_names
from airl_mav.profiles.loading import Kind, describe_profile, list_profiles


def _profiles(kind: Kind) -> list[tuple[str, str]]:
    return [(name, describe_profile(kind, name)) for name in list_profiles(kind)]


PROFILES: tuple[Kind, ...] = ("vehicles", "arenas", "computers", "training", "sweeps")
KINDS: dict[str, Callable[[], list[tuple[str, str]]]] = {
    "policies": lambda: [
        *((name, find_policy(name).description) for name in policy_names()),
        # Listed without loading, which would run their code.
        *((name, f"installed: {where}") for name, where in announced(POLICIES).items()),
    ],
    **{kind: partial(_profiles, kind) for kind in PROFILES},
}


class ListOptions(BaseModel):
    """List built-in vehicles, arenas, policies, computers, training configurations and sweeps.

    Examples:
        airl list
        airl list policies
    """

    kind: Annotated[
        Literal["vehicles", "arenas", "policies", "computers", "training", "sweeps", "all"],
        POSITIONAL,
    ] = Field(default="all", description="kind of items to list")


OPTIONS = ListOptions


def run(options: ListOptions, console: Console | None = None) -> int:
    """Print the names with one line about each. Returns exit status 0."""
    console = console or new_console()
    for kind in KINDS if options.kind == "all" else (options.kind,):
        table = Table(title=kind, title_justify="left", box=None, show_header=False)
        for name, description in KINDS[kind]():
            table.add_row(name, description)
        console.print(table)
    return 0
