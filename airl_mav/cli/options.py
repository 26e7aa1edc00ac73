"""Command lines generated from models, which contain meaning, unit, range and default of fields.

A command's options are a pydantic model, mostly composed of the scenario's groups of fields. tyro
parses the words and the model validates the values. Each error is one line that names the option.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import os
import re
import shutil
import sys
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NoReturn,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

import tyro
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from airl_mav.core import errors, first_start, progress
from airl_mav.core.errors import refer
from airl_mav.core.fields import COMMON, GROUPS, range_of, validated
from airl_mav.faults import Fault
from airl_mav.profiles.loading import read_toml
from airl_mav.scenario.aircraft import IN_WORDS
from airl_mav.scenario.model import Scenario

Options = TypeVar("Options", bound=BaseModel)

POSITIONAL = "positional"
"""Marker of a field with values without an option name."""

REPEATED = "repeated"
"""Marker of a field whose option may be repeated, with one value each."""

PREFIXED = ("limits", "payload", "sensors", "spread", "wind")
"""Tables whose options have the table's name as a prefix; option names of others are unique."""

CALLED = {"json_lines": "json"}
"""Fields with another option name: pydantic's models have a `json` method."""

SINGULAR = {"faults": "fault"}
"""Lists whose option is repeated for each item, with a singular name."""

_FIELD = re.compile(r"\b[a-z0-9]+(?:_[a-z0-9]+)+\b")
"""Words in a message that may be field names: with an underscore, so not English words."""


def read_options(model: type[Options], prog: str, words: Sequence[str]) -> Options:
    """Read a command line, or a first word .toml, into its model; SystemExit after a help text."""
    if {"-h", "--help", "--help-all"} & set(words):
        sys.stdout.write(help_text(model, prog, everything="--help-all" in words) + "\n")
        raise SystemExit(0)
    words = _with_values(model, words)
    held: dict[str, Any] = {}
    file = _scenario_file(model, words)
    if file is not None:
        words = words[1:]
        held = read_toml(file)
        validated(model, held, file)
    # Without comments, as tyro would read this file's source for each table.
    kind: Any = Annotated[(_arguments(model, held), tyro.conf.HelptextFromCommentsOff)]
    parsed = tyro.cli(kind, prog=prog, description=inspect.getdoc(model), args=words)
    try:
        return validated(model, dataclasses.asdict(parsed))
    except errors.FieldError as error:
        raise errors.UsageError(told(error, words, file, _positionals(model))) from None


def scenario_of(options: BaseModel, **changes: Any) -> Scenario:
    """Return the scenario of a command's options, with changes except for None."""
    given = {
        name: getattr(options, name)
        for name, field in Scenario.model_fields.items()
        if name in type(options).model_fields
        # Options with several values instead of one belong to the experiment.
        and (IN_WORDS in field.metadata or not isinstance(getattr(options, name), tuple))
    }
    given |= {name: value for name, value in changes.items() if value is not None}
    return Scenario(**{name: value for name, value in given.items() if value is not None})


def told(
    error: errors.FieldError,
    words: Sequence[str],
    file: Path | None = None,
    positionals: Sequence[str] = (),
) -> str:
    """Return a field's error as one line with the name of the option, or the file."""
    if error.field in positionals:
        return error.line(error.field.upper())
    error = _with_options(error)
    option = option_of(error.field)
    given = any(word == option or word.startswith(f"{option}=") for word in words)
    if file is not None and not given:
        return f"{file}: {error.line(sign=' = ')}"
    return error.line(option)


def _names(model: type[BaseModel]) -> Iterator[str]:
    """Yield the option field names of a model; some tables are not part of the option name."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel) and name not in PREFIXED:
            yield from _names(kind)
        else:
            yield name


def _with_options(error: errors.FieldError) -> errors.FieldError:
    """Return an error whose text names fields by their options: --px4-dir for px4_dir."""

    def named(word: re.Match[str]) -> str:
        return option_of(word[0]) if word[0] in names else word[0]

    names = set(_names(Scenario))
    accepted, problem = (_FIELD.sub(named, text) for text in (error.accepted, error.problem))
    return errors.FieldError(error.field, error.value, accepted, problem)


def option_of(field: str) -> str:
    """Return the option of a field: --hold-s for hold_s, --leave-after-s for a watchdog field."""
    # Elements of a list use the list's option: goal.0 is the first value of --goal.
    table, _, name = re.sub(r"(\.\d+)+$", "", field).rpartition(".")
    listed, _, _ = field.partition(".")
    if listed in SINGULAR:
        return f"--{SINGULAR[listed]}"
    full = f"{table}.{name}" if table in PREFIXED else CALLED.get(name, name)
    return "--" + full.replace("_", "-")


def _with_values(model: type[BaseModel], words: Sequence[str]) -> list[str]:
    """Return the words with optional switches as tyro expects: --name True, --name False."""
    values: dict[str, list[str]] = {}
    for name, field in model.model_fields.items():
        if field.annotation == (bool | None):
            option = option_of(name)
            values |= {option: [option, "True"], f"--no-{option[2:]}": [option, "False"]}
    out: list[str] = []
    for word, following in zip_longest(words, words[1:]):
        spelled = following in ("None", "True", "False")
        out += [word] if spelled else values.get(word, [word])
    return out


def _scenario_file(model: type[BaseModel], words: Sequence[str]) -> Path | None:
    """Return the scenario file at the start of a command line, or None."""
    if "policy" not in model.model_fields or _positionals(model):
        return None
    return Path(words[0]) if words and words[0].endswith(".toml") else None


def _positionals(model: type[BaseModel]) -> list[str]:
    return [name for name, field in model.model_fields.items() if POSITIONAL in field.metadata]


def _arguments(model: type[BaseModel], held: Mapping[str, Any]) -> type[Any]:
    """Return the dataclass for tyro: the model's types and defaults, without ranges."""
    fields: list[tuple[str, Any, Any]] = []
    # Positional fields first: fields without a default must come first.
    names = sorted(
        model.model_fields, key=lambda name: POSITIONAL not in model.model_fields[name].metadata
    )
    for name in names:
        field = model.model_fields[name]
        kind: Any = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            inner = _arguments(kind, held.get(name, {}))
            prefix = name in PREFIXED
            kind = inner if prefix else Annotated[(inner, tyro.conf.OmitArgPrefixes)]
            fields.append((name, kind, dataclasses.field(default_factory=inner)))
            continue
        marks: list[Any] = [tyro.conf.arg(help=meaning_of(field), name=CALLED.get(name))]
        if POSITIONAL in field.metadata:
            marks = [
                tyro.conf.Positional,
                tyro.conf.arg(help=meaning_of(field), metavar=metavar_of(name, kind)),
            ]
        if REPEATED in field.metadata:
            marks.append(tyro.conf.UseAppendAction)
        there = held.get(name)
        if IN_WORDS in field.metadata:
            kind = tuple[str, ...]
            marks = [tyro.conf.arg(help=meaning_of(field), name=SINGULAR[name], metavar="TEXT")]
            marks.append(tyro.conf.UseAppendAction)
            there = [str(Fault.model_validate(item)) for item in there or ()]
        default = dataclasses.field(default=_default(field, there))
        fields.append((name, Annotated[(kind, *marks)], default))
    made = dataclasses.make_dataclass(model.__name__, fields, frozen=True)
    made.__doc__ = inspect.getdoc(model)
    return made


def _default(field: FieldInfo, held: Any) -> Any:
    """Return an option's default: from the file, else from the model."""
    if held is not None:
        if isinstance(held, str) and Path in (field.annotation, *get_args(field.annotation)):
            return Path(held)
        return tuple(held) if isinstance(held, list) else held
    return tyro.MISSING if field.is_required() else field.get_default(call_default_factory=True)


def metavar_of(name: str, kind: Any) -> str:
    """Return the placeholder of a positional."""
    if "tuple" not in str(kind):
        return name.upper()
    one = f"{name[:-3]}y" if name.endswith("ies") else name.removesuffix("s")
    return f"[{one.upper()} ...]"


def meaning_of(field: FieldInfo) -> str:
    """Return a field's meaning with its range and unit, as a sentence."""
    meaning = field.description or ""
    meaning = meaning[:1].upper() + meaning[1:]
    limits = range_of(field)
    return f"{meaning}. Accepted: {limits}." if limits else f"{meaning}."


def run_command(prog: str, module: str, words: Sequence[str] | None = None) -> NoReturn:
    """Run the command of a module and exit with its status.

    The module has `OPTIONS`, the model of its options, `run(options) -> exit status`, and
    optionally `EXTRAS`, its additional requirements, and `READS_FILES`, True if the command only
    reads files, whose content may raise any error. Errors become one line and exit status 2 or 1.
    """
    words = sys.argv[1:] if words is None else words
    threading.excepthook = _thread_failed
    # Child processes import no modules from the current folder (Python 3.11 and later).
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        try:
            code = carry_out(prog, module, words)
        finally:
            # Flush here: errors at interpreter exit cannot be handled.
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has closed the pipe (`| head`): discard further output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = errors.EXIT_BROKEN
    except errors.UsageError as error:
        _fail("; ".join(filter(None, (str(error), refer(words)))))
        code = errors.EXIT_USAGE
    except SystemExit as rejected:  # By tyro, which has printed why; or after --help.
        if rejected.code and (reference := refer(words)):
            _fail(reference)
        raise
    except OSError as error:
        if (failure := errors.machine_failure(error)) is None:
            raise
        _fail(failure)
        code = errors.EXIT_BROKEN
    except KeyboardInterrupt:
        code = errors.EXIT_INTERRUPTED
    sys.exit(code)


def carry_out(prog: str, module: str, words: Sequence[str], **more: Any) -> int:
    """Parse a command line and run its command with `more`; return the exit status."""
    package, _, name = module.removesuffix("_command").rpartition(".")
    if name not in LIGHT and not hasattr(sys.modules.get(package), "LIGHT"):
        # Before the import, which fails without the packages.
        check_installed("sim")
    command = importlib.import_module(module)
    options = read_options(command.OPTIONS, prog, words)
    check_installed(*getattr(command, "EXTRAS", ()))
    try:
        # On standard error, as programs read standard output.
        with first_start.shown_by(lambda: progress.RichProgress(progress.new_console(stderr=True))):
            return int(command.run(options, **more))
    except errors.FieldError as error:
        options_model = type(options)
        file = _scenario_file(options_model, words)
        raise errors.UsageError(told(error, words, file, _positionals(options_model))) from None
    except (
        ArithmeticError,
        LookupError,
        MemoryError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        if not getattr(command, "READS_FILES", False):
            raise
        problem = " ".join(f"{type(error).__name__}: {error}".split())
        raise errors.UsageError(
            f"{' '.join(words)}: damaged, or changed since it was written: {problem}"
        ) from error


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    """Print a thread's error, except for a full disk, which is raised by the next write."""
    error = failed.exc_value
    if not isinstance(error, OSError) or errors.machine_failure(error) is None:
        threading.__excepthook__(failed)


def _fail(message: str) -> None:
    progress.new_console(stderr=True, soft_wrap=True).print(f"error: {message}", style="red")


EXTRAS = {
    "black-box": ("mcap",),
    "export": ("foxglove", "mcap"),
    "film": ("av",),
    "jpeg": ("PIL",),
    "mesh": ("trimesh",),
    "profile": ("onnx",),
    "data": ("minari", "pandas", "pyarrow"),
    "identify": ("mcap", "pyulog"),
    "sim": ("filterpy", "jinja2", "matplotlib", "PIL", "pymavlink", "scipy"),
    "train": ("gymnasium", "onnx", "onnxscript", "stable_baselines3", "tensorboard", "torch"),
    "view": ("viser",),
}
"""Packages of the extras, by their names in pyproject.toml."""

LIGHT = ("companion", "computers", "export", "list", "train")
"""Commands that can be imported without the simulator; light add-ons define `LIGHT` themselves."""


def check_installed(*extras: str) -> None:
    """Raise UsageError, with installation instructions, for missing packages of the extras."""
    lacking = {
        extra: missing
        for extra in extras
        if (missing := [name for name in EXTRAS[extra] if find_spec(name) is None])
    }
    if lacking:
        names = ", ".join(sorted({name for missing in lacking.values() for name in missing}))
        raise errors.UsageError(
            f"not installed: {names}; pip install 'airl-mav[{','.join(lacking)}]'"
        )


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
            yield Option(usage, meaning_of(field), _default_text(field), GROUPS[0], is_common=True)
        else:
            usage = _usage(option_of(table + name), field)
            yield Option(usage, meaning_of(field), _default_text(field), group, COMMON in marks)


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


def _default_text(field: FieldInfo) -> str:
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
