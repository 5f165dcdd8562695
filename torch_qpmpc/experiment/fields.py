"""Types of configuration values; pydantic checks them and words their errors."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class Group(BaseModel):
    """A group of keys that forbids unknown keys, converts no values, and takes finite numbers."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _equally_long(rows: list[list[float]]) -> list[list[float]]:
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError("rows should be equally long")
    return rows


Whole = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, le=1)]
#: Weight of a slack; inf makes the row hard.
Weight = Annotated[float, Field(ge=0, allow_inf_nan=True)]
Matrix = Annotated[list[list[float]], AfterValidator(_equally_long)]
