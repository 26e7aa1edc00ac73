"""Help texts of commands: `--help` shows the most used options, `--help-all` all of them."""

from __future__ import annotations

import inspect
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from airl_mav.cli.options import POSITIONAL, PREFIXED, REPEATED, meaning_of, metavar_of, option_of
from airl_mav.core.fields import COMMON, GROUPS
from airl_mav.scenario.aircraft import IN_WORDS

FEW = 16
"""Number of options up to which `--help` shows all of them."""

INDENT = 24
"""Column of the meanings."""

TYPES = {int: "N", float: "NUMBER", Path: "PATH"}
"""Placeholder of a value by its type; TEXT for others."""


class Option(NamedTuple):
    """An option in a help text; without "--" in `usage`, a positional."""

    usage: str
    meaning: str
    default: str
    group: str
    is_common: bool


def help_text(model: type[BaseModel], prog: str, *, everything: bool) -> str:
    """Return the help of a command; `everything` = complete purpose, all options by group."""
    options = list(options_in(model))
    named = [each for each in options if each.usage.startswith("--")]
    purpose, _, examples = (inspect.getdoc(model) or "").partition("Examples:\n")
    width = max(60, min(shutil.get_terminal_size().columns, 100))
    words = ["usage:", prog, *(each.usage for each in options if each not in named), "[OPTIONS]"]
    lines = [" ".join(words)]
    for paragraph in purpose.strip().split("\n\n")[: None if everything else 1]:
        lines += ["", *textwrap.wrap(" ".join(paragraph.split()), width)]
    lines += ["", "Examples:", *examples.rstrip().splitlines()]
    hidden = [] if everything or len(named) <= FEW else [o for o in named if not o.is_common]
    options.sort(key=lambda o: (o in named, GROUPS.index(o.group), not o.is_common))
    title = ""
    for option in (each for each in options if each not in hidden):
        heading = f"{option.group.capitalize()}:" if everything else "Options:"
        lines += [] if heading == title else ["", heading]
        lines += _lines(option, width, brief=not everything)
        title = heading
    return "\n".join([*lines, "", f"--help-all explains all {len(named)} options."])


def options_in(
    model: type[BaseModel], table: str = "", parent: str = GROUPS[0]
) -> Iterator[Option]:
    """Yield the options of a model; `parent` is the group of models without a group."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        held = [k.model_fields for k in model.__mro__[::-1] if issubclass(k, BaseModel)]
        marks = [mark for fields in held if name in fields for mark in fields[name].metadata]
        first = next(k for k in model.__mro__[::-1] if name in getattr(k, "model_fields", ()))
        groups = [mark for mark in marks if isinstance(mark, str) and mark in GROUPS]
        group = (*groups, vars(first).get("GROUP", parent))[0]
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from options_in(kind, f"{name}." if name in PREFIXED else "", group)
        elif POSITIONAL in field.metadata:
            usage = metavar_of(name, kind)
            usage = usage if field.is_required() or usage[0] == "[" else f"[{usage}]"
            yield Option(usage, meaning_of(field), _default(field), GROUPS[0], is_common=True)
        else:
            usage = _usage(option_of(table + name), field)
            yield Option(usage, meaning_of(field), _default(field), group, COMMON in marks)


def _usage(option: str, field: FieldInfo) -> str:
    kind: Any = field.annotation
    if get_origin(kind) in (Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    if kind is bool:
        return option if field.default is False else f"{option}, --no-{option[2:]}"
    if get_origin(kind) is tuple and not {REPEATED, IN_WORDS} & {*map(str, field.metadata)}:
        parts = get_args(kind)
        count = 1 if Ellipsis in parts else len(parts)
        return " ".join(
            [option, *[_placeholder(parts[0])] * count, "..."][: count + 2 - (count > 1)]
        )
    return f"{option} {_placeholder(kind)}"


def _placeholder(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    return TYPES.get(next(iter(get_args(kind)), kind), "TEXT")


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required() or value in (None, False, ()):
        return ""
    shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "yes" if value is True else shown


def _lines(option: Option, width: int, *, brief: bool) -> list[str]:
    """Return the lines of an option; `brief` shows the first clause of its meaning."""
    meaning = option.meaning
    if brief:
        meaning = meaning.removesuffix(".").partition("; ")[0].partition(". ")[0]
    if option.default:
        meaning += f" (default: {option.default})" if brief else f" Default: {option.default}."
    lines = textwrap.wrap(meaning, width - INDENT, break_on_hyphens=False)
    first = f"  {option.usage}"
    if len(first) <= INDENT - 2:
        first = first.ljust(INDENT) + lines.pop(0)
    return [first, *(" " * INDENT + line for line in lines)]
