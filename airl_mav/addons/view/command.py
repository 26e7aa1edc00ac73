"""`airl view`: replay flights of a run in a browser."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.addons.view.replayed_flight import ReplayedRuns, run_folders
from airl_mav.cli.options import POSITIONAL
from airl_mav.cli.shared_options import TrustArenas, folder_of
from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.progress import new_console
from airl_mav.rehearsal.run_folder import load, trust_arenas
from airl_mav.scenario.aircraft import GREATEST_PORT


class ViewOptions(ProfileModel):
    """Replay the flights of a run in a browser, the worst first; Ctrl-C ends it.

    For a campaign (airl evaluate of several policies, hardware-gap, ...) any two runs can be
    selected on the page, which starts with the first run.

    Examples:
        airl view runs/20261122T101530Z-sitl-static-obstacles
        airl view runs/A 7 --beside runs/B
        airl view runs/20261122T114501Z-hardware-gap
        airl view flights/20261123T101530.123456Z.mcap
    """

    run: Annotated[Path, POSITIONAL] = Field(
        description="run folder, campaign, or the black box of a flight (.mcap)"
    )
    flight: Annotated[int | None, POSITIONAL] = Field(
        default=None, description="number of the flight that is shown first; by default the worst"
    )
    beside: Path | None = Field(
        default=None,
        description="another run: its flight of the same seed flies beside, in another colour",
    )
    port: int | None = quantity(
        "TCP port of the page on the loopback address; by default a free one",
        "1",
        ge=1,
        le=GREATEST_PORT,
        default=None,
    )
    trust: TrustArenas = False


OPTIONS = ViewOptions
EXTRAS = ("view",)


def run(options: ViewOptions, console: Console | None = None) -> int:
    """Serve the page until Ctrl-C; return 0."""
    console = console or new_console()
    paths = [options.run] if options.beside is None else [options.run, options.beside]
    found = [run_folders(folder_of(path)) for path in paths]
    folders = [folder for each in found for folder in each]
    if options.trust:
        for folder in folders:
            trust_arenas(load(folder))
    runs = ReplayedRuns(folders)
    shown = [runs.at(each[0]) for each in found]
    replayed, *others = shown
    first = replayed.records[0] if options.flight is None else replayed.record(options.flight)
    for each in shown:
        if (same := each.same(first)) is not None:
            each.check(same)
    # Imported here: the viewer is an extra.
    from airl_mav.addons.view.view_server import LocalServer

    # Its output repeats the address.
    with redirect_stdout(io.StringIO()):
        server = LocalServer(options.port or 0)
    try:
        port = server.get_port()
        if options.port not in (None, port):
            raise FieldError("port", options.port, problem="it is taken; accepted: a free one")
        console.print(f"view  http://{LOOPBACK}:{port}", soft_wrap=True, highlight=False)
        console.file.flush()
        # The browser loads the page while the flight is prepared. These imports, with compiled
        # and drawing code, take longer than all of the above.
        from airl_mav.addons.view.replay_page import ReplayPage

        ReplayPage(server, replayed, others[0] if others else None, first, runs).run()
    except KeyboardInterrupt:
        return 0
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()
    return 0
