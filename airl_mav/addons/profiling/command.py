"""`airl profile`: measure the decision latency of this computer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator
from rich.console import Console

from airl_mav.addons.profiling.measurement import ProfilingError, share
from airl_mav.addons.profiling.profile import profile
from airl_mav.addons.profiling.report import print_measurement
from airl_mav.addons.profiling.request import ProfileRequest
from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.progress import RichProgress, new_console


class ProfileOptions(ProfileRequest):
    """Measure this computer's latency for a policy's decisions, and write a computer profile.

    The options --computer and --workload replay the written samples at every level of fidelity.

    Examples:
        airl profile --on my-pi --watts 6.4
        airl profile --network 5x32
        airl profile --soak 10min --share my-pi.toml
        airl profile static-obstacles --level sitl
        airl profile --level hil --connect udpin://0.0.0.0:14540 --camera tcp://192.168.1.10:5600
    """

    policy: Annotated[str | None, POSITIONAL] = Field(
        default=None, description=ProfileRequest.model_fields["policy"].description
    )
    out: Path = Field(
        default=Path("computers"), description="folder of the profile and its samples"
    )
    share: Path | None = Field(
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
