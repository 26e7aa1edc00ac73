#!/usr/bin/env python3
"""Write the data of a PX4 release to profiles/px4, from a SITL build and a log that it flew.

    make px4_sitl_default                                     # in PX4's source tree
    airl-sitl --level lockstep --firmware px4 --px4-dir TREE --episodes 1 --out RUN
    scripts/px4_release.py 1.17 TREE RUN/flight-000.ulg
    scripts/px4_release.py 1.17 TREE                          # events alone: needs no build

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
from typing import Any, cast, get_args

from pyulog import ULog

from airl_mav.core.errors import UsageError
from airl_mav.profiles.loading import load_profile, read_toml
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.addons.ground_station_services.component_metadata import all_definitions
from firmware_sim.autopilot import prearm
from firmware_sim.mavlink import services
from firmware_sim.mavlink.codec import dialect

PX4 = Path(__file__).resolve().parent.parent / "profiles" / "px4"
BUILD = "build/px4_sitl_default"

COLUMNS = ("name", "type", "default", "min", "max", "unit")

UNKNOWN_MODE = {"1.18": "TEMPORARILY_REJECTED"}
"""First answer to a mode that PX4 does not know: `airl conformance` measured it."""

RENAMED = {
    "1.16": {"MAN_DEADZONE": "MPC_HOLD_DZ"},
    # As in PX4's param_translation.cpp.
    "1.18": {"EKF2_GPS_DELAY": "SENS_GPS0_DELAY"},
}
"""Names in a release of parameters that this simulator uses, by their name in the current one."""

ALSO = {"MIS_DIST_1WP": 10000.0, "MIS_TKO_LAND_REQ": 0, "GPS_UBX_DYNMODEL": 6}
"""Parameters that PX4 lists after a mission's check, or with the GPS driver; their values."""

UNITS = {"norm": "", "SD": "", "normalized_thrust": "", "normalized_thrust/s": "1/s", "g0": "g"} | {
    "kg/m^2": "kg m²",
    "celcius": "degC",
}
"""Units that this simulator writes otherwise."""

OF_THE_FLIGHT = ("MAV_SYS_ID", "EKF2_MAG_DECL")
"""Parameters that PX4 sets for the instance and the place."""

MEASURED_ZERO = 1e-5
"""Values of the initial calibration below this are noise."""


def parameters(tree: Path, log: Path) -> dict[str, tuple[str, ...]]:
    """Return the columns of each parameter that a release serves, by name."""
    listed = json.loads((tree / BUILD / "parameters.json").read_text())["parameters"]
    described = {each["name"]: each for each in listed}
    flown = ALSO | ULog(str(log), []).initial_parameters
    # The vehicle has its own rotor positions.
    flown |= {
        n: v
        for n, v in load_profile("vehicles", "quad", VehicleProfile).rotor.px4_geometry().items()
        if "_P" in n
    }
    flown |= {name: described[name]["default"] for name in OF_THE_FLIGHT}
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


def unknown_commands(tree: Path) -> dict[str, int]:
    """Return the commands that this simulator supports and a release does not, by name."""
    message = next((tree / "msg").rglob("VehicleCommand.msg")).read_text()
    numbers = {n: int(v) for n, v in re.findall(r"VEHICLE_CMD_(\w+)\s*=\s*(\d+)", message)}
    names = {number: each.name for number, each in dialect.enums["MAV_CMD"].items()}
    numbers |= {name.removeprefix("MAV_CMD_"): number for number, name in names.items()}
    code = (path.read_text(errors="replace") for path in (tree / "src/modules").rglob("*.[ch]pp"))
    found = {name for text in code for name in re.findall(r"(?:MAV|VEHICLE)_CMD_(\w+)", text)}
    known = {numbers.get(name) for name in found}
    listed = sorted(services.table("ACTIONS").keys() - known)
    return {names[number].removeprefix("MAV_CMD_"): number for number in listed}


def _table(name: str, comment: str, values: Mapping[str, object]) -> str:
    rows = "".join(f"{key} = {_value(value)}\n" for key, value in values.items())
    return f"\n# {comment}\n[{name}]\n{rows}"


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {json.dumps(text)}" for key, text in value.items()) + " }"
    return json.dumps(value)


FAILSAFES = {
    "fallback_needs_pilot": "manualControlFallbackAction",
    "exceptions_cover_auto_modes": "LinkLossExceptionBits::AutoModes",
    "gcs_loss_needs_arming": r"dll_loss_ignored_land \|\| !state.armed",
    "takeover_needs_action": r"user_intended_mode_updated && \(_selected_action > Action::Warn\)",
    "orbit_ends_at_once": "Failsafe engaged, downgrading ORBIT",
}
"""Text in PX4's failsafe.cpp or framework.cpp that shows a rule of `FailsafeRules`."""

LATER = {"1.17": {"fallback_needs_pilot": True}}
"""Rules of a release that came after the source: PX4 26391, in 1.17.0."""


def failsafes(tree: Path, release: str) -> dict[str, bool | int]:
    """Return the rules of a release's failsafes."""
    folder = tree / "src/modules/commander/failsafe"
    code = "".join((folder / name).read_text() for name in ("failsafe.cpp", "framework.cpp"))
    found: dict[str, bool | int] = {
        rule: re.search(text, code) is not None for rule, text in FAILSAFES.items()
    }
    undelayed = re.search(r"bool action_can_be_delayed[^;]*", code)
    names = undelayed.group() if undelayed else ""
    found["delays_from"] = sum(f"Action::{name} " in names for name in ("None", "Warn"))
    found["warning_has_text"] = "if (action != Action::Warn) {" not in code
    return found | LATER.get(release, {})


# --- events


RENAMED_EVENTS = {"1.18": {"mavlink_mission_op_timeout": "mavlink_mission_sync_timeout"}}
"""Names in a release of events that this simulator sends, by their name in the current one."""

NEEDS = dict.fromkeys(
    ("check_estimator_heading_not_stable", "check_estimator_missing_data"), "ATTITUDE"
)
"""Requirement of the modes that a check blocks, in the code; other checks block all modes."""

EVENT = re.compile(
    r"""events::ID\("(?P<name>\w+)"\)\s*,\s*(?P<level>\{[^}]*\}|[\w:]+)\s*,\s*
    "(?P<message>[^"]*)"[^;]*;""",
    re.VERBOSE,
)
"""Event in PX4's code."""

TEXT_AFTER = re.compile(
    r"""(?:\s*reporter\.clearCanRunBits[^;]*;)?\s*if\s*\([^;{}]*mavlink_log_pub\(\)\)\s*\{
    \s*mavlink_log_(?P<severity>\w+)\([^"]*"(?P<text>[^"]*)\"""",
    re.VERBOSE,
)
"""Text of a check, after its event."""

TEXT_BEFORE = re.compile(r"""send_statustext_\w+\("([^"]*)"\);\s*events::send[^;]*$""")
"""Text of the mission protocol, before its event."""


def events(tree: Path, release: str) -> dict[str, Any]:
    """Return the events that a release lacks or changes, and if it reports a mission's state."""
    found: dict[str, dict[str, str]] = {}
    for path in sorted((tree / "src").rglob("*.[ch]pp")):
        code = path.read_text(errors="replace")
        for match in EVENT.finditer(code):
            found.setdefault(match["name"], _event(match, code))
    if not found:
        raise UsageError(f"{tree}: accepted: a source tree of PX4")
    renamed = RENAMED_EVENTS.get(release, {})
    checks = {check.event.name: check for check in reversed(prearm.CHECKS)}
    graded = {check.event.name for check in prearm.CHECKS if check.level is not None}
    own_events = {event.name: event for event in all_definitions()}
    absent, changed = [], {}
    for name, event in sorted(own_events.items()):
        if (there := found.get(renamed.get(name, name))) is None:
            absent.append(name)
            continue
        own = {"name": name, "message": event.message, "level": event.level.name}
        if check := checks.get(name):
            own |= {
                "text": check.text,
                "severity": check.severity.name,
                "needs": NEEDS.get(name, ""),
            }
            if name in graded:
                del own["level"]
            else:
                own["grades"] = ""
        elif name in renamed:
            own["text"] = ""
        change = {key: there[key] for key in own if there.get(key, own[key]) != own[key]}
        if change:
            changed[name] = change
    modules = tree / "src/modules"
    reported = "wpc.mission_state" in (modules / "mavlink/mavlink_mission.cpp").read_text()
    # Both came with PX4 1.17.
    completes = "_RETURN_TO_LAUNCH:" in (modules / "navigator/mission_block.cpp").read_text()
    if completes is not reported:
        raise UsageError(f"{tree}: accepted: a mission's state with returns that complete it")
    return {"mission_state": reported, "unknown_events": absent, "events": changed}


def _event(match: re.Match[str], code: str) -> dict[str, str]:
    """Return an event in PX4's code in this simulator's terms."""
    begin = max(code.rfind(sign, 0, match.start()) for sign in ";{}")
    call, after = code[begin : match.start()], TEXT_AFTER.match(code, match.end())
    # Two arguments of a check precede those of its message.
    first = 3 if "reporter" in call else 1
    level = re.search(r"Log::(\w+)", match["level"])
    found = {
        "name": match["name"],
        "message": re.sub(r"\{(\d)", lambda m: f"{{{int(m[1]) + first - 1}", match["message"]),
    }
    found |= {"level": level[1].upper()} if level else {"grades": "charge"}
    # Single sensors here: number 0. Motors count from 1 on.
    if after:
        text = re.sub(r"%[ud]", "1" if "Motor" in after["text"] else "0", after["text"])
        found |= {"text": text.removesuffix("\\t"), "severity": after["severity"].upper()}
    elif before := TEXT_BEFORE.search(code[: match.start()]):
        found["text"] = before[1].removesuffix("\\t")
    if modes := re.search(r"\((\w+_groups),", call):
        listed = re.search(rf"{modes[1]} = \(NavModes\)([^;]*);", code)
        names = re.findall(r"mode_req_(\w+)", listed[1]) if listed else ()
        found["needs"] = " ".join(names).upper()
    return found


def source(tree: Path) -> str:
    """Return tag, commit and date of a source tree."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(tree), *arguments],  # noqa: S607 (git from PATH)
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
    facts = {
        "version": f"{release}.0",
        "source": source(tree),
        "unknown_mode": UNKNOWN_MODE.get(release, "ACCEPTED"),
        "renamed": RENAMED.get(release, {}),
        "failsafes": failsafes(tree, release),
        "unknown_commands": unknown_commands(tree),
        **events(tree, release),
    }
    write_facts(folder / "release.toml", facts)
    print(f"{folder}: {len(rows)} parameters")


TABLES = {
    "renamed": "Names in this release, by the name in the current one.",
    "failsafes": "Rules of the failsafes, see FailsafeRules.",
    "unknown_commands": "Commands that this release does not support.",
    "events": "Events and texts that differ from the current release.",
}
"""Tables of `release.toml` and their comments."""


def write_facts(file: Path, facts: Mapping[str, Any]) -> None:
    """Write `release.toml`."""
    keys = ("version", "source", "unknown_mode", "mission_state")
    head = "".join(f"{key} = {json.dumps(facts[key])}\n" for key in keys)
    absent = "".join(f"    {json.dumps(name)},\n" for name in facts["unknown_events"])
    head += f"# Events of other releases.\nunknown_events = [\n{absent}]\n"
    tables = (_table(name, comment, facts[name]) for name, comment in TABLES.items())
    file.write_text(head + "".join(tables), encoding="utf-8")


def update_events(release: PX4ReleaseName, tree: Path) -> None:
    """Write the events of a release again from a source tree."""
    file = PX4 / release / "release.toml"
    write_facts(file, read_toml(file) | events(tree, release))


def main() -> int:
    """Write the release named on the command line."""
    if len(sys.argv) not in (3, 4) or not re.fullmatch(
        "|".join(get_args(PX4ReleaseName)), sys.argv[1]
    ):
        print(f"usage: px4_release.py {'|'.join(get_args(PX4ReleaseName))} TREE [LOG.ulg]")
        return 2
    release, (tree, *log) = cast("PX4ReleaseName", sys.argv[1]), sys.argv[2:]
    try:
        if log:
            write(release, Path(tree), Path(*log))
        else:
            update_events(release, Path(tree))
    except (OSError, UsageError, subprocess.CalledProcessError) as error:
        print(f"px4_release.py: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
