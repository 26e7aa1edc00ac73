"""Lookup and parsing of profile files, with one-line errors."""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel

from airl_mav.core.errors import UsageError, shown, usage_errors
from airl_mav.core.fields import validated
from airl_mav.core.files import DEEPEST, deeper_than
from airl_mav.profiles.assets import CONTENT, CheckedFile, read_checked

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Kind = Literal["vehicles", "computers", "arenas", "training", "sweeps", "conformance", "published"]
_SINGULAR: dict[Kind, str] = {
    "vehicles": "vehicle",
    "computers": "computer",
    "arenas": "arena",
    "training": "training",
    "sweeps": "sweep",
    "conformance": "conformance",
    "published": "publication",
}
Model = TypeVar("Model", bound=BaseModel)

MOST_BYTES = 1 << 20
"""Maximum size of a profile file; the largest shipped one has 3 kB."""

MOST_BASES = 10
"""Maximum depth of a chain of base profiles."""


@cache
def profiles_dir() -> Path:
    """Return the folder of the shipped profiles: inside the wheel, or in the source checkout."""
    package = Path(__file__).resolve().parent.parent
    shipped = package / "_profiles"
    return shipped if shipped.is_dir() else package.parent / "profiles"


def list_profiles(kind: Kind) -> list[str]:
    """Return the names of the shipped profiles of a kind, sorted."""
    return sorted(path.stem for path in (profiles_dir() / kind).glob("*.toml"))


def describe_profile(kind: Kind, name: str) -> str:
    """Return a shipped profile's description, "" without one. Raises UsageError."""
    return str(_read(kind, _path(kind, name), ()).get("description", ""))


def load_profile(kind: Kind, name: str, model: type[Model]) -> Model:
    """Load a shipped profile by name, or any file by path (recognised by its .toml suffix).

    A file with `base = "NAME"` overrides fields of that profile or path. Raises UsageError if the
    profile does not exist (lists the existing ones), is not TOML, or has a field that is missing,
    unknown, of the wrong type or out of range.
    """
    path = _path(kind, name)
    data = _read(kind, path, ())
    profile = validated(model, data, path)
    for asset in getattr(profile, "assets", {}).values():
        if asset.mesh is not None:
            _check_file(asset.mesh, path, "assets")
    for image in getattr(getattr(profile, "appearance", None), "images", ()):
        _check_file(image, path, "appearance.materials")
    return profile


def profile_digest(profile: BaseModel) -> str:
    """Return the SHA-256 of a profile's content, hexadecimal; detects changes under a name."""
    return hashlib.sha256(profile.model_dump_json(context=CONTENT).encode()).hexdigest()


def _path(kind: Kind, name: str) -> Path:
    """Return the file of a profile. Raises UsageError if missing."""
    path = Path(name) if name.endswith(".toml") else profiles_dir() / kind / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(list_profiles(kind))
        raise UsageError(
            f"no {_SINGULAR[kind]} profile {shown(name)}; shipped: {known} (or a path to a .toml)"
        )
    return path


def _read(kind: Kind, path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """Return the content of a file merged with its bases. `above`: the files that led here."""
    if path in above:
        raise UsageError(f"{above[0]}: base: leads back to {path}")
    if len(above) > MOST_BASES:
        raise UsageError(f"{above[0]}: base: accepted: at most {MOST_BASES} below each other")
    data = read_toml(path)
    if kind == "vehicles":
        _name_power_model(data, path)
    if kind == "arenas":
        _anchor_files(data, path)
    base = data.pop("base", None)
    if base is None:
        return data
    if not isinstance(base, str):
        raise UsageError(f"{path}: base = {shown(base)}: accepted: a name or a path")
    return _overlaid(_read(kind, _path(kind, base), (*above, path)), data)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises UsageError."""
    with usage_errors(path), path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise UsageError(f"{path}: accepted: a profile of at most {MOST_BYTES:,} bytes")
    try:
        found = tomllib.loads(data.decode())
        too_deep = deeper_than(found, DEEPEST)
    except RecursionError:
        too_deep = True
    except ValueError as error:  # Includes numbers of thousands of digits and invalid UTF-8.
        raise UsageError(f"{path}: not valid TOML: {error}") from None
    if too_deep:
        raise UsageError(f"{path}: nested too deep: accepted: {DEEPEST} levels")
    return found


def _anchor_files(data: dict[str, Any], path: Path) -> None:
    """Make paths to meshes and images absolute: they are relative to the profile's folder."""
    look = data.get("appearance")
    for owners, field in (
        (data.get("assets"), "mesh"),
        (look.get("materials") if isinstance(look, dict) else None, "image"),
    ):
        for owner in owners.values() if isinstance(owners, dict) else ():
            named = owner.get(field) if isinstance(owner, dict) else None
            if isinstance(named, dict) and isinstance(file := named.get("file"), str) and file:
                named["file"] = str(path.parent.absolute() / file)


def _check_file(named: CheckedFile, path: Path, table: str) -> None:
    """Raise UsageError, naming the profile, if a file is missing or its digest differs."""
    try:
        read_checked(named)
    except UsageError as error:
        raise UsageError(f"{path}: {table}: {error}") from None


def _name_power_model(data: dict[str, Any], path: Path) -> None:
    """Add the `model` field to a nine-coefficient table `power`, optional before version 0.3.

    Raises UsageError for a `payload_g`, which is no longer part of the power model.
    """
    power = data.get("power")
    if not isinstance(power, dict) or "b1_vxy" not in power or "model" in power:
        return
    power["model"] = "regression"
    if power.pop("payload_g", 0.0):
        raise UsageError(
            f"{path}: power.payload_g: accepted: body.payload_kg, a part of mass_kg, in its place"
        )


_WHICH = ("model", "name")
"""Fields that select a table's schema: another model or algorithm has other fields."""


def _overlaid(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return one table merged over another, table by table.

    A table with another `model` or `name` replaces the base's table.
    """
    if any(above.get(which, below.get(which)) != below.get(which) for which in _WHICH):
        return above
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        if isinstance(under, dict) and isinstance(value, dict):
            merged[key] = _overlaid(under, value)
        else:
            merged[key] = value
    return merged
