"""Generator of reference sections in the documentation site, run by mkdocs as a hook.

A page requests a section with a comment on a separate line:

- `<!-- fields: MODULE:MODEL -->` becomes a table of the fields of a pydantic model and of the
  models inside it: name, meaning, unit and range, default.
- `<!-- help: COMMAND -->` becomes the output of `COMMAND --help-all`.
- `<!-- tables: MODULE:FUNCTION -->` becomes the Markdown that a function returns.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin
from unittest import mock

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    # Documents this checkout instead of an installed version.
    sys.path.insert(0, str(ROOT))

from pydantic import BaseModel  # noqa: E402 (from here on the checkout is found)
from pydantic.fields import FieldInfo  # noqa: E402

from airl_mav.core.fields import range_of, unit_of  # noqa: E402

HELP_COLUMNS = "100"
"""Width of wrapped help texts."""

_WHERE = re.compile(r"([\w.]+):(\w+)(?:\[(.+)\]\.(\w+))?")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the comments of a page; called by mkdocs for every page."""
    return re.sub(
        r"^<!-- (fields|help|tables): (.+?) -->$", _generated, markdown, flags=re.MULTILINE
    )


def _generated(match: re.Match[str]) -> str:
    kind, what = match.groups()
    if kind == "tables":
        module, name = what.split(":")
        return str(getattr(importlib.import_module(module), name)())
    return field_tables(what) if kind == "fields" else help_text(what)


def field_tables(where: str) -> str:
    """Return the tables of a model and of each model inside it.

    Args:
        where: "MODULE:NAME", or "MODULE:TABLE[KEY].FIELD" for the model in a row of a table.
    """
    module, name, key, field = _WHERE.fullmatch(where).groups()  # type: ignore[union-attr]
    model = getattr(importlib.import_module(module), name)
    model = model if key is None else getattr(model[key], field)
    tables = []
    for path, part in _models(model, ""):
        title = f"### `{path}`\n\n{_summary(part)}\n\n" if path else ""
        tables.append(title + _table(part))
    return "\n\n".join(tables)


def _models(model: type[BaseModel], path: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield a model and its inner models, each with the dotted path of its table."""
    yield path, model
    for name, field in model.model_fields.items():
        inner, suffix = _inner(field.annotation)
        if inner is not None:
            yield from _models(inner, f"{path}.{name}".lstrip(".") + suffix)


def _inner(annotation: Any) -> tuple[type[BaseModel] | None, str]:
    """Return the model inside a field's type, and the suffix of its TOML path."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, ""
    origin = get_origin(annotation)
    if origin is None or origin is Literal:
        return None, ""
    suffix = {dict: ".NAME", tuple: "[]", list: "[]"}.get(origin, "")
    for argument in get_args(annotation):
        inner, below = _inner(argument)
        if inner is not None:
            return inner, suffix + below
    return None, ""


def _summary(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")


def _table(model: type[BaseModel]) -> str:
    rows = ["| field | meaning | accepted | default |", "|---|---|---|---|"]
    for name, field in model.model_fields.items():
        inner, _ = _inner(field.annotation)
        meaning = field.description or (_summary(inner) if inner is not None else "")
        cells = (f"`{field.alias or name}`", meaning, _accepted(field))
        rows.append("| " + " | ".join(map(_cell, (*cells, _default(field)))) + " |")
    return "\n".join(rows)


def _cell(text: str) -> str:
    return re.sub(r"[ \n]+", " ", text.strip()).replace("|", "\\|")


def _accepted(field: FieldInfo) -> str:
    """Return the range of a field with its unit, else its choices, else its type."""
    if _inner(field.annotation)[0] is not None:
        return "table, below"
    unit = unit_of(field)
    unit = f" {unit}" if unit and unit != "1" else ""
    limits = range_of(field).replace("<=", "≤")
    # Keep the range in one line with non-breaking spaces.
    return limits.replace(" ", "\u00a0") or _type(field.annotation) + unit


def _type(annotation: Any) -> str:
    """Return a type as text for readers."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin is Annotated:
        return _type(arguments[0])
    if origin in (Union, types.UnionType):
        return " or ".join(_type(part) for part in arguments if part is not type(None))
    if origin in (tuple, list):
        parts = [_type(part) for part in arguments if part is not Ellipsis]
        return f"list of {parts[0]}" if Ellipsis in arguments or origin is list else f"{parts}"
    if origin is dict:
        return f"table of {_type(arguments[1])}"
    names = {str: "text", int: "integer", float: "number", bool: "`true`, `false`", Path: "path"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default_factory is not None or field.default is None:
        return "–"
    value = field.default
    if isinstance(value, BaseModel):
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def help_text(command: str) -> str:
    """Return the output of a command's `--help-all` as a text block."""
    program, *rest = command.split()
    entry: Callable[[], Any] = getattr(
        importlib.import_module("airl_mav.cli.main"), program.removeprefix("airl-")
    )
    printed = io.StringIO()
    plain = {"COLUMNS": HELP_COLUMNS, "NO_COLOR": "1", "TERM": "dumb"}
    with (
        mock.patch.dict(os.environ, plain),
        mock.patch.object(sys, "argv", [program, *rest, "--help-all"]),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        entry()
    text = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).strip("\n")
    if not text:
        raise RuntimeError(f"{command} --help-all printed nothing")
    return f"```text\n{text}\n```"
