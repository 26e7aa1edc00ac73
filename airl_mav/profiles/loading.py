"""Find and read profile files; a wrong one gets one clear line."""

from __future__ import annotations

import difflib
import sys
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from airl_mav.core.errors import UsageError
from airl_mav.profiles.fields import range_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Kind = Literal[
    "vehicles", "computers", "arenas", "training", "sweeps", "studies", "conformance", "published"
]
_SINGULAR: dict[Kind, str] = {
    "vehicles": "vehicle",
    "computers": "computer",
    "arenas": "arena",
    "training": "training",
    "sweeps": "sweep",
    "studies": "study",
    "conformance": "conformance",
    "published": "publication",
}
Model = TypeVar("Model", bound=BaseModel)


@cache
def profiles_dir() -> Path:
    """Return the folder of the shipped profiles: inside the wheel, or of the source checkout."""
    package = Path(__file__).resolve().parent.parent
    shipped = package / "_profiles"
    return shipped if shipped.is_dir() else package.parent / "profiles"


def list_profiles(kind: Kind) -> list[str]:
    """Return the names of the shipped profiles of a kind, sorted."""
    return sorted(path.stem for path in (profiles_dir() / kind).glob("*.toml"))


def load_profile(kind: Kind, name: str, model: type[Model]) -> Model:
    """Load a shipped profile by name, or any file by path (recognised by its .toml suffix).

    A file with `base = "NAME"` is that profile, or that path, with what the file says put over it.

    Raises:
        UsageError: The profile does not exist (lists those that do), is no TOML, or has a field
            that is missing, unknown, of the wrong type or out of range.
    """
    path = _path(kind, name)
    data = _read(kind, path, ())
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise UsageError(f"{path}: {explain(error, model)}") from None


def _path(kind: Kind, name: str) -> Path:
    """Return the file of a profile. Raises UsageError when there is none."""
    path = Path(name) if name.endswith(".toml") else profiles_dir() / kind / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(list_profiles(kind))
        raise UsageError(
            f"no {_SINGULAR[kind]} profile {name!r}; shipped: {known} (or a path to a .toml)"
        )
    return path


def _read(kind: Kind, path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """Return what a file says, on top of its bases. `above`: the files that led here."""
    if path in above:
        raise UsageError(f"{above[0]}: base: leads back to {path}")
    try:
        data: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not valid TOML: {error}") from None
    base = data.pop("base", None)
    if base is None:
        return data
    if not isinstance(base, str):
        raise UsageError(f"{path}: base = {base!r}: accepted: the name of a profile, or a path")
    return _overlaid(_read(kind, _path(kind, base), (*above, path)), data)


def _overlaid(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return one table put over another, table by table."""
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        if isinstance(under, dict) and isinstance(value, dict):
            merged[key] = _overlaid(under, value)
        else:
            merged[key] = value
    return merged


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """Return a validation error's first finding as one line: field, value, accepted range."""
    # A misspelt field also goes missing: its misspelling says more.
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    path = first["loc"]
    field = ".".join(str(part) for part in path)
    rest = error.error_count() - 1
    tail = f" (and {rest} more)" if rest else ""
    if first["type"] == "missing":
        return f"{field}: missing{tail}"
    if first["type"] == "extra_forbidden":
        owner = _model_at(model, path[:-1])
        names = list(owner.model_fields) if owner else []
        near = difflib.get_close_matches(str(path[-1]), names, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"fields: {', '.join(names)}"
        return f"{field}: unknown field; {hint}{tail}"
    accepted = _accepted(model, path) or first["msg"]
    table = _model_at(model, path) if first["type"] == "model_type" else None
    if table is not None:
        accepted = f"a table with the fields {', '.join(table.model_fields)}"
    value = first["input"]
    where = f"{field} = {value!r}" if field else "invalid"
    if first["type"] == "value_error":
        return f"{field + ': ' if field else ''}{first['msg'].removeprefix('Value error, ')}{tail}"
    return f"{where}: accepted: {accepted}{tail}"


def _model_at(model: type[BaseModel], path: tuple[Any, ...]) -> type[BaseModel] | None:
    """Return the model that a location inside `model` points at."""
    here: type[BaseModel] | None = model
    for part in path:
        if here is None:
            return None
        field = here.model_fields.get(str(part))
        if field is not None:
            here = _model_in(field.annotation)
    return here


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model an annotation holds, looking into unions and containers."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        if (found := _model_in(inner)) is not None:
            return found
    return None


def _accepted(model: type[BaseModel], path: tuple[Any, ...]) -> str:
    """Return the declared range of the field at a location."""
    for depth in range(len(path), 0, -1):
        owner = _model_at(model, path[: depth - 1])
        field = owner.model_fields.get(str(path[depth - 1])) if owner else None
        if field is not None:
            return range_of(field)
    return ""
