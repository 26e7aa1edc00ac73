"""Check size and prose of the packages, and their calls per tick, against scripts/budgets.toml.

    python scripts/check_budgets.py [--calls] [--lower]

`make lint` runs it without options; tests/flight/test_call_budgets.py checks the calls per tick.
Prints a line for each exceeded budget; exit status 1 if there is one. Budgets only fall: `--lower`
lowers budgets to smaller measured values, and adds missing budgets.
"""

from __future__ import annotations

import argparse
import ast
import sys
from pathlib import Path

import tomli_w
from plain_english import Prose, read_prose, source_files, statements

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
BUDGETS = ROOT / "scripts" / "budgets.toml"
PACKAGES = ("airl_mav", "companion", "firmware_sim")
PAGES = ("README.md", "docs")
SIZES = ("lines", "modules", "import_lines")

Table = dict[str, dict[str, float]]
"""Values by section (a package, a folder of pages, `product`, `calls_per_tick`) and name."""

HEADER = """\
# Upper limits of size, prose and calls per tick; `make lint` and `make test` check them.
# They only fall: `make budgets` lowers them to the measured values. Where code moves from one
# package to another, raise one budget by hand by what the other loses; [product] is their sum.

"""

CALLS = "calls_per_tick"
CALLS_SLACK = 0.02
"""Margin of calls per tick: Python 3.10 counts 1 % more than 3.11, a loaded host 0.5 % more."""

PROSE_REMEDY = "rewrite what `python scripts/plain_english.py {section} --worst 20` lists"
REMEDIES = {
    "lines": "delete as many lines as you add",
    "modules": "merge modules",
    "import_lines": "merge modules that import the same names",
    CALLS: "remove calls that `python benchmarks/bench_calls.py` lists",
}
"""Remedies by measure or section."""


def measure(root: Path) -> Table:
    """Return sizes and prose of the packages, and prose of the pages, below a folder."""
    table: Table = {"product": dict.fromkeys(SIZES, 0)}
    for package in PACKAGES:
        sizes, prose = size_and_prose(root / package)
        table[package] = {**sizes, **measure_prose(prose)}
        for name, value in sizes.items():
            table["product"][name] += value
    for page in PAGES:
        table[page] = measure_prose(read_prose(root / page))
    return table


def size_and_prose(folder: Path) -> tuple[dict[str, int], Prose]:
    """Return lines, modules and import lines of a package, and its prose."""
    sizes = dict.fromkeys(SIZES, 0)
    prose = Prose()
    for file in source_files(folder, "*.py"):
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        sizes["lines"] += text.count("\n")
        sizes["modules"] += 1
        for node in statements(tree):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                sizes["import_lines"] += (node.end_lineno or node.lineno) - node.lineno + 1
        prose.add_python(text, tree)
    return sizes, prose


def measure_prose(prose: Prose) -> dict[str, float]:
    """Return the measures of prose to one decimal."""
    return {name: round(value, 1) for name, value in prose.measures().items()}


def measure_calls() -> Table:
    """Return the calls per tick of the flights of benchmarks/bench_calls.py."""
    sys.path.append(str(ROOT / "benchmarks"))
    from bench_calls import FLIGHTS, calls_per_tick

    calls: dict[str, float] = {}
    for name, flight in FLIGHTS.items():
        calls |= calls_per_tick(name, flight())
    return {CALLS: calls}


def excess(measured: Table, budgets: Table) -> list[str]:
    """Return a line for each measured value above its budget, or without one."""
    lines = []
    for section, values in measured.items():
        for name, value in values.items():
            allowed = budgets.get(section, {}).get(name)
            slack = CALLS_SLACK if section == CALLS else 0.0
            if allowed is None:
                lines.append(f"{section}.{name}: {value} measured, no budget: run `make budgets`")
            elif value > allowed * (1.0 + slack):
                remedy = REMEDIES.get(name, REMEDIES.get(section, PROSE_REMEDY))
                lines.append(
                    f"{section}.{name}: {value} measured, {allowed} allowed: "
                    f"{remedy.format(section=section)}"
                )
    return lines


def lowered(measured: Table, budgets: Table) -> Table:
    """Return the budgets, lowered to smaller measured values, with missing ones added."""
    merged = {section: dict(values) for section, values in budgets.items()}
    for section, values in measured.items():
        section_budgets = merged.setdefault(section, {})
        for name, value in values.items():
            section_budgets[name] = min(value, section_budgets.get(name, value))
    return merged


def read_budgets(path: Path) -> Table:
    """Return the budgets of a file; empty without the file."""
    return tomllib.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def check(measured: Table, path: Path, *, lower: bool) -> int:
    """Print a line for each exceeded budget; return the exit status."""
    budgets = read_budgets(path)
    if lower:
        budgets = lowered(measured, budgets)
        path.write_text(HEADER + tomli_w.dumps(budgets), encoding="utf-8")
    lines = excess(measured, budgets)
    for line in lines:
        print(line)
    return int(bool(lines))


def main() -> int:
    parser = argparse.ArgumentParser(description="Check the budgets of scripts/budgets.toml.")
    parser.add_argument("--calls", action="store_true", help="measure calls per tick, too")
    parser.add_argument("--lower", action="store_true", help="lower budgets to the measured values")
    options = parser.parse_args()
    measured = measure(ROOT) | (measure_calls() if options.calls else {})
    return check(measured, BUDGETS, lower=options.lower)


if __name__ == "__main__":
    sys.exit(main())
