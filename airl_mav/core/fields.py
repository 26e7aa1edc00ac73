"""Fields of profiles, cards and scenarios with a meaning, a unit and a range.

Fields are declared once with `quantity`. `validated` reads input as a model; `field_error` converts
pydantic's errors to one line.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import (
    CoreSchema,
    ErrorDetails,
    PydanticCustomError,
    PydanticUndefined,
    core_schema,
)

from airl_mav.core import addons, errors

Model = TypeVar("Model", bound=BaseModel)
Numbers = TypeVar("Numbers", bound="tuple[float, ...]")

MOST_NAMES = 40
"""Maximum number of field names in a message."""

TYPES = {
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "dict_type": "a table",
    "finite_number": "a finite number",
    "float_parsing": "a number",
    "float_type": "a number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "int_type": "a whole number",
    "list_type": "a list",
    "none_required": "none",
    "string_type": "a text",
    "tuple_type": "a list",
}
"""Accepted input by pydantic's error type."""


COMMON = "most used"
"""Marks an option of `--help`; `--help-all` shows all options."""

GROUPS = (
    *("options", "policy", "episodes", "arena", "latency", "aircraft", "domain randomization"),
    *("sensors", "firmware and links", "execution", "limits", "requirements", "output"),
)
"""Groups of `--help-all`, in order: the attribute `GROUP` of a model, or a mark of a field."""


class ProfileModel(BaseModel):
    """Base of all profile models: immutable, unknown fields rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AbsentSection(ProfileModel):
    """Section of a profile that no add-on reads."""

    @model_validator(mode="before")
    @classmethod
    def _is_left_out(cls, value: object) -> object:
        if value != {} and not isinstance(value, cls):
            raise ValueError("accepted: left out; its add-on is not in airl_mav/addons")
        return value


def section(name: str) -> type[ProfileModel]:
    """Return the model of a profile's section that an add-on defines; without it, an empty one."""
    if (place := addons.entries("airl_mav", "PROFILE_SECTIONS").get(name)) is not None:
        return addons.load(place)  # type: ignore[no-any-return]
    return AbsentSection


class ArrayField:
    """Annotation of a dataclass array that pydantic reads and writes as lists."""

    def __init__(self, dtype: type[Any], columns: int = 0) -> None:
        """Define an array (n, columns); 0 = any shape."""
        self._dtype, self._columns = dtype, columns

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema: numbers in, nested lists out."""

        def read(numbers: Any) -> Any:
            array = np.asarray(numbers, self._dtype)
            return array.reshape(-1, self._columns) if self._columns else array

        writes = core_schema.plain_serializer_function_ser_schema(np.ndarray.tolist)
        return core_schema.no_info_plain_validator_function(read, serialization=writes)


def quantity(
    description: str,
    unit: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    default: Any = PydanticUndefined,
    later: bool = False,
) -> Any:
    """Declare a number, an optional number or a list of numbers, with its unit and range.

    The unit is "1" for plain numbers. A field without a default is required. `later` marks a field
    that is dumped as described in `later_field`.
    """
    scalar = any(bound is not None for bound in (ge, gt, le, lt))
    return Field(
        default=default,
        description=description,
        # Strict, to reject true and "1.5" as numbers; strict tuples would reject lists.
        strict=True if scalar else None,
        ge=ge,
        gt=gt,
        le=le,
        lt=lt,
        json_schema_extra={"unit": unit},
        exclude_if=(lambda value: bool(value == default)) if later else None,
    )


def optional(description: str) -> Any:
    """Declare an optional field with default None."""
    return Field(default=None, description=description)


def switch(description: str) -> Any:
    """Declare a switch with default False."""
    return Field(default=False, description=description)


def later_field(default: Any, description: str | None = None) -> Any:
    """Declare a field that was added after digests and cards of its model existed.

    A value equal to the default is left out of the dump, so that digests and cards do not change.
    The default may be a type, which is then called.
    """
    made, key = default, "default"
    if isinstance(default, type):
        made, key = default(), "default_factory"
    given: dict[str, Any] = {key: default}
    if description is not None:  # None would override the description of an annotation.
        given["description"] = description
    return Field(**given, exclude_if=lambda value: bool(value == made))


@dataclass(frozen=True)
class Each:
    """Range of every number in a tuple field. Bounds have pydantic's names, for `range_of`."""

    ge: float
    le: float
    ascending: bool = False

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Add checks before and after the field's type."""
        args = get_args(source)
        length = None if Ellipsis in args else len(args)
        inner = core_schema.no_info_after_validator_function(self.check, handler(source))

        def listed(value: Any) -> Any:
            if not isinstance(value, list | tuple) or len(value) != (length or len(value) or -1):
                raise ValueError(
                    f"{value!r}; accepted: a list of {length or 'one or more'} numbers"
                )
            return value

        return core_schema.no_info_before_validator_function(listed, inner)

    def check(self, values: Numbers) -> Numbers:
        """Return `values`; raise if a value is out of range or the order is not ascending."""
        if not all(self.ge <= value <= self.le for value in values):
            raise PydanticCustomError("out_of_range", "out of range")
        if self.ascending and list(values) != sorted(values):
            raise ValueError(f"{list(values)}; accepted: numbers in ascending order")
        return values


def unit_of(field: FieldInfo) -> str | None:
    """Return the unit of a field's declaration; None = no unit."""
    for declared in (field, *_branch_marks(field.annotation)):
        extra = getattr(declared, "json_schema_extra", None)
        if isinstance(extra, dict) and "unit" in extra:
            return str(extra["unit"])
    return None


def range_of(field: FieldInfo) -> str:
    """Return the accepted range of a field as text: "0 < value <= 10 kg", or "" if unbounded."""
    low = high = ""
    marks = _branch_marks(field.annotation)
    inner = (
        b for mark in marks for b in (mark.metadata if isinstance(mark, FieldInfo) else [mark])
    )
    for bound in (*field.metadata, *inner):
        for sign, name in (("<", "gt"), ("<=", "ge")):
            if getattr(bound, name, None) is not None:
                low = f"{errors.shown(getattr(bound, name))} {sign} "
        for sign, name in (("<", "lt"), ("<=", "le")):
            if getattr(bound, name, None) is not None:
                high = f" {sign} {errors.shown(getattr(bound, name))}"
    unit = unit_of(field)
    if not low and not high:
        return ""
    return f"{low}value{high}" + (f" {unit}" if unit and unit != "1" else "")


def _branch_marks(annotation: Any) -> list[Any]:
    """Return the annotations of a union's branches: Annotated[float, Field(gt=0)]."""
    if get_origin(annotation) not in (Union, UnionType):
        return []
    return [mark for each in get_args(annotation) for mark in getattr(each, "__metadata__", ())]


def validated(model: type[Model], data: object, source: object = None) -> Model:
    """Return data as a model. Raises UsageError with `source`, or `FieldError` without it."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        found = field_error(error, model)
    except errors.FieldError as error:  # A validator of several fields names the field.
        found = error
    if source is None:
        raise found
    raise errors.UsageError(f"{source}: {found.line(sign=' = ')}")


def field_error(error: ValidationError, model: type[BaseModel] | None = None) -> errors.FieldError:
    """Return the first error of a failed validation as one line.

    The fields of `model` give ranges and names; None for other types that pydantic validates,
    mainly dataclasses.
    """
    findings = error.errors(include_url=False)
    # A misspelt field also causes a missing one: the misspelling is more helpful.
    first = min(findings, key=lambda finding: finding["type"] != "extra_forbidden")
    path, kind = first["loc"], first["type"]
    field = _dotted(model, path)
    # Errors of a union's branches for the same value count as one.
    same = [finding for finding in findings if _dotted(model, finding["loc"]) == field]
    others = len(findings) - len(same)
    tail = f" (and {others} more)" if others else ""
    if kind == "missing":
        return errors.FieldError(field, problem=f"missing{tail}")
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        names = _field_names(model, path[:-1])
        near = difflib.get_close_matches(str(path[-1])[:100], names, n=1)
        listed = ", ".join(names[:MOST_NAMES]) + (", ..." if len(names) > MOST_NAMES else "")
        hint = f"; did you mean {near[0]!r}?" if near else f"; fields: {listed}" if names else ""
        return errors.FieldError(field, problem=f"unknown field{hint}{tail}")
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        context = first.get("ctx", {})
        name = f"{field}.{str(context['discriminator']).strip(chr(39))}"
        if "expected_tags" not in context:
            return errors.FieldError(name, problem=f"missing{tail}")
        return errors.FieldError(name, context["tag"], f"{context['expected_tags']}{tail}")
    if kind == "value_error":
        return errors.FieldError(field, problem=first["msg"].removeprefix("Value error, ") + tail)
    accepted = " or ".join(dict.fromkeys(_accepted(finding, model) for finding in same))
    return errors.FieldError(field, first["input"], accepted + tail)


_BRANCH = ""
"""Placeholder for a location's part that does not name a field."""


def _steps(
    model: type[BaseModel] | None, path: tuple[int | str, ...]
) -> Iterator[tuple[int | str, FieldInfo | None, type[BaseModel] | None]]:
    """Yield each part of a location, the field with that name, and the model of the field.

    The part that selects a model of a union (`_choices`) is yielded as `_BRANCH`.
    """
    here = model
    choices: dict[str, type[BaseModel]] = {}
    for part in path:
        if str(part) in choices:
            here, choices = choices[str(part)], {}
            yield _BRANCH, None, here
            continue
        field = here.model_fields.get(str(part)) if here else None
        if field is not None:
            here, choices = _model_in(field.annotation), _choices(field)
        yield part, field, here


def _dotted(model: type[BaseModel] | None, path: tuple[int | str, ...]) -> str:
    """Return the dotted path of a location, without the branches of unions."""
    parts, plain = [], False
    for part, field, here in _steps(model, path):
        if plain and not isinstance(part, int):
            continue
        if part != _BRANCH:
            parts.append(str(part))
        if field is not None:
            plain = here is None and get_origin(field.annotation) in (Union, UnionType)
    return ".".join(parts)


def _choices(field: FieldInfo) -> dict[str, type[BaseModel]]:
    """Return the models of a field's tagged union by tag, for fields of one or several models."""
    name, union = field.discriminator, field.annotation
    for part in _annotated_parts(field.annotation):
        for mark in part.__metadata__:
            if isinstance(mark, FieldInfo) and mark.discriminator is not None:
                name, union = mark.discriminator, get_args(part)[0]
    if not isinstance(name, str):
        return {}
    return {
        str(value): model
        for model in get_args(union)
        for value in get_args(model.model_fields[name].annotation)
    }


def _annotated_parts(annotation: Any) -> Iterator[Any]:
    """Yield the parts of an annotation that are annotated: Annotated[...]."""
    if hasattr(annotation, "__metadata__"):
        yield annotation
    for inner in get_args(annotation):
        yield from _annotated_parts(inner)


def _accepted(finding: ErrorDetails, model: type[BaseModel] | None) -> str:
    """Return the accepted input in place of a wrong value."""
    path, kind = finding["loc"], finding["type"]
    if kind in ("model_type", "dataclass_type", "model_attributes_type"):
        names = _field_names(model, path)
        return f"a table with the fields {', '.join(names)}" if names else "a table"
    if kind in ("literal_error", "enum"):
        return str(finding["ctx"]["expected"])
    if kind == "string_pattern_mismatch":
        return f"a text that matches {finding['ctx']['pattern']}"
    return _declared_range(model, path) or TYPES.get(kind) or finding["msg"]


def _declared_range(model: type[BaseModel] | None, path: tuple[int | str, ...]) -> str:
    """Return the declared range of the innermost field in a location, or ""."""
    fields = [field for _, field, _ in _steps(model, path) if field is not None]
    return range_of(fields[-1]) if fields else ""


def _field_names(model: type[BaseModel] | None, path: tuple[int | str, ...]) -> list[str]:
    """Return the field names of the model at a location."""
    *_, owner = model, *(here for _, _, here in _steps(model, path))
    return list(owner.model_fields) if owner else []


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model in an annotation, including unions and containers; None = no model."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        if (found := _model_in(inner)) is not None:
            return found
    return None
