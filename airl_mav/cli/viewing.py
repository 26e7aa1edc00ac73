"""Options of commands whose flights can be watched."""

from __future__ import annotations

from pydantic import Field

from airl_mav.cli.options import check_installed
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.scenario.aircraft import GREATEST_PORT
from airl_mav.view.ends import ViewRequest


class Viewing(ProfileModel):
    """Whether flights are watched."""

    view: bool = Field(
        default=False,
        description="show the flights in a browser while they fly, at an address that is printed"
        " (docs/how-to/view.md); in lockstep they fly in real time unless --speed says otherwise",
    )
    view_port: int | None = quantity(
        "TCP port of that page on the loopback address; by default a free one",
        "1",
        ge=1,
        le=GREATEST_PORT,
        default=None,
    )


def view_of(options: Viewing) -> ViewRequest | None:
    """Return the requested live view or None; UsageError for missing packages."""
    if not options.view:
        if options.view_port is not None:
            raise FieldError(
                "view_port", options.view_port, problem="accepted: together with --view"
            )
        return None
    check_installed("view")
    return ViewRequest(options.view_port)
