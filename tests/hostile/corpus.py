"""Corpus of hostile input: run folders, policies, profiles, logs, meshes, trainings, folders.

    python -m tests.hostile.corpus [WORD ...]

prints the outcome of each entry, or of entries with a WORD in their names. Entries are built before
they are read; the repository contains no hostile file.
"""

# Builders are lambdas with several steps and values of any type.
# mypy: disable-error-code="func-returns-value,misc,arg-type,assignment,import-untyped"

from __future__ import annotations

import io
import json
import math
import os
import pickle
import shutil
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.profiles.loading import profiles_dir
from airl_mav.report.comparison.comparison_model import SCHEMA as COMPARISON
from tests.hostile.reading import MARKUP, SCRIPT, Entry, Result, preload, read
from tests.support import hostile_policies
from tests.support.run_demo import write_demo_run

Build = Callable[[Path], object]

XSS, BREAK = MARKUP.decode(), SCRIPT.decode()
ESCAPES = "\x1b]0;hostile\x07\x1b[2J\x1b[31m"
OUTSIDE = Path("../../outside")
ZERO, FIFO = "/dev/zero", "FIFO"


@cache
def _base() -> Path:
    """Return a folder with a run; each process writes one."""
    folder = Path(tempfile.mkdtemp(prefix="hostile-base-"))
    # In a child: the compiler of kernels keeps its memory.
    child = os.fork()
    if child == 0:
        write_demo_run(folder / "run", episodes=1)
        os._exit(0)
    os.waitpid(child, 0)
    return folder


class Canary:
    """An object whose pickle writes a file outside."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("../../outside/canary",)


PICKLE = pickle.dumps(Canary(), protocol=2)
PAYLOAD = "import os; os.mkdir('../../outside/canary')\n"


# --- files


def link(path: Path, target: Path | str) -> None:
    """Replace a file by a link, or by a pipe."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    if target == FIFO:
        os.mkfifo(path)
    elif target == "folder":
        path.mkdir()
    elif target == "loop":
        path.symlink_to(path.name)
    elif target == "sparse":
        with path.open("wb") as file:
            file.truncate(40 << 30)
    elif str(target).startswith(str(OUTSIDE)):
        root = next(each.parent for each in path.parents if each.name == "sent")
        path.symlink_to(root / "outside" / Path(target).relative_to(OUTSIDE))
    else:
        path.symlink_to(str(target))


def deflated(megabytes: int) -> bytes:
    """Return a gigantic array of zeros as a compressed .npy member's content."""
    header = io.BytesIO()
    count = megabytes << 17
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (count,)}
    )
    return header.getvalue()


def bomb(path: Path, member: str, megabytes: int, *, more: int = 1) -> None:
    """Write an archive whose members inflate to many megabytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(more):
            name = member if more == 1 else f"{member}{k}"
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                stream.write(deflated(megabytes))
                for _ in range(megabytes):
                    stream.write(bytes(1 << 20))


def archive(path: Path, members: Mapping[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as made:
        for name, data in members.items():
            made.writestr(name, data)


def npy(array: Any, **options: Any) -> bytes:
    held = io.BytesIO()
    np.lib.format.write_array(held, np.asanyarray(array), **options)
    return held.getvalue()


def npy_header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    held = io.BytesIO()
    about = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_2_0(held, about)
    return held.getvalue() + bytes(64)


# --- run folders


def run_copy(folder: Path) -> Path:
    return Path(shutil.copytree(_base() / "run", folder / "run"))


def in_run(change: Callable[[Path], object]) -> Build:
    return lambda folder: change(run_copy(folder))


def text(name: str, content: Content) -> Build:
    return in_run(lambda run: (run / name).write_bytes(bytes_of(content)))


def plain(run: Path, name: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(
        (run / name).read_text().splitlines()[0 if "jsonl" in name else slice(None)]
        if "jsonl" in name
        else (run / name).read_text()
    )
    data.pop("crc32", None)
    return data


def put(data: dict[str, Any], field: str, value: Any) -> None:
    """Set a field by its dotted name."""
    *tables, last = field.split(".")
    for table in tables:
        data = data.setdefault(table, {})
    data[last] = value


def info(**fields: Any) -> Build:
    """Change fields of run.json; `__` stands for a dot."""

    def change(run: Path) -> None:
        data = plain(run, "run.json")
        for field, value in fields.items():
            put(data, field.replace("__", "."), value)
        (run / "run.json").write_text(json.dumps(data))

    return in_run(change)


def line(**fields: Any) -> Build:
    """Change fields of the flight's line."""

    def change(run: Path) -> None:
        data = plain(run, "episodes.jsonl")
        for field, value in fields.items():
            put(data, field.replace("__", "."), value)
        (run / "episodes.jsonl").write_text(json.dumps(data) + "\n")

    return in_run(change)


def lines(make: Callable[[dict[str, Any]], Iterator[str]]) -> Build:
    def change(run: Path) -> None:
        data = plain(run, "episodes.jsonl")
        with (run / "episodes.jsonl").open("w") as file:
            file.writelines(make(data))

    return in_run(change)


def without_crcs(run: Path) -> None:
    data = plain(run, "episodes.jsonl")
    for field in ("latency_crc32", "trajectory_crc32"):
        data.pop(field, None)
    (run / "episodes.jsonl").write_text(json.dumps(data) + "\n")


def arrays(name: str, members: Mapping[str, bytes] | None = None, **changes: Any) -> Build:
    """Replace arrays of an archive of the run, whose line does not name its CRC."""

    def change(run: Path) -> None:
        without_crcs(run)
        with np.load(run / name) as held:
            kept = {f"{each}.npy": npy(held[each]) for each in held.files}
        kept |= {f"000/{each}.npy": npy(value) for each, value in changes.items()}
        archive(run / name, kept | dict(members or {}))

    return in_run(change)


def bombed(name: str, megabytes: int, more: int = 1) -> Build:
    def change(run: Path) -> None:
        without_crcs(run)
        bomb(run / name, "000/position", megabytes, more=more)

    return in_run(change)


def many_members(run: Path) -> None:
    without_crcs(run)
    with zipfile.ZipFile(run / "latency.npz", "w") as made:
        for k in range(300_000):
            made.writestr(f"{k}/a.npy", b"")


def encrypted(run: Path) -> None:
    data = bytearray((run / "latency.npz").read_bytes())
    at = data.find(b"PK\x01\x02")
    data[at + 8] |= 1
    (run / "latency.npz").write_bytes(data)


def sized(run: Path) -> None:
    """Claim a size of 4 GB for a member of a few bytes."""
    data = bytearray((run / "latency.npz").read_bytes())
    at = data.find(b"PK\x01\x02")
    struct.pack_into("<I", data, at + 24, 0xFFFFFFF0)
    (run / "latency.npz").write_bytes(data)


def sealed_deep(levels: int) -> str:
    return '{"schema": 1, "config": ' + "[" * levels + "]" * levels + "}"


def comparison(**fields: Any) -> Build:
    """Write a comparison of two copies of the run by the command itself, then change its file."""

    def build(folder: Path) -> None:
        for name in ("a", "b"):
            shutil.copytree(_base() / "run", folder / name)
        data: dict[str, Any] = {
            "schema": COMPARISON,
            "kind": "compare",
            "title": "t",
            "runs": [{"name": "a", "folder": "a"}, {"name": "b", "folder": "b"}],
            "contrasts": [{"target": "b", "reference": "a"}],
        }
        for field, value in fields.items():
            put(data, field.replace("__", "."), value)
        (folder / "compare.json").write_text(json.dumps(data))

    return build


REPORT = ("report", "{d}/run")
EXPORT = ("export-log", "{d}/run", "--format", "ulog", "--out", "{d}/out")
MCAP = ("export-log", "{d}/run", "--out", "{d}/out")
DATA = ("export-data", "{d}/run", "--out", "{d}/out")
RESUME = ("evaluate", "no-obstacles", "--level", "gym", "--episodes", "1", "--out", "{d}/run")

FIELDS_OF_INFO = ("name", "created_utc", "setup", "config", "seeds", "versions", "machine", "git")
WRONG: tuple[Any, ...] = (None, [], {}, "x", -1, 1e308, True, [[[]]])
FIELDS_OF_LINE = {
    "index": (-1, 2**70, "0", 1.5),
    "arena": ("../../outside/secret", "/dev/zero", "a.py:b"),
    "arena_seed": (-1, 2**200),
    "outcome": ("crashed",),
    "goal": ([1e308, 1e308], [], [0.0] * 9),
    "started_us": (-(2**63), 2**63),
    "ended_us": (-1, 2**62),
    "navigation_us": (2**62,),
    "time_limit_s": (1e308, -1.0),
    "quality": ({}, [1]),
    "notes": ("x", [XSS] * 1000),
    "faults": ([{"fault": ESCAPES, "from_us": -1, "to_us": 2**62}],),
    "tours_s": (1e300,),
    "zone": (10**9,),
    "goal_radius_m": (-1.0, 1e308),
    "sha256": ({"flight": XSS},),
    "battery_remaining": (1e300,),
    "wall_s": (-1e300,),
}


def runs() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    for name in ("run.json", "episodes.jsonl", "latency.npz", "trajectories.npz"):
        for target in (OUTSIDE / "secret", ZERO, FIFO, "folder", "loop", "sparse"):
            yield (
                f"run: {name} is {Path(str(target)).name}",
                REPORT,
                in_run(lambda run, name=name, target=target: link(run / name, target)),
            )
    yield "run: is a link", REPORT, lambda folder: link(folder / "run", OUTSIDE)
    for levels in (150, 100_000):
        yield f"run: nested {levels} deep", REPORT, text("run.json", sealed_deep(levels))
        yield f"flight: nested {levels} deep", REPORT, text("episodes.jsonl", sealed_deep(levels))
    for what, value in {"NaN": "NaN", "overflow": "1e999", "digits": "9" * 100_000}.items():
        yield f"run: {what}", REPORT, text("run.json", f'{{"schema": 1, "seeds": [{value}]}}')
        yield f"flight: {what}", REPORT, text("episodes.jsonl", f'{{"schema": {value}}}\n')
    for what, data in {
        "NUL": b"\0" * 9_999,
        "UTF-16": '{"schema": 1}'.encode("utf-16"),
        "BOM": b"\xef\xbb\xbf{}",
        "bytes": bytes(range(256)),
        "empty": b"",
        "list": b"[]",
        "text": b'"x"',
        "80 MB of brackets": lambda: b"[" * (80 << 20),
        "80 MB of keys": lambda: b'{"' + b"a" * (80 << 20),
    }.items():
        yield f"run: {what}", REPORT, text("run.json", data)
    for field in FIELDS_OF_INFO:
        for value in (WRONG[len(field) % 4], WRONG[4 + len(field) % 4]):
            yield f"run: {field} = {value!r}", REPORT, info(**{field: value})
    for field, values in FIELDS_OF_LINE.items():
        for value in values:
            yield f"flight: {field} = {value!r}"[:44], REPORT, line(**{field: value})
    for what, word in {
        "markup": XSS,
        "script": BREAK,
        "escapes": ESCAPES,
        "bidi": "\u202egnp",
    }.items():
        yield (
            f"run: {what} in names",
            REPORT,
            info(
                name=word,
                setup__policy={"name": word, "description": word},
                setup__conditions=word,
                setup__vehicle={"name": "quad", "description": word},
                setup__firmware=word,
                setup__between_commands=word,
                versions={word: word},
                machine={word: word},
                git={"commit": word},
                config={word: word, "policy": word},
            ),
        )
        yield (
            f"flight: {what} in texts",
            REPORT,
            line(
                reason=word,
                notes=[word],
                invalid=[word],
                faults=[{"fault": word, "from_us": 0, "to_us": 1}],
            ),
        )
        yield f"export: {what} in texts", EXPORT, line(reason=word, notes=[word])
    yield "run: lone surrogate", REPORT, text("run.json", '{"schema": 1, "name": "\\ud800"}')
    yield "flight: lone surrogate", REPORT, line(reason="\ud800", notes=["\udfff"])
    yield "run: name of a megabyte", REPORT, info(setup__policy={"name": "x" * (1 << 20)})
    yield "flight: note of 10 MB", REPORT, line(notes=["x" * (10 << 20)])
    yield "flight: 100,000 notes", REPORT, line(notes=["x"] * 100_000)
    yield "run: a million seeds", REPORT, info(seeds=list(range(1_000_000)))
    yield (
        "run: vehicle is a device",
        REPORT,
        info(setup__vehicle={"name": ZERO, "description": ""}),
    )
    yield "run: vehicle is a pipe", REPORT, _with_pipe(info(setup__vehicle={"name": "pipe.toml"}))
    yield "flight: arena is a pipe", REPORT, _with_pipe(line(arena="pipe.toml"))
    yield "flight: arena with code", REPORT, _with_code
    yield "run: policy without an end", REPORT, _with_policy
    yield (
        "flight: a million lines",
        REPORT,
        lines(lambda d: (f"{json.dumps(d)}\n" for _ in range(60_000))),
    )
    yield (
        "flight: a million empty objects",
        REPORT,
        lines(lambda _: ('{"schema": 1}\n' for _ in range(4_000_000))),
    )
    yield (
        "flight: 3,000 flights",
        REPORT,
        lines(
            lambda d: (
                f"{json.dumps(d | {'index': k, 'latency_crc32': None, 'trajectory_crc32': None})}\n"
                for k in range(1_500)
            )
        ),
    )
    yield "flight: line of 150 MB", REPORT, lines(lambda _: iter(["x" * (150 << 20)]))
    yield "flight: torn line", REPORT, lines(lambda d: iter([f"{json.dumps(d)}\n", '{"schema']))
    yield "flight: line without its newline", REPORT, lines(lambda d: iter([json.dumps(d) + "x"]))
    yield "flight: empty lines", REPORT, lines(lambda d: iter([json.dumps(d) + "\n\n\n"]))
    for name in ("latency.npz", "trajectories.npz"):
        yield f"{name}: bomb of 1.5 GB", REPORT, bombed(name, 1_500)
        yield f"{name}: bomb of 40 members", REPORT, bombed(name, 100, 40)
        yield (
            f"{name}: pickle",
            REPORT,
            arrays(name, {"000/time_us.npy": npy_header((1,), "|O")[:-64] + PICKLE}),
        )
        yield (
            f"{name}: huge shape",
            REPORT,
            arrays(name, {"000/position.npy": npy_header((10**12,))}),
        )
        yield (
            f"{name}: overflowing shape",
            REPORT,
            arrays(name, {"000/position.npy": npy_header((2**40, 2**40))}),
        )
        yield f"{name}: names go up", REPORT, arrays(name, {"../../outside/x.npy": npy([1.0])})
        yield f"{name}: other types", REPORT, arrays(name, time_us=["a"], sent_us=["b"])
        yield (
            f"{name}: evil header",
            REPORT,
            arrays(
                name,
                {
                    "000/position.npy": b"\x93NUMPY\x01\x00\x76\x00"
                    + b"__import__('os').mkdir('../../outside/canary')".ljust(118)
                },
            ),
        )
    yield "latency.npz: many members", REPORT, in_run(many_members)
    yield "latency.npz: encrypted", REPORT, in_run(encrypted)
    yield "latency.npz: wrong size", REPORT, in_run(sized)
    yield (
        "latency.npz: NaN and ends of integers",
        REPORT,
        arrays("latency.npz", sent_us=[2**63 - 1, -(2**63)], capture_us=[0, 1]),
    )
    yield "latency.npz: no stamps", REPORT, arrays("latency.npz", sent_us=np.zeros((0, 3)))
    for what, changes in {
        "NaN": {"position": np.full((9, 3), math.nan), "time_us": np.arange(9)},
        "infinite": {"position": np.full((9, 3), 1e308), "time_us": np.arange(9)},
        "backwards": {"position": np.zeros((9, 3)), "time_us": np.arange(9)[::-1]},
        "one row": {"position": np.zeros((1, 3)), "time_us": np.zeros(1, np.int64)},
        "no row": {"position": np.zeros((0, 3)), "time_us": np.zeros(0, np.int64)},
        "ages": {"position": np.zeros((2, 3)), "time_us": np.array([0, 2**62])},
    }.items():
        n = len(changes["time_us"])
        whole = {
            "velocity": np.zeros((n, 3)),
            "quaternion": np.tile([1.0, 0, 0, 0], (n, 1)),
            "power_w": np.ones(n),
        } | changes
        for verb, words in {"report": REPORT, "export": EXPORT, "mcap": MCAP, "data": DATA}.items():
            yield f"{verb}: path is {what}", words, arrays("trajectories.npz", **whole)
    for name in ("flight-000.ulg", "flight-000.tlog"):
        for target in (OUTSIDE / "secret", ZERO, FIFO, "folder"):
            yield (
                f"export: {name} is {Path(str(target)).name}",
                EXPORT,
                in_run(lambda run, name=name, target=target: link(run / name, target)),
            )
    for name in ("report.html", "report.md", "verdict.json", "latency.png", "report.html.partial"):
        yield (
            f"report: {name} is a link",
            REPORT,
            in_run(lambda run, name=name: link(run / name, OUTSIDE / "secret")),
        )
    for what, value in {
        "nested": sealed_deep(5_000),
        "text": '"x"',
        "types": '{"schema": 1, "requirements": 3}',
    }.items():
        yield f"report: verdict.json is {what}", REPORT, text("verdict.json", value)
    yield "resume: folder x.partial", RESUME, in_run(lambda run: (run / "x.partial").mkdir())
    yield (
        "resume: folder flight-000.tlog.part",
        RESUME,
        in_run(lambda run: (run / "flight-000.tlog.part").mkdir()),
    )
    yield (
        "resume: scenario.toml is a link",
        RESUME,
        in_run(lambda run: link(run / "scenario.toml", OUTSIDE / "secret")),
    )
    for field, value in {
        "runs": [{"name": "a", "folder": "../../../outside"}],
        "kind": XSS,
        "title": XSS,
        "contrasts": [{"target": "z", "reference": "z"}],
        "schema": 99,
    }.items():
        yield f"comparison: {field}", ("report", "{d}"), comparison(**{field: value})
    yield (
        "comparison: names",
        ("report", "{d}/a", "{d}/b", "--names", XSS, ESCAPES, "--out", "{d}/out"),
        comparison(),
    )
    for name in ("hardware-gap", "matrix", "compare-levels", "latency-sweep"):
        yield (
            f"comparison: {name} of other types",
            ("report", "{d}"),
            lambda folder, name=name: (folder / f"{name}.json").write_text(
                f'{{"schema": {COMPARISON}, "runs": 7}}'
            ),
        )


def _with_pipe(build: Build) -> Build:
    def both(folder: Path) -> None:
        build(folder)
        os.mkfifo(folder / "pipe.toml")

    return both


def _with_code(folder: Path) -> None:
    arena = (profiles_dir() / "arenas" / "static-obstacles.toml").read_text()
    (folder / "mine.py").write_text(f"{PAYLOAD}\ndef generate(*_): ...\n")
    (folder / "mine.toml").write_text(f'generator = "mine.py:generate"\n{arena}')
    line(arena="mine.toml")(folder)


def _with_policy(folder: Path) -> None:
    policy = hostile_policies.write(folder, "endless")
    digest = json.loads((policy / "card.json").read_text())["sha256"]
    info(config__policy="endless", config__policy_sha256=digest)(folder)


# --- policies

FLY = (
    "evaluate",
    "{d}/p",
    "--level",
    "gym",
    "--episodes",
    "1",
    "--arena",
    "no-obstacles",
    "--out",
    "{d}/out",
)


def onnx_policy(nodes: Callable[[], Any] | bytes, **changes: Any) -> Build:
    def build(folder: Path) -> None:
        data = nodes if isinstance(nodes, bytes) else hostile_policies.model(nodes())
        hostile_policies.write_policy(folder / "p", data, **changes)

    return build


def external(location: str) -> Callable[[], Any]:
    """Return nodes whose tensor lies in another file."""
    from onnx import TensorProto

    def nodes() -> Any:
        tensor = TensorProto(name="far", data_type=TensorProto.FLOAT, dims=[25])
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=location)
        node = hostile_policies.node("Constant", "", "far", value=tensor)
        return [node, hostile_policies.node("Add", "scores far", "action")]

    return nodes


def nested_if(levels: int) -> Any:
    """Return nodes of branches in branches."""
    from onnx import helper

    out = helper.make_tensor_value_info("z", 1, None)
    inner = helper.make_graph([hostile_policies.node("Identity", "scores", "z")], "g", [], [out])
    for _ in range(levels):
        node = hostile_policies.node("If", "yes", "z", then_branch=inner, else_branch=inner)
        inner = helper.make_graph([node], "g", [], [out])
    return [
        hostile_policies.constant("yes", True, np.bool_),
        hostile_policies.node("If", "yes", "action", then_branch=inner, else_branch=inner),
    ]


def card_file(change: Callable[[Path], object]) -> Build:
    def build(folder: Path) -> None:
        onnx_policy(hostile_policies.MODELS["sound"])(folder)
        change(folder / "p")

    return build


def policies() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    for name, nodes in hostile_policies.MODELS.items():
        yield f"policy: {name}", FLY, onnx_policy(nodes)
    for location in ("../../outside/secret", "/etc/passwd", "secret", "etc/passwd", FIFO):
        yield f"policy: data in {location}", FLY, onnx_policy(external(location))
    for levels in (8, 60):
        yield (
            f"policy: {levels} nested branches",
            FLY,
            lambda folder, n=levels: onnx_policy(lambda: nested_if(min(n, 12)))(folder),
        )
    yield (
        "policy: 20,000 nodes",
        FLY,
        onnx_policy(
            lambda: [
                *(
                    hostile_policies.node("Sin", f"{'scores' if k == 0 else f's{k}'}", f"s{k + 1}")
                    for k in range(20_000)
                ),
                hostile_policies.node("Identity", "s20000", "action"),
            ]
        ),
    )
    for what, data in {
        "empty": b"",
        "garbage": bytes(range(256)) * 99,
        "text": b"x" * 9999,
        "nested groups": b"\x0a" * 200_000,
    }.items():
        yield f"policy: model is {what}", FLY, onnx_policy(data)
    yield (
        "policy: model is 200 MB of zeros",
        FLY,
        lambda folder: onnx_policy(bytes(200 << 20))(folder),
    )
    for target in (OUTSIDE / "secret", ZERO, FIFO, "folder", "sparse"):
        for name in ("policy.onnx", "card.json"):
            yield (
                f"policy: {name} is {Path(str(target)).name}",
                FLY,
                card_file(lambda p, name=name, target=target: link(p / name, target)),
            )
    sound = hostile_policies.MODELS["sound"]
    for what, changes in {
        "digest": {"sha256": "0" * 64},
        "digest path": {"sha256": "../../x"},
        "giant image": {"observation": {"height_px": 10**9, "width_px": 10**9}},
        "large image": {
            "observation": {
                "layout": "body",
                "height_px": 4096,
                "width_px": 4096,
                "horizontal_fov_deg": 90.0,
                "range_m": 20.0,
            }
        },
        "giant memory": {"state": {"h": [10**12]}},
        "deep memory": {"state": {"h": [2] * 90}},
        "code of a layout": {"observation": {"layout": "os:system"}},
        "code of actions": {"actions": {"set": "mine.py:Mine"}},
        "name": {"name": "../../outside"},
        "markup": {"name": XSS},
        "description": {"description": ESCAPES + XSS},
        "macs": {"macs": 10**400},
        "types": {"training": []},
        "epsilon": {"epsilon": 2.0},
        "results": {"results": [{}] * 100_000},
        "speed": {"actions": {"set": "arc-25", "max_speed_m_s": 1e308}},
    }.items():
        yield f"policy: card with {what}", FLY, onnx_policy(sound, **changes)
    yield (
        "policy: card nested",
        FLY,
        card_file(lambda p: (p / "card.json").write_text('{"schema":1,"x":' + "[" * 90_000)),
    )
    yield (
        "policy: card of 90 MB",
        FLY,
        card_file(
            lambda p: (p / "card.json").write_text('{"schema":1,"x":"' + "x" * (90 << 20) + '"}')
        ),
    )
    torch = (*FLY, "--runtime", "torch")
    yield "policy: torch program is a pickle", torch, lambda folder: _torch(folder, PICKLE)
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as made:
        made.writestr("archive/data.pkl", PICKLE)
    yield (
        "policy: torch archive is a pickle",
        torch,
        lambda folder: _torch(folder, zipped.getvalue()),
    )
    yield (
        "policy: Python by name",
        ("evaluate", "mine.py"),
        lambda folder: (folder / "mine.py").write_text(PAYLOAD),
    )
    for what, words in {"model": (), "model in integers": ("--int8",)}.items():
        yield (
            f"export: pickled {what}",
            ("export", "{d}/m.zip", "--algorithm", "DQN", "--out", "{d}/o", *words),
            lambda folder: archive(
                folder / "m.zip",
                {
                    "data": json.dumps(
                        {
                            "policy_class": {
                                ":type:": "a",
                                ":serialized:": __import__("base64").b64encode(PICKLE).decode(),
                            }
                        }
                    ).encode(),
                    "policy.pth": PICKLE,
                },
            ),
        )
    yield (
        "export: pickled statistics",
        (
            "export",
            "{d}/m.zip",
            "--algorithm",
            "DQN",
            "--vec-normalize",
            "{d}/s.pkl",
            "--out",
            "{d}/o",
        ),
        lambda folder: (
            archive(folder / "m.zip", {"data": b"{}"}),
            (folder / "s.pkl").write_bytes(PICKLE),
        ),
    )
    yield (
        "export: endless policy",
        ("export", "{d}/p", "--decisions", "pipelined", "--out", "{d}/o"),
        onnx_policy(hostile_policies.MODELS["endless"]),
    )


def _torch(folder: Path, data: bytes) -> None:
    import hashlib

    onnx_policy(hostile_policies.MODELS["sound"], torch_sha256=hashlib.sha256(data).hexdigest())(
        folder
    )
    (folder / "p" / "policy.pt2").write_bytes(data)


# --- profiles


def toml(kind: str, name: str, **lines_: str) -> Build:
    """Write a shipped profile with changed lines; a key that is missing is put on top."""

    def build(folder: Path) -> None:
        held = (profiles_dir() / kind / f"{name}.toml").read_text().splitlines()
        for key, value in lines_.items():
            found = [k for k, each in enumerate(held) if each.partition("=")[0].strip() == key]
            new = f"{key} = {value}"
            held = [new, *held] if not found else [*held[: found[0]], new, *held[found[0] + 1 :]]
        (folder / "mine.toml").write_text("\n".join(held) + "\n")

    return build


Content = bytes | str | Callable[[], bytes]
"""Content of a file; a function makes a large one when it is written."""


def bytes_of(content: Content) -> bytes:
    if isinstance(content, str):
        return content.encode()
    return content if isinstance(content, bytes) else content()


def raw(name: str, data: Content) -> Build:
    return lambda folder: (folder / name).write_bytes(bytes_of(data))


def profiles() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    arena = ("arena", "{d}/mine.toml")
    vehicle = ("parameters", "px4", "--vehicle", "{d}/mine.toml")
    for target in (OUTSIDE / "secret", ZERO, FIFO, "folder", "loop", "sparse"):
        yield (
            f"arena: file is {Path(str(target)).name}",
            arena,
            lambda folder, t=target: link(folder / "mine.toml", t),
        )
    for what, data in {
        "nested": "a = " + "[" * 5_000 + "]" * 5_000,
        "nested tables": "[" + ".".join("a" * 20_000) + "]",
        "digits": "a = " + "9" * 1_000_000,
        "keys": "\n".join(f"k{k} = 1" for k in range(40_000)),
        "quotes": 'a = """' + "x" * 900_000,
        "NUL": b"\0" * 99,
        "date": "a = 9999-99-99",
    }.items():
        yield f"arena: {what}", arena, raw("mine.toml", data)
    for key, value in {
        "north_m": "1e308",
        "east_m": "nan",
        "height_m": "-1",
        "count_period": "0",
        "min_clearance_m": "inf",
        "zones_m": "[1e300]",
        "description": f'"{XSS}\\u001b]0;hostile\\u0007\\u001b[2J"',
        "generator": '"mine.py:make"',
        "base": '"../../outside/secret"',
        "wall_colour": "[1e9, -1, nan]",
    }.items():
        yield (
            f"arena: {key} = {value}"[:44],
            arena,
            toml("arenas", "static-obstacles", **{key: value}),
        )
    yield (
        "arena: a billion obstacles",
        arena,
        lambda folder: _obstacles(folder, "[1000000000, 1000000000]"),
    )
    yield (
        "arena: a hundred thousand obstacles",
        arena,
        lambda folder: _obstacles(folder, "[100000, 100000]"),
    )
    for file in ("../../outside/secret", "/etc/passwd", "/dev/zero", "pipe.toml"):
        yield (
            f"arena: mesh in {file}",
            arena,
            lambda folder, file=file: _mesh_arena(folder, file, b""),
        )
    yield "arena: mesh is a bomb", arena, lambda folder: _mesh_arena(folder, "mesh.npz", None)
    yield "arena: mesh is a pickle", arena, lambda folder: _mesh_arena(folder, "mesh.npz", PICKLE)
    for key, value in {
        "mass_kg": "1e308",
        "width_px": "1000000000",
        "cells": "-1",
        "rate_hz": "1e300",
        "thrust_max_n": "nan",
        "description": f'"{ESCAPES!a}"'.replace("'", "").replace("\\x", "\\u00"),
    }.items():
        yield f"vehicle: {key}", vehicle, toml("vehicles", "quad", **{key: value})
    for what, data in {
        "letters": "x\n" * 99,
        "30 million numbers": lambda: b"1\n" * 30_000_000,
        "NaN": "nan\n",
    }.items():
        yield (
            f"latency file: {what}",
            (
                "evaluate",
                "no-obstacles",
                "--level",
                "gym",
                "--episodes",
                "1",
                "--latency",
                "{d}/l.txt",
                "--out",
                "{d}/out",
            ),
            raw("l.txt", data),
        )
    for what, data in {
        "faults": "[[faults]]\n" * 50_000,
        "path": 'policy = "../../outside"',
        "episodes": "episodes = 99999999999999999999",
    }.items():
        yield (
            f"scenario: {what}",
            ("sitl", "{d}/mine.toml", "--level", "gym"),
            raw("mine.toml", data),
        )
    yield (
        "training: huge network",
        ("train", "{d}/mine.toml", "--out", "{d}/out", "--steps", "1"),
        raw("mine.toml", "[network]\nhidden = [1000000000, 1000000000]\n"),
    )
    yield (
        "sweep: nested",
        ("sweep", "{d}/mine.toml", "--dry-run"),
        raw("mine.toml", "a = " + "[" * 5_000),
    )


def _obstacles(folder: Path, count: str) -> None:
    toml("arenas", "static-obstacles")(folder)
    text_ = (folder / "mine.toml").read_text()
    import re

    (folder / "mine.toml").write_text(re.sub(r"(?m)^count = .*$", f"count = {count}", text_))


def _mesh_arena(folder: Path, file: str, data: bytes | None) -> None:
    import hashlib

    if file == "pipe.toml":
        os.mkfifo(folder / file)
    if file == "mesh.npz":
        if data is None:
            bomb(folder / file, "vertices", 1_500)
        else:
            (folder / file).write_bytes(data)
    digest = (
        hashlib.sha256((folder / file).read_bytes()).hexdigest() if file == "mesh.npz" else "0" * 64
    )
    (folder / "mine.toml").write_text(
        'base = "static-obstacles"\n[static]\nshapes = ["thing"]\n[assets.thing]\n'
        f'mesh = {{ file = "{file}", sha256 = "{digest}" }}\n[[assets.thing.parts]]\n'
        'shape = "box"\nlength_m = 1.0\nwidth_m = 1.0\nheight_m = 1.0\nforward_m = 0.0\n'
        "right_m = 0.0\n"
    )


# --- logs


def ulog(*messages: tuple[bytes, bytes]) -> bytes:
    body = b"".join(struct.pack("<HB", len(data), kind[0]) + data for kind, data in messages)
    return b"ULog\x01\x12\x35\x01" + bytes(8) + body


def black_box(run: Any = None, payload: bytes = b"", kind: str = "Phase", count: int = 1) -> Build:
    def build(folder: Path) -> None:
        from airl_mav.black_box import messages
        from airl_mav.black_box.mcap_file import BlackBoxFile
        from tests.unit.test_black_box import MESSAGES, NOW_US, RUN

        whole = {**plain(_base() / "run", "run.json"), "config": RUN["config"]}
        file = BlackBoxFile(folder / "box.mcap", whole | (run or {}))
        for k, message in enumerate(MESSAGES):
            file.write(message, NOW_US + k)
        channel = messages.encoded(messages.Phase(5, "x"))[0]
        for _ in range(count if payload else 0):
            file.add(channel, payload, NOW_US)
        file.finish()

    return build


def chunked(megabytes: int, compression: str) -> Build:
    """Write an MCAP file with a chunk that inflates."""

    def build(folder: Path) -> None:
        import lz4.frame
        import zstandard

        data = bytes(1 << 20)
        if compression == "zstd":
            squeeze = zstandard.ZstdCompressor().compressobj(size=megabytes << 20)
            packed = b"".join(squeeze.compress(data) for _ in range(megabytes)) + squeeze.flush()
        else:
            with lz4.frame.LZ4FrameCompressor() as lz:
                packed = (
                    lz.begin() + b"".join(lz.compress(data) for _ in range(megabytes)) + lz.flush()
                )
        body = struct.pack("<QQQI", 0, 0, megabytes << 20, 0)
        name = compression.encode()
        body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
        black_box()(folder)
        whole = (folder / "box.mcap").read_bytes()
        at = 8 + 9 + struct.unpack_from("<Q", whole, 9)[0]
        (folder / "box.mcap").write_bytes(
            whole[:at] + b"\x06" + struct.pack("<Q", len(body)) + body + whole[at:]
        )

    return build


def logs() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    box, log = (
        ("report", "{d}/box.mcap"),
        ("identify", "{d}/log.ulg", "--vehicle", "quad", "--out", "{d}/out"),
    )
    for words in (
        box,
        ("identify", "{d}/box.mcap", "--out", "{d}/out"),
        ("rehearse-flight", "{d}/box.mcap"),
        ("export-log", "{d}/box.mcap", "--out", "{d}/out"),
    ):
        yield f"{words[0]}: box of a few records", words, black_box()
    for target in (OUTSIDE / "secret", ZERO, FIFO, "folder", "sparse"):
        yield (
            f"box: is {Path(str(target)).name}",
            box,
            lambda folder, t=target: link(folder / "box.mcap", t),
        )
        yield (
            f"log: is {Path(str(target)).name}",
            log,
            lambda folder, t=target: link(folder / "log.ulg", t),
        )
    yield (
        "box: folder beside it is a link",
        box,
        lambda folder: (black_box()(folder), link(folder / "box", OUTSIDE)),
    )
    for compression in ("zstd", "lz4"):
        yield f"box: bomb of 1.5 GB, {compression}", box, chunked(3_000, compression)
    for what, run in {
        "no run": {},
        "text": {"name": XSS, "config": XSS},
        "nested": {"config": json.loads("[" * 900 + "]" * 900)},
        "goal": {"name": "x", "config": {"goal": [1e308, 1e308], "seed": -1, "speed": 0}},
        "escapes": {
            "name": ESCAPES,
            "config": {
                "goal": [20.0, 0.0],
                "seed": 1,
                "speed": 1.0,
                "pilot": {"hold_s": 0.5, "goal_radius_m": 3.0},
                "limits": {"flight_s": 600.0},
            },
            "setup": {"policy": {"name": ESCAPES}},
        },
    }.items():
        yield f"box: run with {what}", box, black_box(run)
    for what, payload in {
        "nested": b'{"time_us":' + b"[" * 100_000,
        "overflow": b'{"time_us":1e999,"phase":"x"}',
        "digits": b'{"time_us":' + b"9" * 5_000_000 + b"}",
        "markup": b'{"time_us":6,"phase":"' + MARKUP + b'"}',
        "30 MB": b'{"time_us":6,"phase":"' + b"x" * (30 << 20) + b'"}',
    }.items():
        yield f"box: message with {what}", box, black_box(payload=payload)
    yield (
        "box: 500,000 messages",
        box,
        black_box(payload=b'{"time_us":6,"phase":"navigating"}', count=500_000),
    )
    yield (
        "box: truncated",
        box,
        lambda folder: (black_box()(folder), os.truncate(folder / "box.mcap", 900)),
    )
    growing = [(b"F", f"t{k}:t{k + 1}[1000] a;".encode()) for k in range(9)]
    flat = [
        (b"F", b"vehicle_attitude:uint64_t timestamp;t0[1000] q;"),
        *growing,
        (b"F", b"t9:float x;"),
    ]
    subscribed = (b"A", struct.pack("<BH", 0, 1) + b"vehicle_attitude")
    for what, data in {
        "empty": b"",
        "header": ulog(),
        "garbage": ulog() + bytes(range(256)) * 99,
        "nested formats": ulog(*flat, subscribed, (b"D", struct.pack("<H", 1) + bytes(60_000))),
        "format of itself": ulog(
            (b"F", b"vehicle_attitude:uint64_t timestamp;vehicle_attitude[9] a;"),
            subscribed,
            (b"D", struct.pack("<H", 1) + bytes(90)),
        ),
        "long array": ulog(
            (b"F", b"vehicle_attitude:uint64_t timestamp;float[999999999] q;"),
            subscribed,
            (b"D", struct.pack("<H", 1) + bytes(90)),
        ),
        "parameters": ulog(
            *[(b"P", struct.pack("<B", 9) + b"float " + b"abc" + bytes(4))] * 200_000
        ),
        "texts": ulog(*[(b"L", b"6" + bytes(8) + ESCAPES.encode())] * 50_000),
        "negative array": ulog(
            (b"F", b"vehicle_attitude:uint64_t timestamp;float[-5] q;"),
            subscribed,
            (b"D", struct.pack("<H", 1) + bytes(90)),
        ),
        "zero sizes": ulog(*[(b"D", b"")] * 100_000),
    }.items():
        yield f"log: {what}", log, raw("log.ulg", data)


# --- meshes


def glb(document: Mapping[str, Any], binary: bytes = b"") -> bytes:
    text_ = json.dumps(document).encode()
    text_ += b" " * (-len(text_) % 4)
    chunks = struct.pack("<II", len(text_), 0x4E4F534A) + text_
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def scene(count: int, uri: str | None = None, nodes: Any = None) -> dict[str, Any]:
    buffer: dict[str, Any] = {"byteLength": 12 * 3}
    if uri is not None:
        buffer["uri"] = uri
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [buffer],
    }


def stl(triangles: Any) -> bytes:
    rows = np.zeros(len(triangles), np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]))
    rows["v"] = triangles
    return bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes()


def meshes() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    def asset(name: str, data: Content) -> tuple[tuple[str, ...], Build]:
        return ("asset", f"{{d}}/{name}", "--out", "{d}/out.toml"), raw(name, data)

    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    rng = np.random.default_rng(1)
    cycle = [{"mesh": 0, "children": [1]}, {"children": [0]}]
    tree = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    for what, (name, data) in {
        "stl count": ("m.stl", bytes(80) + struct.pack("<I", 2**32 - 1)),
        "stl count, few bytes": ("m.stl", bytes(80) + struct.pack("<I", 10**6) + bytes(50)),
        "stl NaN": ("m.stl", stl([np.full_like(corner, np.nan)])),
        "stl infinite": ("m.stl", stl([np.full_like(corner, np.inf)])),
        "stl 1e38": ("m.stl", stl([corner * 1e38])),
        "stl flat": ("m.stl", stl([corner * 0.0])),
        "stl 10,000 large triangles": ("m.stl", stl(np.tile(corner[None] * 19.0, (10_000, 1, 1)))),
        "stl 300,000 triangles": ("m.stl", lambda: stl(rng.random((300_000, 3, 3)))),
        "stl a million needles": (
            "m.stl",
            lambda: stl(np.tile(corner[None] * [19.0, 1e-6, 1], (1_000_000, 1, 1))),
        ),
        "stl text": ("m.stl", "solid x\n" + "facet normal 0 0 0\n" * 200_000),
        "obj index": ("m.obj", "v 0 0 0\nf 1 2 999999999\n"),
        "obj negative": ("m.obj", "v 0 0 0\nf -1 -2 -3\n"),
        "obj material outside": (
            "m.obj",
            "mtllib ../../outside/secret\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n",
        ),
        "obj material device": (
            "m.obj",
            "mtllib /dev/zero\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n",
        ),
        "obj long face": ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + "1 2 3 " * 500_000 + "\n"),
        "obj NaN": ("m.obj", "v nan inf 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        "obj million points": ("m.obj", "v 1 1 1\n" * 1_000_000),
        "obj letters": ("m.obj", "v a b c\nf x y z\n"),
        "ply count": (
            "m.ply",
            "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n",
        ),
        "ply binary count": (
            "m.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty double x\nproperty double y\nproperty double z\nend_header\n",
        ),
        "ply lists": (
            "m.ply",
            b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uint uint vertex_indices\nend_header\n\xff\xff\xff\xff",
        ),
        "ply type": (
            "m.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty os.system x\nend_header\n0\n",
        ),
        "off count": ("m.off", "OFF\n999999999 999999999 0\n"),
        "off empty": ("m.off", "OFF\n0 0 0\n"),
        "glb count": ("m.glb", glb(scene(10**9), corner.tobytes())),
        "glb file outside": ("m.glb", glb(scene(3, "../../outside/secret"))),
        "glb absolute file": ("m.glb", glb(scene(3, "/etc/passwd"))),
        "glb device": ("m.glb", glb(scene(3, "/dev/zero"))),
        "glb cycle": ("m.glb", glb(scene(3, nodes=cycle), corner.tobytes())),
        "glb itself": (
            "m.glb",
            glb(scene(3, nodes=[{"mesh": 0, "children": [0]}]), corner.tobytes()),
        ),
        "glb doubling tree": ("m.glb", glb(scene(3, nodes=tree), corner.tobytes())),
        "glb data of a megabyte": (
            "m.glb",
            glb(scene(3, "data:application/octet-stream;base64," + "A" * (1 << 20))),
        ),
        "glb length": (
            "m.glb",
            struct.pack("<4sII", b"glTF", 2, 2**32 - 1) + struct.pack("<II", 2**32 - 1, 0x4E4F534A),
        ),
        "gltf file outside": ("m.gltf", json.dumps(scene(3, "../../outside/secret"))),
        "gltf device": ("m.gltf", json.dumps(scene(3, "/dev/zero"))),
        "gltf nested": ("m.gltf", '{"asset":' + "[" * 100_000),
        "empty": ("m.obj", ""),
        "pickle": ("m.stl", PICKLE),
        "picture": (
            "m.glb",
            glb(
                scene(3)
                | {
                    "images": [{"uri": "../../outside/secret"}],
                    "textures": [{"source": 0}],
                    "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
                },
                corner.tobytes(),
            ),
        ),
    }.items():
        yield f"mesh: {what}", *asset(name, data)
    for target in (OUTSIDE / "secret", ZERO, FIFO, "folder", "sparse"):
        for kind in ("stl", "obj"):
            yield (
                f"mesh: .{kind} is {Path(str(target)).name}",
                ("asset", f"{{d}}/m.{kind}", "--out", "{d}/out.toml"),
                lambda folder, t=target, k=kind: link(folder / f"m.{k}", t),
            )


# --- trainings


def training(change: Callable[[Path], object]) -> Build:
    def build(folder: Path) -> None:
        from airl_mav.core import files
        from airl_mav.training.training_folder import TrainRequest

        config = TrainRequest(config="static-obstacles", steps=1).configured()
        out = folder / "t"
        out.mkdir()
        about = {"schema": 1, "config": config.model_dump(mode="json", exclude_none=True)}
        files.write_json(out / "train.json", about)
        change(out)

    return build


def checkpoint(weights: bytes, arrays_: Build | None = None, state: str = "{}") -> Build:
    """Write a checkpoint whose digests are right."""

    def change(out: Path) -> None:
        import hashlib

        folder = out / "checkpoints" / "checkpoint-1"
        folder.mkdir(parents=True)
        (folder / "weights.pt").write_bytes(weights)
        (folder / "state.json").write_text(state)
        if arrays_ is None:
            np.savez(folder / "arrays.npz", a=np.zeros(1))
        else:
            arrays_(folder)
        digests = {
            name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
            for name in ("weights.pt", "arrays.npz", "state.json")
        }
        (folder / "manifest.json").write_text(json.dumps({"schema": 1, "files": digests}))

    return training(change)


def trainings() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    words = ("train", "static-obstacles", "--steps", "1", "--resume", "--out", "{d}/t")
    yield "training: weights are a pickle", words, checkpoint(PICKLE)
    yield "training: state nested", words, checkpoint(b"", state="[" * 100_000)
    yield (
        "training: arrays are a bomb",
        words,
        checkpoint(b"", lambda folder: bomb(folder / "arrays.npz", "a", 1_500)),
    )
    yield (
        "training: newest is outside",
        words,
        training(
            lambda t: (
                (t / "checkpoints").mkdir(),
                (t / "checkpoints" / "latest").write_text("../../../../outside"),
            )
        ),
    )
    for target in (OUTSIDE, ZERO, FIFO):
        yield (
            f"training: link to {Path(str(target)).name} in checkpoints",
            words,
            training(lambda t, target=target: link(t / "checkpoints" / "checkpoint-1", target)),
        )
    yield (
        "training: train.json types",
        words,
        training(lambda t: (t / "train.json").write_text('{"schema": 1, "config": 3}')),
    )
    yield (
        "training: train.json is a device",
        words,
        training(lambda t: link(t / "train.json", ZERO)),
    )
    yield (
        "training: evaluations of other types",
        words,
        training(lambda t: (t / "evaluations.jsonl").write_text('{"steps": "x"}\n')),
    )


# --- folders with modules named like the packages


def modules(*names: str) -> Build:
    def build(folder: Path) -> None:
        run_copy(folder)
        hostile_policies.write(folder, "sound")
        for name in names:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(PAYLOAD)

    return build


MODULES = (
    "numpy.py",
    "airl_mav/__init__.py",
    "json.py",
    "multiprocessing/__init__.py",
    "onnxruntime.py",
    "sitecustomize.py",
    "usercustomize.py",
    "resource.py",
    "signal.py",
    "companion/__init__.py",
    "matplotlibrc.py",
)


def folders() -> Iterator[tuple[str, tuple[str, ...], Build]]:
    yield "folder with modules: report", ("report", "run"), modules(*MODULES)
    yield (
        "folder with modules: a policy",
        tuple(word.replace("{d}/p", "sound") for word in FLY),
        modules(*MODULES),
    )
    yield (
        "folder with modules: workers",
        (
            "evaluate",
            "no-obstacles",
            "--level",
            "lockstep",
            "--episodes",
            "2",
            "--workers",
            "2",
            "--out",
            "out",
        ),
        modules(*MODULES),
    )
    yield (
        "folder with modules: sitl",
        (
            "sitl",
            "--policy",
            "no-obstacles",
            "--arena",
            "no-obstacles",
            "--no-validity",
            "--speed",
            "8",
            "--out",
            "out",
        ),
        modules(*MODULES),
    )


KINDS = (runs, policies, profiles, logs, meshes, trainings, folders)


def corpus() -> list[Entry]:
    """Return all entries."""
    return [
        Entry(name, words, build, alone=kind is folders)
        for kind in KINDS
        for name, words, build in kind()
    ]


def main() -> None:
    preload()
    failed = 0
    for number, entry in enumerate(corpus()):
        if sys.argv[1:] and not any(word in entry.name for word in sys.argv[1:]):
            continue
        with tempfile.TemporaryDirectory(prefix="hostile-", ignore_cleanup_errors=True) as root:
            result: Result = read(entry, Path(root))
        failed += bool(result.problems)
        print(f"{number:3d} {result.row()}", flush=True)
    print(f"{failed} failed")


if __name__ == "__main__":
    main()
