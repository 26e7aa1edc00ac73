"""Mutation score of the modules that a result rests on: python scripts/mutation.py [MODULE ...].

Each mutant changes one operator, constant, condition or statement inside a function. A forked
process replaces the code of this function and runs the module's tests; files stay as they are. A
mutant that passes all tests survives. mutation_equivalent.toml lists mutants without an effect.
"""

from __future__ import annotations

import ast
import gc
import io
import os
import random
import shlex
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NoReturn

import numpy as np
import pytest
import tyro

from airl_mav.profiles.loading import read_toml

ROOT = Path(__file__).resolve().parents[1]
EQUIVALENT = Path(__file__).with_name("mutation_equivalent.toml")

MODULES = {
    "validity": ("airl_mav/flight/judge.py", "unit/test_flight_judge.py unit/test_validity.py"),
    "sequential": (
        "airl_mav/flight/requirements.py",
        "unit/test_sequential.py unit/test_requirements.py",
    ),
    "paired": (
        "airl_mav/flight/statistics.py",
        "unit/test_paired.py unit/test_flight_statistics.py unit/test_statistics_edges.py",
    ),
    "injection": (
        "airl_mav/latency/injection.py",
        "unit/test_latency_injection.py unit/test_latency_samplers.py unit/test_latency_source.py",
    ),
    "signing": (
        "airl_mav/core/signing.py",
        "unit/test_signing.py firmware/test_mavlink_signing.py",
    ),
    "limits": ("companion/limits.py", "unit/test_limits.py unit/test_limit_rules.py"),
    "files": (
        "airl_mav/core/files.py",
        "unit/test_file_bounds.py unit/test_files.py unit/test_run_folder.py "
        "unit/test_log_file.py report/test_links.py "
        "'-knot kill_9 and not a_report and not machine and not checkout and not documentation'",
    ),
    "storage": (
        "firmware_sim/addons/ground_station_services/files.py",
        "unit/test_ftp_storage.py",
    ),
    "cascade": (
        "airl_mav/control/cascade.py",
        "unit/test_cascade.py unit/test_control_entries.py",
    ),
    "engine step": ("firmware_sim/engine/ticks.py", "firmware/test_engine_step.py"),
    "conductor": (
        "airl_mav/lockstep/conductor.py",
        # The others fly.
        "unit/test_conductor.py flight/test_lockstep.py '-kconductor or newest or repetitions or "
        "same_setpoint or leaving or offboard_again or wall_clock or pings or requests'",
    ),
    "safe velocity": (
        "airl_mav/envs/stopping.py",
        # The others fly, for seconds.
        "unit/test_stopping.py learning/test_safe_velocity.py "
        "'-kstopping or measured or bound or damaged or budget or longest or hull'",
    ),
}
"""Path of each module, and its tests below tests/."""

AS_PYTHON = {"cascade", "engine step"}
"""Modules of kernels, which run without Numba."""

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.USub: ast.UAdd,
}
"""Operators and their replacements."""


@dataclass
class Options:
    """Command line."""

    modules: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of modules; all if none are given."""
    mutants: int = 30
    """Mutants per module."""
    seed: int = 1
    """Seed of the sample."""
    required: float = 92.0
    """Minimum score of each module [%]."""


@dataclass(frozen=True)
class Mutant:
    """One change of one field of a syntax tree."""

    function: str
    line: int
    text: str
    """Source line, and the change."""
    node: ast.AST
    field: str
    value: Any

    def code(self, tree: ast.Module, path: Path) -> CodeType:
        """Return the code of the changed module."""
        old = getattr(self.node, self.field)
        setattr(self.node, self.field, self.value)
        try:
            return compile(ast.fix_missing_locations(tree), str(path), "exec")
        finally:
            setattr(self.node, self.field, old)


@dataclass
class Score:
    """Outcome of a module's mutants."""

    killed: int = 0
    equivalent: int = 0
    survivors: list[Mutant] = field(default_factory=list)

    @property
    def percent(self) -> float:
        """Share of killed mutants among those with an effect."""
        return 100.0 * self.killed / max(1, self.killed + len(self.survivors))


def changes(node: ast.AST) -> Iterator[tuple[ast.AST, str, Any]]:
    """Yield the changes of a node: the part that changes, its field, and the new value."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        if type(value) in SWAPS:
            yield node, name, SWAPS[type(value)]()
        if name == "ops" and type(value[0]) in SWAPS:
            yield node, name, [SWAPS[type(value[0])](), *value[1:]]
        if name == "test" and not isinstance(node, ast.Assert):
            yield node, name, ast.UnaryOp(ast.Not(), value)
        for place, part in enumerate(value if isinstance(value, list) else ()):
            if isinstance(part, ast.Expr | ast.Assign | ast.AugAssign | ast.Raise | ast.Continue):
                target = getattr(part, "targets", [None])[0]
                text = isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant)
                # Without a local name, most functions end in an error.
                if not isinstance(target, ast.Name | ast.Tuple) and not text:
                    yield node, name, [*value[:place], ast.Pass(), *value[place + 1 :]]
    if isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        yield node, "value", ast.Constant(None)
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield node, "value", not node.value
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield node, "value", node.value + 1


def parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and the parts of it that are executed."""
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list", "args") or isinstance(
            node, ast.Call
        ):
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, ast.AST):
                    yield from parts(part)


def mutants(tree: ast.Module, source: str) -> Iterator[Mutant]:
    """Yield all mutants of a module's functions."""
    lines = source.splitlines()

    def inside(body: list[ast.stmt], prefix: str) -> Iterator[Mutant]:
        for part in body:
            if isinstance(part, ast.ClassDef):
                yield from inside(part.body, f"{prefix}{part.name}.")
            elif isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef):
                for node in parts(part):
                    for changed, name, value in changes(node):
                        yield mutant(f"{prefix}{part.name}", changed, name, value)

    def mutant(function: str, node: ast.AST, name: str, value: Any) -> Mutant:
        old = getattr(node, name)
        line, new = getattr(node, "lineno", 0), value
        if isinstance(old, list) and name != "ops":
            (place,) = (i for i in range(len(old)) if old[i] is not value[i])
            line, new = old[place].lineno, "removed"
        elif isinstance(new, ast.expr):
            line, new = getattr(old, "lineno", line), ast.unparse(new)
        elif isinstance(new, ast.AST | list):
            new = type(new[0] if isinstance(new, list) else new).__name__
        text = f"{lines[line - 1].strip()}  ->  {new}"
        return Mutant(function, line, text, node, name, value)

    return inside(tree.body, "")


def functions_of(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of a module's functions and methods, without those inside functions."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            # A class body is the only code without fast local names.
            yield from functions_of(constant) if not constant.co_flags & 2 else [constant]


def install(code: CodeType, path: Path) -> None:
    """Replace the code of this process's functions of a module."""
    gc.unfreeze()  # tests/conftest.py hides what it has imported
    new = {(each.co_name, each.co_firstlineno): each for each in functions_of(code)}
    for each in gc.get_objects():
        if isinstance(each, FunctionType) and each.__code__.co_filename == str(path):
            key = each.__code__.co_name, each.__code__.co_firstlineno
            if key in new:
                each.__code__ = new[key]


def run_tests(words: list[str], limit_s: float, code: CodeType | None, path: Path) -> bool:
    """Run tests in a fork, with a mutant's code; return True if they pass in time."""
    if (pid := os.fork()) == 0:
        os.setsid()
        quiet = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(quiet, descriptor)
        if code is not None:
            install(code, path)
        os._exit(int(pytest.main(words)))
    try:
        ends = time.monotonic() + limit_s
        while time.monotonic() < ends:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                pid = 0
                return status == 0
            time.sleep(0.01)
        return False
    finally:
        if pid:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def name_fields() -> None:
    """Let Python read the fields of records as attributes, as compiled code does."""
    from firmware_sim.engine import record  # imports Numba

    for name, value in vars(record).copy().items():
        if isinstance(value, np.dtype):
            setattr(record, name, np.dtype((np.record, value)))


def fail(text: str) -> NoReturn:
    """End this process with a message."""
    print(text, flush=True)
    os._exit(1)


def score_of(name: str, options: Options, equivalent: dict[str, str]) -> Score:
    """Run the mutants of a module. Raises SystemExit if its tests fail without a mutant."""
    path, tests = ROOT / MODULES[name][0], shlex.split(MODULES[name][1])
    words = [test if test[0] == "-" else f"{ROOT}/tests/{test}" for test in tests]
    words += [
        "-x",
        "-q",
        "-n0",
        "--reruns=0",
        "-pno:cacheprovider",
        "-mnot nightly",
        "-Wignore::pytest.PytestAssertRewriteWarning",
    ]
    if name in AS_PYTHON:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
        name_fields()
    # Imports everything that the forks need.
    with redirect_stdout(io.StringIO()):
        collected = pytest.main([*words, "--collect-only"])
    if collected:
        fail(f"{name}: the tests cannot be collected")
    gc.enable()
    started = time.monotonic()
    if not run_tests(words, 600.0, None, path):
        fail(f"{name}: the tests fail without a mutant")
    took_s = time.monotonic() - started
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    found = list(mutants(tree, source))
    chance = random.Random(f"{options.seed} {name}")  # noqa: S311 (a sample)
    chosen = chance.sample(found, min(len(found), options.mutants))
    score = Score()
    for mutant in sorted(chosen, key=lambda each: each.line):
        if f"{mutant.function}: {mutant.text}" in equivalent:
            score.equivalent += 1
        elif run_tests(words, 10.0 + 4.0 * took_s, mutant.code(tree, path), path):
            score.survivors.append(mutant)
            place = f"{path.relative_to(ROOT)}:{mutant.line}"
            print(f"  {place} {mutant.function}: {mutant.text}", flush=True)
        else:
            score.killed += 1
    print(
        f"{name}: {score.percent:.0f} %: {score.killed} killed, {len(score.survivors)} survived, "
        f"{score.equivalent} equivalent, of {len(found)}; tests take {took_s:.1f} s",
        flush=True,
    )
    return score


def main() -> int:
    """Print the scores; return 1 if a module misses the required one."""
    options = tyro.cli(Options)
    equivalent = read_toml(EQUIVALENT)
    if unknown := set(options.modules) - MODULES.keys():
        raise SystemExit(f"{', '.join(unknown)}: accepted: {', '.join(MODULES)}")
    failed = 0
    for name in options.modules or tuple(MODULES):
        # A module's tests are imported in a process of their own.
        if (pid := os.fork()) == 0:
            score = score_of(name, options, equivalent.get(name, {}))
            os._exit(score.percent < options.required)
        failed |= os.waitpid(pid, 0)[1]
    return int(failed != 0)


if __name__ == "__main__":
    sys.exit(main())
