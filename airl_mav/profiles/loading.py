"""Lookup and parsing of profile files, with one-line errors."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
)

from airl_mav.core.errors import UsageError, shown
from airl_mav.core.fields import ProfileModel, optional, validated
from airl_mav.core.files import DEEPEST, deeper_than, read_limited

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Kind = Literal["vehicles", "computers", "arenas", "training", "sweeps", "conformance", "published"]
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
    for table, named in _checked_files(profile, ""):
        try:
            read_checked(named)
        except UsageError as error:
            raise UsageError(f"{path}: {table}: {error}") from None
    return profile


def profile_digest(profile: BaseModel) -> str:
    """Return the SHA-256 of a profile's content, hexadecimal; detects changes under a name."""
    return hashlib.sha256(profile.model_dump_json(context=CONTENT).encode()).hexdigest()


def _path(kind: Kind, name: str) -> Path:
    """Return the file of a profile. Raises UsageError if missing."""
    path = Path(name) if name.endswith(".toml") else profiles_dir() / kind / f"{name}.toml"
    if not path.is_file():
        singular, known = kind.removesuffix("s"), ", ".join(list_profiles(kind))
        raise UsageError(
            f"no {singular} profile {shown(name)}; shipped: {known} (or a path to a .toml)"
        )
    return path


def _read(kind: Kind, path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """Return the content of a file merged with its bases. `above`: the files that led here."""
    if path in above:
        raise UsageError(f"{above[0]}: base: leads back to {path}")
    if len(above) > MOST_BASES:
        raise UsageError(f"{above[0]}: base: accepted: at most {MOST_BASES} below each other")
    data = read_toml(path)
    if kind == "arenas":
        _anchor_files(data, path.parent.absolute())
    base = data.pop("base", None)
    if base is None:
        return data
    if not isinstance(base, str):
        raise UsageError(f"{path}: base = {shown(base)}: accepted: a name or a path")
    return _overlaid(_read(kind, _path(kind, base), (*above, path)), data)


def read_table(module: str) -> dict[str, Any]:
    """Return the table beside a module: the TOML file with the name of the file `module`."""
    return read_toml(Path(module).with_suffix(".toml"))


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises UsageError."""
    data = read_limited(path, "a profile", MOST_BYTES)
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


def _anchor_files(data: object, folder: Path) -> None:
    """Make the paths of a table's `CheckedFile`s absolute: they are relative to its folder."""
    if not isinstance(data, dict):
        return
    if "sha256" in data and isinstance(file := data.get("file"), str) and file:
        data["file"] = str(folder / file)
    for value in data.values():
        _anchor_files(value, folder)


def _checked_files(value: object, table: str) -> Iterator[tuple[str, CheckedFile]]:
    """Yield the files of a profile, each with the name of its innermost table of named entries."""
    if isinstance(value, CheckedFile):
        yield table, value
    elif isinstance(value, BaseModel):
        for name, field in value:
            inner = f"{table}.{name}" if table else name
            if isinstance(field, Mapping):
                for each in field.values():
                    yield from ((inner, file) for _, file in _checked_files(each, ""))
            else:
                yield from _checked_files(field, inner)


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


MOST_FILE_BYTES = 1 << 27
"""Maximum size of a file."""


CONTENT = {"content": True}
"""Context of a serialisation of content without file paths."""


class CheckedFile(ProfileModel):
    """A file beside a profile, verified by its digest."""

    file: str = Field(min_length=1, description="a path from the profile's folder")
    sha256: str = Field(description="SHA-256 of that file, hexadecimal")

    @field_validator("sha256")
    @classmethod
    def _is_a_digest(cls, value: str) -> str:
        if len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise ValueError(f"{value!r}; accepted: 64 hexadecimal digits")
        return value

    @model_serializer(mode="wrap")
    def _without_place(
        self, dump: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """Omit the path if only content counts: the digest identifies the file."""
        data: dict[str, Any] = dump(self)
        if info.context == CONTENT:
            del data["file"]
        return data


def read_checked(named: CheckedFile) -> bytes:
    """Return the bytes of a file. Raises UsageError if missing or the digest differs."""
    data = read_limited(Path(named.file), "a file", MOST_FILE_BYTES)
    found = hashlib.sha256(data).hexdigest()
    if found != named.sha256:
        raise UsageError(
            f"{named.file}: changed since its arena was made: SHA-256 {found[:16]}...; accepted: "
            f"{named.sha256[:16]}..."
        )
    return data


class PublishedRun(ProfileModel):
    """A column of a published table: means over the flights that reached the goal."""

    label: str = Field(description="computer and policy, as the source calls them")
    latency_ms: float
    flight_time_s: float
    distance_m: float
    energy_kj: float = Field(description="of the vehicle, without its computer")
    success_percent: float | None = optional("None: not given")


class PublishedGap(ProfileModel):
    """Differences of two columns, in percent of the reference; success in percentage points."""

    latency_percent: float | None
    success: float
    flight_time_percent: float
    distance_percent: float
    energy_percent: float


class PublishedTable(ProfileModel):
    """A table that compares runs in one arena."""

    title: str
    arena: str = Field(description="our arena of the same name")
    policy: str = Field(default="", description="layers x filters of the network")
    columns: dict[str, PublishedRun] = Field(description="by role: reference, target, ...")
    printed: dict[str, PublishedGap] = Field(description="gaps as printed, by the target's role")
    note: str = Field(default="", description="how the printed gaps are worked out there")


class PublishedNetwork(ProfileModel):
    """The best network of an architecture search."""

    network: str = Field(description="layers x filters")
    success_percent: float


class Published(ProfileModel):
    """All results of one publication."""

    description: str = Field(description="the source")
    tables: tuple[PublishedTable, ...] = Field(
        description="of one arena the first that fits is shown"
    )
    degradation: tuple[PublishedRun, ...] = Field(description="one policy by growing latency")
    best_networks: dict[str, PublishedNetwork] = Field(description="by arena")
    generalisation: dict[str, dict[str, float]] = Field(
        description="success [%] by the arena trained in, then the arena flown in"
    )
    ablation: dict[str, dict[str, float]] = Field(
        description="success [%] by arena, then the input that was made zero"
    )


@cache
def load_published(name: str = "air-learning") -> Published:
    """Load published results. Raises UsageError."""
    return load_profile("published", name, Published)


def published_gap(reference: PublishedRun, target: PublishedRun) -> PublishedGap:
    """Return the differences of two published columns, signed: percent, success in points."""

    def percent(key: str) -> float:
        first, second = getattr(reference, key), getattr(target, key)
        return float(100.0 * (second - first) / first)

    first, second = reference.success_percent, target.success_percent
    return PublishedGap(
        latency_percent=percent("latency_ms"),
        success=0.0 if first is None or second is None else second - first,
        flight_time_percent=percent("flight_time_s"),
        distance_percent=percent("distance_m"),
        energy_percent=percent("energy_kj"),
    )
