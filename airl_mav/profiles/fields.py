"""How a profile field is declared: a value with a meaning, a unit and a range."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined


class ProfileModel(BaseModel):
    """Base of all profile models: immutable, unknown fields refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def quantity(
    description: str,
    unit: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    default: Any = PydanticUndefined,
) -> Any:
    """Declare a number (or list of numbers) with its unit and the range of each element.

    Args:
        description: What the number means.
        unit: Its unit, "1" when it has none.
        ge: Least value allowed.
        gt: Value that it must exceed.
        le: Greatest value allowed.
        lt: Value that it must stay below.
        default: Value when the file leaves it out; none means that it is required.
    """
    scalar = any(bound is not None for bound in (ge, gt, le, lt))
    return Field(
        default=default,
        description=description,
        # Strict, or true and "1.5" would pass for numbers; a tuple in strict mode refuses lists.
        strict=True if scalar else None,
        ge=ge,
        gt=gt,
        le=le,
        lt=lt,
        json_schema_extra={"unit": unit},
    )


def unit_of(field: FieldInfo) -> str | None:
    """Return the unit a field was declared with."""
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else None


def range_of(field: FieldInfo) -> str:
    """Return the accepted range of a field as text: "0 < value <= 10 kg", or "" when unbounded."""
    low = high = ""
    for bound in field.metadata:
        for sign, name in (("<", "gt"), ("<=", "ge")):
            if getattr(bound, name, None) is not None:
                low = f"{getattr(bound, name):g} {sign} "
        for sign, name in (("<", "lt"), ("<=", "le")):
            if getattr(bound, name, None) is not None:
                high = f" {sign} {getattr(bound, name):g}"
    unit = unit_of(field)
    if not low and not high:
        return ""
    return f"{low}value{high}" + (f" {unit}" if unit and unit != "1" else "")
