"""Fly real firmware and the built-in flight controller through one bench, and print the drift.

    python scripts/real_firmware.py 1.17=/opt/px4-1.17 main=~/PX4-Autopilot deb=px4-sitl.deb \
        copter=~/ardupilot --out drift

A firmware is a build of PX4, its source tree, package or .deb, or ArduCopter's program or tree.
Each part writes a file in the folder; the same command continues with the missing ones. The table
is drift.md, all figures are in drift.json.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from airl_mav.addons.conformance.result import Reference, deviations
from airl_mav.addons.conformance.telemetry import StepResponse
from airl_mav.core.child_process import ChildProcess, terminated_as_interrupted
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, EXIT_USAGE, UsageError
from airl_mav.flight.statistics import Estimate, compare_pairs
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName, stored_release, version_name
from airl_mav.rehearsal.run_folder import load
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, RealFirmware
from firmware_sim.external.programs import check_free, firmware_kind

ROOT = Path(__file__).resolve().parents[1]
POLICIES = ("static-obstacles-fast", "body-rates")
ATTEMPTS = 3
"""Maximum number of instances that are tried."""
READY_S = 240.0
"""Timeout of a firmware's start [wall s]."""
PART_S = 3600.0
"""Timeout of one program of a part [wall s]."""
BUSY = 1.5
"""Load per core above which real-time parts run at half speed."""


@dataclass(frozen=True)
class Command:
    """Fly real firmware and the built-in flight controller, and print the drift."""

    firmwares: tyro.conf.Positional[tuple[str, ...]]
    """NAME=PATH of each firmware."""

    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("drift")
    """Folder for the results."""

    parts: tuple[str, ...] = ()
    """Parts to fly; by default all."""

    policies: tuple[str, ...] = POLICIES
    """Policies of the paired flights."""

    seeds: int = 20
    """Paired flights of each policy, from seed 1 on."""

    flights: int = 4
    """Flights of the step responses."""

    speed: float | None = None
    """Simulated seconds per wall second of conformance; by default 1, or 0.5 on a busy host."""

    test_speed: float = 3.0
    """Simulated seconds per wall second of the walk and of PX4's tests."""

    instance: int = 0
    """First instance that is tried."""


@dataclass(frozen=True)
class Firmware:
    """Firmware of the bench."""

    name: str
    kind: str = "builtin"
    """Value of `--firmware`."""
    path: Path | None = None
    release: str | None = None
    """PX4's release that the built-in flight controller flies; None = its default."""

    @property
    def options(self) -> list[str]:
        """Command-line options of airl-firmware and airl evaluate."""
        release = [] if self.release is None else ["--px4-release", self.release]
        if self.path is None:
            return release
        return ["--firmware", self.kind, f"--{self.kind}-dir", str(self.path)]


def firmware_of(word: str, out: Path) -> Firmware:
    """Return the firmware of NAME=PATH; a .deb is unpacked. Raises UsageError."""
    name, equals, text = word.partition("=")
    path = Path(text).expanduser().resolve()
    if not (equals and name and text) or name.startswith("builtin") or "/" in name:
        raise UsageError(f"{word}: accepted: NAME=PATH, as 1.17=/opt/px4")
    if path.suffix == ".deb":
        package, path = path, out / name / "package"
        if not path.exists():
            unpack(package, path)
    reasons = []
    for kind in ("px4", "ardupilot"):
        try:
            firmware_kind(kind).check_program(RealFirmware.model_validate({f"{kind}_dir": path}))
        except UsageError as error:
            reasons.append(str(error))
        else:
            return Firmware(name, kind, path)
    raise UsageError(f"{name}: {'; '.join(reasons)}")


def unpack(package: Path, folder: Path) -> None:
    """Unpack a Debian package. Raises UsageError."""
    program = shutil.which("dpkg-deb")
    if program is None:
        raise UsageError(f"{package}: needs dpkg-deb; unpack it, and give its folder")
    temporary = folder.with_suffix(".partial")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    done = subprocess.run(
        [program, "-x", str(package), str(temporary)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise UsageError(f"{package}: {done.stderr.strip()}")
    temporary.rename(folder)


# --- running firmware and programs


class PartError(Exception):
    """A part could not be flown; the message says why."""


@dataclass(frozen=True)
class Vehicle:
    """Firmware that runs."""

    port: int
    """UDP port that receives its MAVLink."""
    system: int


def free_instance(first: int) -> int:
    """Return the first instance with free ports. Raises PartError."""
    for instance in range(first, GREATEST_INSTANCE + 1):
        with suppress(UsageError, OSError):
            check_free(instance)
            for port in (14540 + instance, 9002 + 10 * instance):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
                    trial.bind(("", port))
            return instance
    raise PartError(f"no instance from {first} on has free ports")


@contextmanager
def flying(command: Command, firmware: Firmware, speed: float) -> Iterator[Vehicle]:
    """Run a firmware with its vehicle in an open field. Raises PartError."""
    first = command.instance
    with ExitStack() as held:
        for left in reversed(range(ATTEMPTS)):
            instance = free_instance(first)
            try:
                vehicle = held.enter_context(started(command, firmware, speed, instance))
                break
            except PartError:
                # Another program may have taken the instance.
                first = instance + 1
                if not left:
                    raise
        yield vehicle


@contextmanager
def started(command: Command, firmware: Firmware, speed: float, instance: int) -> Iterator[Vehicle]:
    """Run a firmware on the ports of an instance. Raises PartError."""
    folder, port = command.out / firmware.name, 14540 + instance
    log = folder / "firmware.log"
    log.unlink(missing_ok=True)
    argv = [
        *(sys.executable, "-m", "airl_mav.cli.firmware_command", "--arena", "open-field"),
        *("--instance", str(instance), "--speed", f"{speed:g}", *firmware.options),
    ]
    if firmware.kind == "ardupilot":
        argv += ["--api-port", str(port)]
    if firmware.path is not None:
        argv += ["--firmware-log", str(folder / "autopilot.log")]
    with closing_child(ChildProcess(argv, log, guarded=True, cwd=ROOT)) as child:
        deadline = time.monotonic() + READY_S
        while "Ctrl-C ends it" not in log.read_text(errors="replace"):
            if child.poll() is not None or time.monotonic() > deadline:
                raise PartError(f"{firmware.name} did not start: {child.log_tail()}")
            time.sleep(0.1)
        yield Vehicle(port, 1 if firmware.kind == "ardupilot" else instance + 1)


@contextmanager
def closing_child(child: ChildProcess) -> Iterator[ChildProcess]:
    """End a child at the end of the context."""
    try:
        yield child
    finally:
        child.stop()


def run(argv: Sequence[str], log: Path, *, accepted: Sequence[int] = (0,)) -> int:
    """Run a program of this project to its end; return its exit status. Raises PartError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    log.unlink(missing_ok=True)
    with closing_child(ChildProcess([sys.executable, *argv], log, guarded=True, cwd=ROOT)) as child:
        deadline = time.monotonic() + PART_S
        while (exited := child.poll()) is None:
            if time.monotonic() > deadline:
                raise PartError(f"took more than {PART_S:g} s: {child.log_tail()}")
            time.sleep(0.1)
    if exited.code not in accepted:
        raise PartError(f"{exited}: {child.log_tail()}")
    return exited.code


# --- parts: each returns plain data


def identity(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Return version and git hash of AUTOPILOT_VERSION."""
    with flying(command, firmware, 1.0) as vehicle:
        return read_version(vehicle)


def read_version(vehicle: Vehicle) -> dict[str, Any]:
    """Request AUTOPILOT_VERSION. Raises PartError."""
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{vehicle.port}", source_system=245)
    with closing(link):
        # The vehicle's address is known from its first datagram.
        if (beat := link.wait_heartbeat(timeout=30.0)) is None:
            raise PartError("no heartbeat")
        for _ in range(20):
            link.mav.command_long_send(
                *(beat.get_srcSystem(), 1, dialect.MAV_CMD_REQUEST_MESSAGE, 0),
                *(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0),
            )
            found = link.recv_match(type="AUTOPILOT_VERSION", blocking=True, timeout=2.0)
            if found is not None:
                return version_of(found.flight_sw_version, bytes(found.flight_custom_version))
    raise PartError("AUTOPILOT_VERSION is not answered")


def version_of(number: int, custom: bytes) -> dict[str, Any]:
    """Return a version by AUTOPILOT_VERSION's flight_sw_version and flight_custom_version.

    PX4 sends the first 8 bytes of its git hash as an integer, ArduPilot 8 letters.
    """
    text = custom.rstrip(b"\0").decode(errors="replace")
    letters = bool(text) and all(letter in "0123456789abcdef" for letter in text)
    return {
        "version": version_name(number),
        "number": number,
        "git": text if letters else custom[::-1].hex()[:10],
    }


def steps(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Return step responses in lockstep, by the true state and by telemetry."""
    folder = command.out / firmware.name
    argv = ["scripts/firmware_steps.py", "--seeds", str(command.flights)]
    if firmware.path is not None:
        argv += ["--px4-dir", str(firmware.path)]
    elif firmware.release is not None:
        argv += ["--px4-release", firmware.release]
    found = {name: folder / f"steps-{name}.partial" for name in ("true", "estimated")}
    argv += ["--json", str(found["true"]), "--estimated", str(found["estimated"])]
    run(argv, folder / "steps.log")
    return {name: read(file) for name, file in found.items()}


def conformance(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Return the result of airl conformance, without the steps of the part `steps`."""
    folder, speed = command.out / firmware.name, speed_of(command)
    found = folder / "conformance.partial.json"
    argv = ["-m", "airl_mav.cli.main", "conformance", "--speed", f"{speed:g}"]
    if firmware.kind in PARTS["steps"][1]:
        argv.append("--skip-steps")
    with flying(command, firmware, speed) as vehicle:
        argv += ["--connect", f"udpin://127.0.0.1:{vehicle.port}", "--out", str(found)]
        run(argv, folder / "conformance.log", accepted=(0, 1))
    return dict(read(found))


def speed_of(command: Command) -> float:
    """Return the speed of parts that measure times."""
    if command.speed is not None:
        return command.speed
    return 0.5 if os.getloadavg()[0] > BUSY * (os.cpu_count() or 1) else 1.0


def walk(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Return the answers of the walk."""
    folder = command.out / firmware.name
    found = folder / "walk.partial.json"
    with flying(command, firmware, command.test_speed) as vehicle:
        argv = ["scripts/px4_walk.py", "--slow", "--json", str(found), *where(vehicle)]
        run(argv, folder / "walk.log", accepted=(0, 1))
    return {"answers": read(found)}


def where(vehicle: Vehicle) -> list[str]:
    """Return the options of a script that connects to a vehicle."""
    return [
        *("--connect", f"udpin://127.0.0.1:{vehicle.port}"),
        *("--system", str(vehicle.system)),
    ]


def tests(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Return the outcomes of PX4's tests; each has a vehicle that has just booted."""
    script, folder = "scripts/px4_mavsdk_tests.py", command.out / firmware.name / "tests"
    folder.mkdir(exist_ok=True)
    run([script, "--list"], folder / "list.log")
    outcomes = []
    for number, name in enumerate((folder / "list.log").read_text().splitlines()):
        found = folder / f"{number:02d}.json"
        if not found.exists():
            partial = found.with_suffix(".partial")
            with flying(command, firmware, command.test_speed) as vehicle:
                argv = [script, "--test", name, "--json", str(partial), *where(vehicle)]
                run(argv, folder / f"{number:02d}.log", accepted=(0, 1))
            partial.rename(found)
        outcomes += read(found)
    return {"tests": outcomes}


def paired(command: Command, firmware: Firmware) -> dict[str, Any]:
    """Fly the seeds of the paired flights in lockstep; return the goals of each policy."""
    goals = {}
    for policy in command.policies:
        folder = command.out / firmware.name / f"paired-{policy}"
        argv = [
            *("-m", "airl_mav.cli.main", "evaluate", policy, "--level", "lockstep"),
            *("--episodes", str(command.seeds), "--seed", "1", "--workers", "1"),
            *("--out", str(folder), *firmware.options),
        ]
        run(argv, folder.with_suffix(".log"))
        episodes = load(folder).episodes
        reached = sum(each.outcome.value == "success" for each in episodes)
        goals[policy] = {"goals": reached, "flights": len(episodes)}
    return goals


PARTS: Mapping[str, tuple[Callable[[Command, Firmware], dict[str, Any]], tuple[str, ...]]] = {
    "identity": (identity, ("builtin", "px4", "ardupilot")),
    "steps": (steps, ("builtin", "px4")),
    "paired": (paired, ("builtin", "px4")),
    "conformance": (conformance, ("builtin", "px4", "ardupilot")),
    "walk": (walk, ("builtin", "px4")),
    "tests": (tests, ("builtin", "px4")),
}
"""Function of each part, and the kinds of firmware that have it. ArduPilot has no lockstep, and
neither PX4's calls nor its tests."""


# --- the table


Results = Mapping[str, Any]
"""Data of a firmware, by part; a missing part was not flown."""


@dataclass(frozen=True)
class Row:
    """Row of the table: a figure of the real firmware, and of the built-in one beside it."""

    figure: str
    real: str
    builtin: str = ""


SILENT = ("no ack", "TIMEOUT", "NO_SYSTEM", "CONNECTION_ERROR")
"""Outcomes of a call without an answer."""


@dataclass(frozen=True)
class Agreement:
    """Answers of two firmwares to the same calls."""

    calls: int
    comparable: int
    """Calls that both answered, or that neither answered."""
    agree: int
    differences: tuple[str, ...]


def agreement(real: Sequence[Results], builtin: Sequence[Results]) -> Agreement:
    """Compare the answers to the calls made to both firmwares."""
    other = {answer["name"]: answer for answer in builtin}
    pairs = [(each, other[each["name"]]) for each in real if each["name"] in other]

    def silent(answer: Results) -> bool:
        return str(answer["outcome"]).startswith(SILENT)

    def equal(a: Results, b: Results) -> bool:
        return (a["outcome"], a["agrees"]) == (b["outcome"], b["agrees"])

    comparable = [(a, b) for a, b in pairs if silent(a) == silent(b)]
    different = tuple(
        f"{a['name']}: {_answer(a)}, built-in {_answer(b)}" for a, b in pairs if not equal(a, b)
    )
    same = sum(equal(a, b) for a, b in comparable)
    return Agreement(len(pairs), len(comparable), same, different)


def _answer(answer: Results) -> str:
    value = "" if answer["value"] is None else f" {answer['value']}"
    return f"{answer['outcome']}{value}"


FIGURES = {
    "latency_s": ("latency", 1e3, "ms"),
    "rise_s": ("rise", 1e3, "ms"),
    "overshoot_percent": ("overshoot", 1.0, "%"),
}
"""Name, scale and unit of the compared figures of a step."""


def step_rows(real: Results, builtin: Results | None) -> list[Row]:
    """Return the rows of the step responses, with the difference of the real firmware."""
    rows = []
    for step, figures in real.items():
        for key, (name, scale, unit) in FIGURES.items():
            value = scale * figures[key]
            text, beside = f"{value:.{0 if scale > 1 else 1}f} {unit}", ""
            if builtin is not None:
                other = scale * builtin[step][key]
                beside = f"{other:.{0 if scale > 1 else 1}f} {unit}"
                apart = f"{value - other:+.1f} points"
                if scale > 1.0 and other:
                    apart = f"{100.0 * (value / other - 1.0):+.1f} %"
                text += f" ({apart})"
            rows.append(Row(f"{step} {name}", text, beside))
    return rows


def judged_steps(estimated: Results, number: int) -> Row:
    """Return the row of the steps that differ from the stored column of the release."""
    column, title = stored_release("PX4", number)
    reference = load_profile("conformance", column, Reference)
    outside = []
    for name, stored in reference.steps.items():
        if name not in estimated:
            continue
        found = deviations(StepResponse(**estimated[name]), stored, reference.tolerance)
        outside += [f"{name} {each}" for each in found]
    text = title if ":" in title else reference.title
    return Row("steps beyond the stored column", f"{text}: {'; '.join(outside) or 'none'}")


def outcome_row(name: str, real: Mapping[str, bool], builtin: Mapping[str, bool] | None) -> Row:
    """Return a row of checks or tests; True = passed."""

    def text(passed: Mapping[str, bool]) -> str:
        failed = ", ".join(each for each in passed if not passed[each])
        return f"{sum(passed.values())} of {len(passed)}{': ' if failed else ''}{failed}"

    return Row(name, text(real), "" if builtin is None else text(builtin))


def checks_of(data: Results) -> dict[str, bool]:
    """Return the checks of airl conformance, by name; True = passed or not applicable."""
    return {check["name"]: check["outcome"] != "fail" for check in data["checks"]}


def tests_of(data: Results, number: int) -> dict[str, bool]:
    """Return the tests of a release's behaviour, by name; True = passed."""
    release = number >> 16
    return {
        each["name"]: each["passed"]
        for each in data["tests"]
        if each["since"][0] << 8 | each["since"][1] <= release
    }


def percent(estimate: Estimate) -> str:
    """Return a difference with its interval."""
    if estimate.value is None or estimate.low is None or estimate.high is None:
        return "–"
    return f"{estimate.value:+.1f} % [{estimate.low:+.1f}, {estimate.high:+.1f}]"


def paired_rows(folder: Path, builtin: Path) -> list[Row]:
    """Return the rows of the paired flights in two run folders."""
    real, other = load(folder).episodes, load(builtin).episodes
    found = compare_pairs(other, real)
    a, policy = found.agreement, folder.name.partition("-")[2]
    rows = [
        Row(
            f"{policy} goals",
            f"{a.both + a.only_other} of {a.n}",
            f"{a.both + a.only_reference} of {a.n}",
        )
    ]
    for name, change, unit in (
        ("flight time", found.flight_time_s, "s"),
        ("distance", found.distance_m, "m"),
        ("energy", found.energy_j, "J"),
    ):
        if change.other is None or change.reference is None:
            continue
        rows.append(
            Row(
                f"{policy} {name}",
                f"{change.other:.4g} {unit} ({percent(change.difference)})",
                f"{change.reference:.4g} {unit}",
            )
        )
    return rows


def rows_of(out: Path, name: str, real: Results, beside: str, builtin: Results) -> list[Row]:
    """Return the table's rows of one firmware, beside those of a built-in one."""
    if "identity" not in real:
        return []
    other, title = builtin.get("identity"), "{version} ({git})"
    text, number = title.format(**real["identity"]), real["identity"]["number"]
    rows = [Row("version", text, title.format(**other) if other else "")]
    if found := real.get("steps"):
        rows += step_rows(found["true"], builtin["steps"]["true"] if "steps" in builtin else None)
        rows.append(judged_steps(found["estimated"], number))
    if found := real.get("paired"):
        for policy in found:
            folders = [out / each / f"paired-{policy}" for each in (name, beside)]
            if all((folder / "run.json").exists() for folder in folders):
                rows += paired_rows(*folders)
    if found := real.get("conformance"):
        other = builtin.get("conformance")
        beside_it = None if other is None else checks_of(other)
        rows.append(outcome_row("conformance checks", checks_of(found), beside_it))
    if (found := real.get("walk")) and (other := builtin.get("walk")):
        same = agreement(found["answers"], other["answers"])
        share = 100.0 * same.agree / max(same.comparable, 1)
        text = f"{same.agree} of {same.comparable} comparable calls agree ({share:.1f} %)"
        rows.append(Row("walk", text, f"{same.calls} calls"))
    if found := real.get("tests"):
        flown = [tests_of(each, number) for each in (found, builtin.get("tests")) if each]
        rows.append(outcome_row("PX4's tests", flown[0], flown[1] if len(flown) > 1 else None))
    return rows


def table(columns: Mapping[str, Sequence[Row]], beside: Mapping[str, str]) -> str:
    """Return the table in Markdown: a row for each figure, two columns for each firmware."""
    names = list(columns)
    figures = list(dict.fromkeys(row.figure for rows in columns.values() for row in rows))
    heads = [text for name in names for text in (name, beside[name])]
    lines = [f"| figure | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for figure in figures:
        cells = []
        for name in names:
            row = next((row for row in columns[name] if row.figure == figure), Row(figure, "–"))
            cells += [row.real, row.builtin or "–"]
        lines.append(f"| {figure} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def report(out: Path, firmwares: Sequence[Firmware], builtins: Mapping[str, Firmware]) -> str:
    """Write drift.json and drift.md, and return the latter."""
    held = {each.name: results_of(out, each) for each in (*firmwares, *builtins.values())}
    columns: dict[str, list[Row]] = {}
    beside: dict[str, str] = {}
    data: dict[str, dict[str, Any]] = {}
    for firmware in firmwares:
        name, other = firmware.name, builtins[firmware.name].name
        columns[name] = rows_of(out, name, held[name], other, held[other])
        beside[name] = other
        same = None
        if "walk" in held[name] and "walk" in held[other]:
            same = agreement(held[name]["walk"]["answers"], held[other]["walk"]["answers"])
        data[name] = {
            "kind": firmware.kind,
            "builtin": other,
            "rows": [asdict(row) for row in columns[name]],
            "walk": None if same is None else asdict(same),
        }
    details = ""
    for name, each in data.items():
        lines = [*(each["walk"] or {}).get("differences", ())]
        for owner in (name, each["builtin"]):
            lines += [
                f"{owner}: {test['name']}: {test['finding']}"
                for test in held[owner].get("tests", {}).get("tests", ())
                if not test["passed"]
            ]
            lines += [
                f"{owner}: {check['name']}: {check['finding']}"
                for check in held[owner].get("conformance", {}).get("checks", ())
                if check["outcome"] == "fail"
            ]
        if lines:
            details += f"\n## {name}\n\n" + "".join(f"- {line}\n" for line in lines)
    text = table(columns, beside) + details
    (out / "drift.json").write_text(json.dumps({**data, "parts": held}, indent=1) + "\n")
    (out / "drift.md").write_text(text, encoding="utf-8")
    return text


# --- the command


def read(path: Path) -> Any:
    """Return the contents of a file of this bench."""
    return json.loads(path.read_text(encoding="utf-8"))


def results_of(out: Path, firmware: Firmware) -> dict[str, Any]:
    """Return the parts that were flown."""
    files = {part: out / firmware.name / f"{part}.json" for part in PARTS}
    return {part: read(file) for part, file in files.items() if file.exists()}


def fly_part(command: Command, firmware: Firmware, part: str) -> bool:
    """Fly a part unless its file exists; return False if it failed."""
    function, kinds = PARTS[part]
    file = command.out / firmware.name / f"{part}.json"
    if firmware.kind not in kinds or file.exists():
        return True
    file.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    print(f"{firmware.name}: {part} ...", flush=True)
    try:
        data = function(command, firmware)
    except (PartError, UsageError) as error:
        print(f"{firmware.name}: {part} failed: {error}", flush=True)
        return False
    temporary = file.with_suffix(".new")
    temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    temporary.rename(file)
    print(f"{firmware.name}: {part} done in {time.monotonic() - began:.0f} s", flush=True)
    return True


def builtin_for(out: Path, firmware: Firmware) -> Firmware:
    """Return the built-in flight controller of the nearest release."""
    file = out / firmware.name / "identity.json"
    if firmware.kind != "px4" or not file.exists():
        return Firmware(f"builtin-{CURRENT}", release=CURRENT)
    number = read(file)["number"] >> 16
    release = min(get_args(PX4ReleaseName), key=lambda name: abs(_number(name) - number))
    return Firmware(f"builtin-{release}", release=release)


def _number(release: str) -> int:
    major, minor = map(int, release.split("."))
    return major << 8 | minor


def main(command: Command) -> int:
    """Fly what is missing, and print the table."""
    out = command.out.resolve()
    command = replace(command, out=out)
    out.mkdir(parents=True, exist_ok=True)
    parts = command.parts or tuple(PARTS)
    try:
        for part in parts:
            if part not in PARTS:
                raise UsageError(f"--parts {part}: accepted: {', '.join(PARTS)}")
        firmwares = [firmware_of(word, out) for word in command.firmwares]
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE
    good, code = True, 0
    builtins: dict[str, Firmware] = {}
    try:
        with terminated_as_interrupted():
            for firmware in firmwares:
                good &= fly_part(command, firmware, "identity")
                builtins[firmware.name] = builtin_for(out, firmware)
            flown = [*dict.fromkeys(builtins.values()), *firmwares]
            for part in dict.fromkeys(("identity", *parts)):
                for firmware in flown:
                    good &= fly_part(command, firmware, part)
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    if len(builtins) == len(firmwares):
        print(report(out, firmwares, builtins), end="")
    return code or (0 if good else EXIT_BROKEN)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
