"""Generator of reference pages in the documentation site, run by mkdocs as a hook.

The home page is README.md. docs/reference/api.md lists objects (`::: NAME`): each gets a page in
reference/api, and each command one in reference/commands. A page requests a section with a comment
on a separate line:

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

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    # Documents this checkout instead of an installed version.
    sys.path.insert(0, str(ROOT))

from pydantic import BaseModel  # noqa: E402 (from here on the checkout is found)
from pydantic.fields import FieldInfo  # noqa: E402

from airl_mav.cli.main import subcommands  # noqa: E402
from airl_mav.core.fields import range_of, unit_of  # noqa: E402

HOME, API, COMMANDS = "index.md", "reference/api.md", "reference/commands.md"
ADDONS = "reference/addons.md"

OBJECT = re.compile(r"^::: ([\w.]+)\n(?: .*\n|\n(?= ))*(?:\n<!-- fields: .* -->\n)?", re.MULTILINE)
"""Block of an object in the page of the Python API."""

PARTS = {COMMANDS: "reference/commands/{}.md", API: "reference/api/{}.md"}
"""Pages of parts, by the page that lists them."""

HELP_COLUMNS = "84"
"""Width of wrapped help texts."""

_WHERE = re.compile(r"([\w.]+):(\w+)(?:\[(.+)\]\.(\w+))?")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the generated pages into the navigation, below the pages that list them."""
    config.nav = [_with_parts(entry) for entry in config.nav or []]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the home page, a page per command and a page per object of the Python API."""
    pages = {HOME: home_page((ROOT / "README.md").read_text(encoding="utf-8"))}
    pages |= command_pages() | object_pages(api_text())
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace the comments of a page, and link parts to their pages; called for every page."""
    if page.file.src_uri == API:
        markdown = OBJECT.sub(_object_link, markdown)
    elif page.file.src_uri == ADDONS:
        markdown = with_options(markdown, "heading_level: 3", "members: false")
    elif page.file.src_uri == COMMANDS:
        rows = (f"| [{name}](commands/{file_of(name)}.md) | {what} |" for name, what in commands())
        markdown += "\n| command | purpose |\n|---|---|\n" + "\n".join(rows) + "\n"
    markdown = re.sub(r"reference/api\.md#[\w.]*?(\w+)\)", r"reference/api/\1.md)", markdown)
    markdown = re.sub(r"reference/commands\.md#([\w-]+)\)", r"reference/commands/\1.md)", markdown)
    return re.sub(
        r"^<!-- (fields|help|tables): (.+?) -->$", _generated, markdown, flags=re.MULTILINE
    )


def _with_parts(entry: Any) -> Any:
    """Return an entry of the navigation, with the pages of its parts."""
    ((title, target),) = entry.items()
    if isinstance(target, list):
        return {title: [each if isinstance(each, str) else _with_parts(each) for each in target]}
    if target == COMMANDS:
        parts = [{name: PARTS[target].format(file_of(name))} for name, _ in commands()]
    elif target == API:
        names = (last_name(each) for each in OBJECT.findall(api_text()))
        parts = [{name: PARTS[target].format(name)} for name in names]
    else:
        return entry
    return {title: [target, *parts]}


def home_page(readme: str) -> str:
    """Return the home page: the README with links as seen from docs/."""
    readme = re.sub(r"\]\(docs/", "](", readme)
    source = "https://github.com/airl-mav/airl-mav/blob/main/"
    return re.sub(r"\]\(([A-Z]+\.(?:md|cff))\)", rf"]({source}\1)", readme)


def commands() -> list[tuple[str, str]]:
    """Return names and purposes of all commands."""
    alone = ("sitl", "firmware", "companion")
    return [
        (f"airl-{name}" if name in alone else f"airl {name}", purpose)
        for name, (_, purpose, _) in subcommands().items()
    ]


def command_pages() -> dict[str, str]:
    """Return a page for each command: its help with all options."""
    return {
        PARTS[COMMANDS].format(file_of(name)): f"# {name}\n\n<!-- help: {name} -->\n"
        for name, _ in commands()
    }


def object_pages(listed: str) -> dict[str, str]:
    """Return a page for each object that the page of the Python API lists."""
    pages = {}
    for match in OBJECT.finditer(listed):
        name = last_name(match[1])
        text = match[0].replace("heading_level: 3", "heading_level: 2")
        if "options:" not in text:
            text = with_options(text, "heading_level: 2", "show_if_no_docstring: true")
        pages[PARTS[API].format(name)] = f"# {name}\n\n{text}"
    return pages


def with_options(markdown: str, *options: str) -> str:
    """Return a page whose objects (`::: NAME`) have options of mkdocstrings."""
    lines = "\n".join(("    options:", *(f"      {option}" for option in options)))
    return re.sub(r"^(::: [\w.]+)$", rf"\1\n{lines}", markdown, flags=re.MULTILINE)


def api_text() -> str:
    """Return the source of the page of the Python API."""
    return (ROOT / "docs" / API).read_text(encoding="utf-8")


def file_of(command: str) -> str:
    """Return the name of a command's page."""
    return command.replace(" ", "-")


def last_name(dotted: str) -> str:
    """Return the last part of a dotted name."""
    return dotted.rsplit(".", 1)[-1]


def _object_link(match: re.Match[str]) -> str:
    """Return the link to an object's page, with the first line of its docstring."""
    module, name = match[1].rsplit(".", 1)
    summary = (getattr(importlib.import_module(module), name).__doc__ or "").strip()
    return f"- [`{name}`](api/{name}.md): {summary.splitlines()[0] if summary else match[1]}\n"


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
        parts = list(dict.fromkeys(_type(part) for part in arguments if part is not Ellipsis))
        number = "" if Ellipsis in arguments or origin is list else f"{len(arguments)} × "
        return f"list of {number}{' or '.join(parts)}"
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
    if isinstance(value, BaseModel) or value in ("", ()):
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
