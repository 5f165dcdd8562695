"""Models of the configuration groups in configs/."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.fields import (
    Count,
    Expected,
    Finite,
    Fraction,
    Group,
    Name,
    NonNegative,
    Positive,
    one_of,
    some_of,
)
from torch_qpmpc.mpc.validation import CONSTRAINTS, STRUCTURES

Beta = Annotated[float, Field(ge=0, lt=1)]


class Noise(Group):
    name: Name
    std: Annotated[NonNegative | None, Expected("a finite number >= 0, or null for the task's own")]


class Deviation(Group):
    c_1: NonNegative
    c_2: NonNegative
    c_3: NonNegative


class SystemIdentification(Group):
    beta: NonNegative
    windows: Count


class Constraint(Group):
    """The learned constraints and their penalties; a null penalty is off."""

    name: Name
    structure: Annotated[str, one_of(STRUCTURES)]
    learn: Annotated[list[str], some_of(CONSTRAINTS)]
    deviation: Deviation | None
    si: SystemIdentification | None

    @model_validator(mode="after")
    def penalties_are_on_a_free_C(self) -> Self:
        if (self.deviation is not None or self.si is not None) and "C" not in self.learn:
            expected = "a list with C, because a penalty on C is on"
            remedy = "Set the penalty to null, or learn C."
            raise QPError.expected("constraint.learn", repr(self.learn), expected, remedy)
        if self.deviation is not None and self.structure != "free":
            remedy = "A tied C has nothing off its band to penalise."
            raise QPError.expected("constraint.structure", repr(self.structure), "free", remedy)
        return self

    @model_validator(mode="after")
    def ties_have_no_mixed_constraints(self) -> Self:
        if self.structure != "free" and "G" in self.learn:
            remedy = "No task has mixed constraints to learn."
            raise QPError.expected("constraint.learn", repr(self.learn), "no G", remedy)
        return self


class SGD(Group):
    name: Literal["sgd"]
    lr_cost: NonNegative
    lr_constraints: NonNegative
    final_fraction: Fraction


class Adam(SGD):
    name: Literal["adam"]
    betas: Annotated[
        list[Beta], Field(min_length=2, max_length=2), Expected("two numbers in [0, 1)")
    ]


class GaussNewton(Group):
    name: Literal["gauss_newton"]
    lr: Fraction
    scale_constraints: Positive
    damping: Positive
    final_fraction: Fraction


class FromModel(Group):
    """Learning starts from the model of the task."""

    name: Literal["model"]


class FromData(Group):
    """Learning starts from a model that is identified from a log."""

    name: Literal["data"]
    file: Annotated[str | None, Expected("a path, or null")]
    transitions: Count
    levels: Annotated[str, one_of(("uniform", "binary"))]
    hold: Annotated[Finite, Field(ge=1), Expected("a finite number >= 1")]
    ridge: Annotated[NonNegative | None, Expected("a finite number >= 0, or null")]


Optimizer = Annotated[Adam | SGD | GaussNewton, Field(discriminator="name")]
Start = Annotated[FromModel | FromData, Field(discriminator="name")]
