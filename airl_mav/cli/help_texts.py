"""Help texts of commands: `--help` shows the most used options, `--help-all` all of them."""

from __future__ import annotations

import inspect
import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from airl_mav.cli.options import POSITIONAL, PREFIXED, REPEATED, meaning_of, metavar_of, option_of
from airl_mav.core.fields import COMMON, GROUPS, Group
from airl_mav.scenario.aircraft import IN_WORDS

FEW = 16
"""Number of options up to which `--help` shows all of them."""

INDENT = 24
"""Column of the meanings."""

TYPES = {int: "N", float: "NUMBER", Path: "PATH"}
"""Placeholder of a value by its type; TEXT for others."""


@dataclass(frozen=True)
class Option:
    """An option in a help text."""

    usage: str
    """Option with a placeholder of its value; for a positional, the placeholder alone."""
    meaning: str
    """Meaning and range, as sentences."""
    default: str
    """Default value; empty = none."""
    group: str
    is_common: bool
    is_positional: bool


def help_text(model: type[BaseModel], prog: str, *, everything: bool) -> str:
    """Return the help of a command: usage, purpose, examples, options.

    Args:
        model: Options of the command; its docstring is the purpose, with examples.
        prog: Command.
        everything: True to show all options by group, and the complete purpose.
    """
    options = list(options_in(model))
    positionals = [each for each in options if each.is_positional]
    options = [each for each in options if not each.is_positional]
    purpose, _, examples = (inspect.getdoc(model) or "").partition("Examples:\n")
    width = max(60, min(shutil.get_terminal_size().columns, 100))
    usage = " ".join(["usage:", prog, *(each.usage for each in positionals), "[OPTIONS]"])
    paragraphs = purpose.strip().split("\n\n")
    lines = [usage, ""]
    for paragraph in paragraphs if everything else paragraphs[:1]:
        lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""]
    lines += ["Examples:", *examples.rstrip().splitlines()]
    shown = options if everything or len(options) <= FEW else [o for o in options if o.is_common]
    shown.sort(key=lambda each: (GROUPS.index(each.group), not each.is_common))
    if not everything:
        lines += ["", "Options:"]
        lines += (line for o in (*positionals, *shown) for line in _lines(o, width, brief=True))
        lines += ["", f"--help-all explains all {len(options)} options."]
        return "\n".join(lines)
    for group in dict.fromkeys(each.group for each in (*positionals, *shown)):
        lines += ["", f"{group.capitalize()}:"]
        members = (o for o in (*positionals, *shown) if o.group == group)
        lines += (line for o in members for line in _lines(o, width))
    return "\n".join(lines)


def options_in(
    model: type[BaseModel], prefix: str = "", parent: str = GROUPS[0]
) -> Iterator[Option]:
    """Yield the options of a model; `parent` is the group of models without a group."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        group, is_common = _place(model, name, parent)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from options_in(kind, f"{name}." if name in PREFIXED else "", group)
            continue
        is_positional = POSITIONAL in field.metadata
        usage = _usage(prefix + name, field)
        if is_positional:
            usage = metavar_of(name, kind)
            usage = usage if field.is_required() or usage[0] == "[" else f"[{usage}]"
        yield Option(usage, meaning_of(field), _default(field), group, is_common, is_positional)


def _place(model: type[BaseModel], name: str, parent: str) -> tuple[str, bool]:
    """Return the group of a field, from its first definition, and whether it is common."""
    defined = [
        kind
        for kind in reversed(model.__mro__)
        if issubclass(kind, BaseModel) and name in kind.model_fields
    ]
    marks = [mark for kind in defined for mark in kind.model_fields[name].metadata]
    own = [mark.name for mark in marks if isinstance(mark, Group)]
    return (*own, vars(defined[0]).get("GROUP", parent))[0], COMMON in marks


def _usage(name: str, field: FieldInfo) -> str:
    option = option_of(name)
    kind: Any = field.annotation
    if get_origin(kind) in (Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    if kind is bool:
        return option if field.default is False else f"{option}, --no-{option[2:]}"
    if REPEATED in field.metadata or IN_WORDS in field.metadata:
        return f"{option} TEXT"
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        one = _placeholder(parts[0])
        return f"{option} " + (f"{one} ..." if Ellipsis in parts else " ".join([one] * len(parts)))
    return f"{option} {_placeholder(kind)}"


def _placeholder(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    kind = next(iter(get_args(kind)), kind)
    return TYPES.get(kind, "TEXT")


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required() or value in (None, False, ()) or isinstance(value, BaseModel):
        return ""
    shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "yes" if value is True else shown


def _lines(option: Option, width: int, *, brief: bool = False) -> list[str]:
    """Return the lines of an option; `brief` shows the first clause of its meaning."""
    meaning = option.meaning
    if brief:
        meaning = meaning.removesuffix(".").partition("; ")[0].partition(". ")[0]
    if option.default:
        meaning += f" (default: {option.default})" if brief else f" Default: {option.default}."
    lines = textwrap.wrap(meaning, width - INDENT, break_on_hyphens=False)
    first = f"  {option.usage}"
    if len(first) > INDENT - 2:
        return [first, *(" " * INDENT + line for line in lines)]
    return [first.ljust(INDENT) + lines[0], *(" " * INDENT + line for line in lines[1:])]
