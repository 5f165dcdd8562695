"""Types of configuration values, each with the phrase for its error message."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic import ValidationError as Invalid
from pydantic_core import CoreSchema, PydanticCustomError, core_schema


class Group(BaseModel):
    """A group of keys that forbids unknown keys and converts no values."""

    model_config = ConfigDict(extra="forbid", strict=True)


@dataclass(frozen=True)
class Expected:
    """An annotation that replaces pydantic's error message.

    Attributes:
        phrase: the allowed values, for the message.
        schema: replaces the schema of the annotated type.
    """

    phrase: str
    schema: CoreSchema | None = field(default=None, compare=False)

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(kind) if self.schema is None else self.schema
        return core_schema.no_info_wrap_validator_function(self._check, schema)

    def _check(self, value: Any, inner: core_schema.ValidatorFunctionWrapHandler) -> Any:
        try:
            return inner(value)
        except Invalid:
            context = {"expected": self.phrase}
            raise PydanticCustomError("unexpected", "{expected}", context) from None


def one_of(names: tuple[str, ...]) -> Expected:
    """Allow one of ``names``."""
    return Expected(f"one of {', '.join(names)}", core_schema.literal_schema(list(names)))


def some_of(names: tuple[str, ...]) -> Expected:
    """Allow a list of some of ``names``."""
    known = core_schema.literal_schema(list(names))
    return Expected(f"a list of {', '.join(names)}", core_schema.list_schema(known))


def _equally_long(rows: list[list[float]]) -> list[list[float]]:
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError
    return rows


Flag = Annotated[bool, Expected("true or false")]
Name = Annotated[str, Expected("a name")]
Whole = Annotated[int, Field(ge=0), Expected("a whole number >= 0")]
Count = Annotated[int, Field(ge=1), Expected("a whole number >= 1")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0), Expected("a finite number > 0")]
NonNegative = Annotated[Finite, Field(ge=0), Expected("a finite number >= 0")]
Fraction = Annotated[Finite, Field(gt=0, le=1), Expected("a number in (0, 1]")]
#: Weight of a slack; inf makes the row hard.
Weight = Annotated[
    float,
    Field(ge=0),
    Expected("a number >= 0; for hard rows .inf in a file, inf on the command line"),
]
MATRIX = Expected("a list of equally long rows of finite numbers")
Matrix = Annotated[list[list[Finite]], AfterValidator(_equally_long), MATRIX]
