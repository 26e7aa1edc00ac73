#!/usr/bin/env python3
"""Write the data of a PX4 release to profiles/px4, from a SITL build and a log that it flew.

    make px4_sitl_default                                     # in PX4's source tree
    airl-sitl --level lockstep --firmware px4 --px4-dir TREE --episodes 1 --out RUN
    scripts/px4_release.py 1.17 TREE RUN/flight-000.ulg

The build has types, ranges and units of all parameters, the log those that PX4 uses with airframe
10016, and their values after boot. Write the current release first: the others are differences.
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from pyulog import ULog

from airl_mav.core.errors import UsageError
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName
from airl_mav.profiles.vehicle import load_vehicle

PX4 = Path(__file__).resolve().parent.parent / "profiles" / "px4"
BUILD = "build/px4_sitl_default"

COLUMNS = ("name", "type", "default", "min", "max", "unit")

RENAMED = {
    "1.16": {"MAN_DEADZONE": "MPC_HOLD_DZ"},
    # As in PX4's param_translation.cpp.
    "1.18": {"EKF2_GPS_DELAY": "SENS_GPS0_DELAY"},
}
"""Names in a release of parameters that this simulator uses, by their name in the current one."""

LATER = {"MIS_DIST_1WP": 10000.0, "MIS_TKO_LAND_REQ": 0, "GPS_UBX_DYNMODEL": 6}
"""Parameters that PX4 lists after a mission's check, or with the GPS driver; their values."""

UNITS = {"norm": "", "SD": "", "normalized_thrust": "", "normalized_thrust/s": "1/s", "g0": "g"} | {
    "kg/m^2": "kg m²",
    "celcius": "degC",
}
"""Units that this simulator writes otherwise."""

MEASURED_ZERO = 1e-5
"""Values of the initial calibration below this are noise."""


def parameters(tree: Path, log: Path) -> dict[str, tuple[str, ...]]:
    """Return the columns of each parameter that a release serves, by name."""
    listed = json.loads((tree / BUILD / "parameters.json").read_text())["parameters"]
    described = {each["name"]: each for each in listed}
    flown = LATER | ULog(str(log), []).initial_parameters
    # The vehicle has its own rotor positions.
    flown |= {n: v for n, v in load_vehicle("quad").rotor.px4_geometry().items() if "_P" in n}
    names = sorted(flown.keys() & described.keys())
    return {name: _columns(described[name], flown[name]) for name in names}


def _columns(described: Mapping[str, Any], flown: float) -> tuple[str, ...]:
    default = described["default"]
    if default or abs(flown) > MEASURED_ZERO:
        default = flown
    kind = "INT32" if described["type"] == "Int32" else "FLOAT"
    unit = described.get("units", "")
    return (
        described["name"],
        kind,
        *map(_number, (default, described.get("min"), described.get("max"))),
        UNITS.get(unit, unit).replace("^2", "²").replace("^3", "³"),
    )


def _number(value: float | None) -> str:
    # Seven digits identify a 32-bit float; integers keep all digits.
    if value is None:
        return ""
    return f"{value}" if isinstance(value, int) else f"{value:.7g}"


def differences(
    rows: Mapping[str, tuple[str, ...]], current: Mapping[str, tuple[str, ...]]
) -> list[tuple[str, ...]]:
    """Return the rows that differ from the current release; a name alone for a missing one."""
    empty = ("",) * (len(COLUMNS) - 1)
    return [
        rows.get(name, (name, *empty))
        for name in sorted(rows.keys() | current.keys())
        if rows.get(name) != current.get(name)
    ]


def source(tree: Path) -> str:
    """Return tag, commit and date of a source tree."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(tree), *arguments],  # noqa: S607
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()

    tag = git("describe", "--tags", "--always", "--exclude", "ext/*")
    return f"{tag}, {git('log', '-1', '--format=%h, %cs')}"


def read(path: Path) -> dict[str, tuple[str, ...]]:
    """Return the rows of a table of parameters by name."""
    with path.open(newline="", encoding="utf-8") as file:
        return {row[0]: tuple(row) for row in list(csv.reader(file))[1:]}


def write(release: PX4ReleaseName, tree: Path, log: Path) -> None:
    """Write `release.toml` and `parameters.csv` of a release."""
    folder, rows = PX4 / release, parameters(tree, log)
    folder.mkdir(parents=True, exist_ok=True)
    listed: Iterable[tuple[str, ...]] = rows.values()
    if release != CURRENT:
        listed = differences(rows, read(PX4 / CURRENT / "parameters.csv"))
    with (folder / "parameters.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *listed])
    renamed = "".join(f'{new} = "{old}"\n' for new, old in RENAMED.get(release, {}).items())
    (folder / "release.toml").write_text(
        f'version = "{release}.0"\nsource = "{source(tree)}"\n\n'
        "# Names in this release, by the name in the current one.\n"
        f"[renamed]\n{renamed}",
        encoding="utf-8",
    )
    print(f"{folder}: {len(rows)} parameters")


def main() -> int:
    """Write the release named on the command line."""
    if len(sys.argv) != 4 or not re.fullmatch("|".join(get_args(PX4ReleaseName)), sys.argv[1]):
        print(f"usage: px4_release.py {'|'.join(get_args(PX4ReleaseName))} TREE LOG.ulg")
        return 2
    release, tree, log = sys.argv[1:]
    try:
        write(release, Path(tree), Path(log))  # type: ignore[arg-type]  # matched above
    except (OSError, UsageError, subprocess.CalledProcessError) as error:
        print(f"px4_release.py: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
