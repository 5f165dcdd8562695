"""Schemes: what a QPMPC's QP (eq:qp5) starts from, as data."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import SIZES, Layout, banded_matrix
from torch_qpmpc.mpc.model import Model

#: The paper's discount, the default.
GAMMA = 0.9
#: Keyword arguments of `QPMPC` that no scheme has.
KEYWORDS = ("learn", "structure", "step", "solver", "on_failure")
#: Those of models in place of A and B.
MODELS = ("dynamics", "iterations")


@dataclass(frozen=True, eq=False)
class Scheme:
    """An MPC scheme (eq:v1): the sizes, the model, the cost, the bounds and the discount.

    Its tensors are copies in float64 on the CPU. `dataclasses.replace` makes another with some
    fields changed.

    Args:
        layout: the sizes; the scheme counts the rows of its bounds itself.
        model: A, B, E and the offset.
        cost: the weights. A `QPMPC` needs A, B and a stage weight.
        bounds: no bounds by default.
        gamma: discount of the stage costs, 0 < gamma <= 1.
        constants: the entries of p that have one value only, such as a 1 in the state, by index.

    Raises:
        QPError: a part is of another type, or does not match the sizes; or the cost is not convex.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> model = qm.Model(A=[[1.0]], B=[[1.0]])
        >>> cost = qm.Cost(stage_weight=[1.0, 0.1])
        >>> bounds = qm.Bounds(action_bounds=([-1.0], [1.0]))
        >>> scheme = qm.Scheme(model.layout(horizon=3), model, cost, bounds)
        >>> qm.QPMPC(scheme).policy(torch.tensor([[0.1], [4.0]])).detach()
        tensor([[-0.0908],
                [-1.0000]])
    """

    layout: Layout
    model: Model = field(default_factory=Model)
    cost: Cost = field(default_factory=Cost)
    bounds: Bounds = field(default_factory=Bounds)
    gamma: float = GAMMA
    constants: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        kinds = {"layout": Layout, "model": Model, "cost": Cost, "bounds": Bounds}
        for name, kind in (kinds | {"constants": Mapping}).items():
            check_kind(name, getattr(self, name), kind)
        check_number("gamma", self.gamma, lambda x: 0 < x <= 1, "a discount factor in (0, 1]")
        object.__setattr__(self, "gamma", float(self.gamma))
        object.__setattr__(self, "layout", self.bounds.counted(self.layout))
        # Compares shapes and checks the cost.
        _ = self.theta if self.is_complete else self.bounds.rows(self.layout)

    @classmethod
    def of(
        cls,
        n_x: int,
        n_u: int,
        horizon: int,
        n_d: int = 0,
        *,
        blocks: Sequence[int] = (),
        gamma: float = GAMMA,
        constants: Mapping[int, float] | None = None,
        **options: Any,
    ) -> Scheme:
        """Return the scheme of sizes and of the arguments of its parts by name.

        Args:
            n_x, n_u, horizon, n_d, blocks: see `Layout`.
            gamma, constants: see `Scheme`.
            options: the arguments of `Model`, `Cost` and `Bounds`.

        Raises:
            QPError: an argument is invalid.
        """
        layout = Layout(n_x, n_u, horizon, n_d, blocks=blocks)
        model, cost, bounds = (
            {x.name: options.pop(x.name) for x in fields(kind) if x.name in options}
            for kind in (Model, Cost, Bounds)
        )
        if options:
            check_names(options, also=())
        return cls(layout, Model(**model), Cost(**cost), Bounds(**bounds), gamma, constants or {})

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `of` as tensors, tuples and plain values."""
        parts = (self.model, self.cost, self.bounds)
        return {
            **{name: getattr(self.layout, name) for name in (*SIZES, "blocks")},
            **{x.name: getattr(part, x.name) for part in parts for x in fields(part)},
            "gamma": self.gamma,
            "constants": {**self.constants},
        }

    @property
    def is_complete(self) -> bool:
        """True if there are A, B and a stage weight."""
        parts = (self.model.A, self.model.B, self.cost.stage_weight)
        return all(part is not None for part in parts)

    @property
    def of_actions(self) -> Tensor:
        """True for the rows of D that bound actions alone, or `Bounds.held`, ``(n_mixed,)``."""
        if self.bounds.held is not None:
            return self.bounds.held
        if self.bounds.constraints is None:
            return torch.zeros(0, dtype=torch.bool)
        return ~self.bounds.constraints[0][:, : -self.layout.n_u].any(-1)

    @cached_property
    def C_0(self) -> Tensor:
        """The banded C of the model (eq:cband), ``(N n_x, n_z)``."""
        with torch.device("cpu"):
            A, B, E = self.model.matrices(self.layout)
            return banded_matrix(A, B, self.layout.horizon, E)

    @cached_property
    def theta(self) -> dict[str, Tensor]:
        """The parts of theta by name, without discounts (eq:qpH); w is inf on hard rows."""
        layout, model, cost = self.layout, self.model, self.cost
        with torch.device("cpu"):
            C_0, (A, B, _) = self.C_0, model.matrices(layout)
            theta = {
                **cost.hessians(layout, A, B, self.gamma),
                "q": torch.zeros(layout.n_z, dtype=torch.float64),
                "c": torch.zeros((), dtype=torch.float64),
                "C": C_0,
                "b": model.offsets(layout),
                **self.bounds.rows(layout),
            }
        for name, value in (("q", cost.q), ("c", cost.c), ("C", model.C), ("b", model.b)):
            if value is None:
                continue
            if value.shape != theta[name].shape:
                got, want = tuple(value.shape), tuple(theta[name].shape)
                raise QPError.expected(name, f"shape {got}", f"shape {want}")
            theta[name] = value
        return theta

    def __repr__(self) -> str:
        return f"Scheme({self.layout}, hessian={self.cost.hessian!r}, gamma={self.gamma})"

    def __reduce__(self) -> tuple:
        # Without the cached C_0 and theta, which follow from the fields.
        return type(self), tuple(getattr(self, x.name) for x in fields(self))


def check_names(options: Iterable[str], also: Iterable[str] = (*KEYWORDS, *MODELS)) -> None:
    """Raise `TypeError` unless these are names of arguments of `Scheme.of`, or ``also`` known."""
    own = {x.name for part in (Model, Cost, Bounds) for x in fields(part)}
    known = {"blocks", "gamma", "constants", *SIZES}
    check_keywords("QPMPC", options, own | known | {*also})


def check_keywords(owner: str, options: Iterable[str], known: Iterable[str]) -> None:
    """Raise `TypeError` for the first of the options that is not known, with the nearest name."""
    for name in sorted({*options}.difference(known)):
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise TypeError(f"{owner} got an unexpected keyword argument {name!r}{hint}")
