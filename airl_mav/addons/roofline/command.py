"""`airl roofline`: safe velocity of a vehicle with different computers, and its limiting factor."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field
from rich.console import Console

from airl_mav.addons.roofline.roofline import RooflineRequest, roofline
from airl_mav.core.progress import new_console
from airl_mav.report.document import print_document, print_place


class RooflineOptions(RooflineRequest):
    """The F-1 roofline: safe velocity against reaction time, for a vehicle and its computers.

    The vehicle carries and powers each computer. The results show the closed-form limit, the limit
    from the vehicle's measured braking, and the flown speed.

    Examples:
        airl roofline
        airl roofline --policy static-obstacles-ras-pi-4 --sensing-distance-m 8
        airl roofline --policy MINE --computers my-pi.toml my-jetson.toml --workload policy
    """

    out: Path | None = Field(
        default=None,
        description="folder of roofline.json, roofline.html and roofline.png; by default"
        " runs/<UTC time>-roofline-<vehicle>",
    )


OPTIONS = RooflineOptions


def run(options: RooflineOptions, console: Console | None = None) -> int:
    """Compute, fly and show the roofline; return 0. Raises UsageError as `roofline` does."""
    asked = {name: getattr(options, name) for name in RooflineRequest.model_fields}
    result = roofline(RooflineRequest(**asked), out=options.out)
    console = console or new_console()
    print_document(result.document, console)
    print_place(result.document.name, result.page, console)
    return 0
