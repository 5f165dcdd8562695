"""QPMPC: the module that owns theta and turns it into V, Q and the policy (eq:qp4, eq:qp5).

A generic QP whose constraint matrix C starts as that of a linear MPC scheme (eq:cband) and may
leave it. Everything here is a cost to go, as in the paper; rewards begin in `operators`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.arguments import (
    CONSTRAINTS,
    COST,
    as_tensor,
    bound,
    check_input,
    check_slack,
    check_structure,
    cost_weights,
)
from torch_qpmpc.autograd import optimal_value, solve_qp
from torch_qpmpc.banded import banded_matrix
from torch_qpmpc.batching import broadcast
from torch_qpmpc.errors import QPError
from torch_qpmpc.parametrizations import Cholesky, SquareRoot
from torch_qpmpc.qp import QPSolution, QuadraticProgram
from torch_qpmpc.solvers import backend


class QPMPC(nn.Module):
    """A parametric QP in z = [x_0, u_0, x_1, .., x_N], n_z = N (n_x + n_u) + n_x (eq:qp5).

    The cost (eq:qpH) has a stage block H_k, q_k for (x_k, u_k), discounted by gamma^k, and a
    terminal block H_f, q_f for x_N, discounted by gamma^N. Parameters and buffers are float64,
    inputs of any float dtype; outputs have the dtype of the input.

    Args:
        n_x: number of states.
        n_u: number of actions.
        horizon: N, at least 1.
        gamma: discount of the stage costs, 0 < gamma <= 1.
        A, B: the model that C starts from, ``(n_x, n_x)`` and ``(n_x, n_u)``, or one per stage,
            ``(N, n_x, n_x)`` and ``(N, n_x, n_u)``. By default random: A the identity plus, and B,
            normal entries with standard deviation 0.1.
        state_bounds, action_bounds: pairs of ``(n_x,)`` and ``(n_u,)``; unbounded by default.
        hessian: ``"diagonal"``, ``"block"`` (one dense block a stage) or ``"full"`` (dense in z).
        stage_weight: start of H_k, ``(n_x + n_u,)`` if diagonal, else ``(n_x + n_u, n_x + n_u)``,
            with an optional leading N for a weight of each stage's own; by default diagonal
            random entries uniform in (0.5, 5) on the states and zero on the actions.
        terminal_weight: start of H_f, ``(n_x,)`` or ``(n_x, n_x)``; the identity by default.
        state_slack, action_slack: the slack weights w of the rows of states and of actions;
            ``inf`` makes them hard. Soft states and hard actions by default.
        discount_slack: discount w by gamma^k, as the MPC form does (eq:v1c0), or not (eq:qp2c0).
        learn: which of H, H_f, q, c, C, b, G, lb, ub, w are parameters; the others are buffers.
        solver, on_failure: as in `solve_qp`.
        seed: of the random starts.

    Attributes:
        C_0: the banded matrix that C started from, ``(N n_x, n_z)``.

    Raises:
        QPError: an argument that does not fit, by name.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model(
        ...     torch.eye(1),
        ...     torch.eye(1),
        ...     3,
        ...     action_bounds=([-1.0], [1.0]),
        ...     stage_weight=[1.0, 0.1],
        ...     state_bounds=([-5.0], [5.0]),
        ... )
        >>> mpc.policy(torch.tensor([[0.1], [4.0]])).detach()
        tensor([[-0.0908],
                [-1.0000]])
    """

    H: Tensor
    H_f: Tensor
    q: Tensor
    c: Tensor
    C: Tensor
    b: Tensor
    G: Tensor
    lb: Tensor
    ub: Tensor
    w: Tensor
    C_0: Tensor
    discount: Tensor
    soft: Tensor

    def __init__(
        self,
        n_x: int,
        n_u: int,
        horizon: int,
        *,
        gamma: float = 0.9,
        A: Any = None,
        B: Any = None,
        state_bounds: tuple[Any, Any] | None = None,
        action_bounds: tuple[Any, Any] | None = None,
        hessian: str = "diagonal",
        stage_weight: Any = None,
        terminal_weight: Any = None,
        state_slack: float = 100.0,
        action_slack: float = torch.inf,
        discount_slack: bool = False,
        learn: Collection[str] = ("H", "c", "C"),
        solver: str = "proxqp",
        on_failure: str = "raise",
        seed: int = 0,
    ) -> None:
        arguments = {
            name: value for name, value in locals().items() if name not in ("self", "__class__")
        }
        super().__init__()
        self._arguments = arguments
        check_structure(n_x, n_u, horizon, gamma, hessian, learn, on_failure)
        backend(solver)
        self.n_x, self.n_u, self.horizon, self.gamma = n_x, n_u, horizon, gamma
        self.n_z = horizon * (n_x + n_u) + n_x
        self.hessian, self.solver, self.on_failure = hessian, solver, on_failure
        self.learned = tuple(name for name in (*COST, *CONSTRAINTS) if name in learn)

        random = torch.Generator().manual_seed(seed)
        if A is None:
            A = torch.eye(n_x) + 0.1 * torch.randn(n_x, n_x, generator=random)
        if B is None:
            B = 0.1 * torch.randn(n_x, n_u, generator=random)
        if stage_weight is None:
            weights = 0.5 + 4.5 * torch.rand(n_x, generator=random)
            stage_weight = torch.cat((weights, torch.zeros(n_u)))
        if terminal_weight is None:
            terminal_weight = torch.ones(n_x)

        A, B = as_tensor("A", A), as_tensor("B", B)
        if A.shape[-1:] != (n_x,) or B.shape[-1:] != (n_u,):
            got = f"shapes {tuple(A.shape)} and {tuple(B.shape)}"
            raise QPError.expected("A, B", got, f"({n_x}, {n_x}) and ({n_x}, {n_u})")
        powers = gamma ** torch.arange(horizon + 1, dtype=torch.float64).unsqueeze(-1)
        discount = self._per_entry(powers.expand(-1, n_x), powers.expand(-1, n_u))
        self.register_buffer("discount", discount, persistent=False)
        self.register_buffer("C_0", banded_matrix(A, B, horizon))
        weights = cost_weights(stage_weight, terminal_weight, hessian, n_x, n_u, horizon)
        for name, start in weights.items():
            self._own(name, start)
            if name in self.learned:
                kind = SquareRoot() if hessian == "diagonal" else Cholesky()
                parametrize.register_parametrization(self, name, kind)
        self._own("q", torch.zeros(self.n_z))
        self._own("c", torch.zeros(()))
        self._own("C", self.C_0)
        self._own("b", torch.zeros(horizon * n_x))
        self._own("G", torch.eye(self.n_z))
        for name, side in (("lb", 0), ("ub", 1)):
            x = bound("state_bounds", state_bounds, side, n_x).expand(horizon + 1, -1)
            u = bound("action_bounds", action_bounds, side, n_u).expand(horizon + 1, -1)
            self._own(name, self._per_entry(x, u))
        if not (self.lb <= self.ub).all():
            raise QPError.expected("state_bounds, action_bounds", "lower > upper", "lower <= upper")
        check_slack("state_slack", state_slack)
        check_slack("action_slack", action_slack)
        self._own_slack_weights(state_slack, action_slack, discount_slack)

    @classmethod
    def from_model(cls, A: Any, B: Any, horizon: int, **options: Any) -> QPMPC:
        """A QPMPC whose C starts at the banded C_0 of the model x+ = A x + B u (eq:cband).

        Args:
            A, B: as for `QPMPC`, from which n_x and n_u are read.
            horizon: N.
            options: the keyword arguments of `QPMPC`.
        """
        A, B = as_tensor("A", A), as_tensor("B", B)
        if A.ndim < 2 or B.ndim < 2:
            got = f"shapes {tuple(A.shape)} and {tuple(B.shape)}"
            raise QPError.expected("A, B", got, "matrices (n_x, n_x) and (n_x, n_u)")
        return cls(A.shape[-1], B.shape[-1], horizon, A=A, B=B, **options)

    def value(self, s: Tensor) -> Tensor:
        """V(s) (eq:qp4), a cost to go: s ``(*batch, n_x)`` to ``(*batch,)``."""
        return self._value(check_input("s", s, self.n_x))

    def action_value(self, s: Tensor, a: Tensor) -> Tensor:
        """Q(s, a) (eq:qp5), a cost to go: ``(*batch, n_x)``, ``(*batch, n_u)`` to ``(*batch,)``."""
        return self._value(self._state_action(s, a))

    def policy(self, s: Tensor) -> Tensor:
        """pi(s), the u_0 of V's solution: s ``(*batch, n_x)`` to ``(*batch, n_u)``."""
        return self.solve(s).z[..., self.n_x : self.n_x + self.n_u].to(s.dtype)

    def forward(self, s: Tensor, a: Tensor | None = None) -> Tensor:
        """V(s), or Q(s, a) where an action is given."""
        return self.value(s) if a is None else self.action_value(s, a)

    def solve(
        self, s: Tensor, a: Tensor | None = None, warm_start: QPSolution | Tensor | None = None
    ) -> QPSolution:
        """The whole solution of V's QP, or of Q's where an action is given, in theta's dtype."""
        fixed = check_input("s", s, self.n_x) if a is None else self._state_action(s, a)
        qp = self.quadratic_program()
        return solve_qp(
            qp,
            fixed.to(qp.C.dtype),
            solver=self.solver,
            on_failure=self.on_failure,
            warm_start=warm_start,
            keep=self.n_x + self.n_u,
        )

    def predicted(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """The states ``(*batch, N + 1, n_x)`` and actions ``(*batch, N, n_u)`` of z."""
        n = self.n_x + self.n_u
        stages = z[..., : self.horizon * n].unflatten(-1, (self.horizon, n))
        terminal = z[..., None, self.horizon * n :]
        return torch.cat((stages[..., : self.n_x], terminal), -2), stages[..., self.n_x :]

    def quadratic_program(self) -> QuadraticProgram:
        """Today's theta as a QuadraticProgram, discounts included (eq:qpH)."""
        return QuadraticProgram(
            H=self._hessian(),
            q=self.discount * self.q,
            c=self.c,
            C=self.C,
            b=self.b,
            G=self.G,
            lb=self.lb,
            ub=self.ub,
            w=torch.where(self.soft, self.w, torch.inf),
            check_values=False,
        )

    def parameter_groups(self, rates: Mapping[str, float]) -> list[dict[str, Any]]:
        """Parameter groups for an optimiser, one for each learned part of theta.

        Args:
            rates: learning rates by part (``"H"``, ``"C"``, ..), or for the rest of the
                ``"cost"`` (H, H_f, q, c, w) and of the ``"constraints"`` (C, b, G, lb, ub), which
                the paper advises to learn at rates of their own.

        Raises:
            QPError: a learned part without a rate, or a name that is neither.
        """
        known = {*COST, *CONSTRAINTS, "cost", "constraints"}
        if unknown := set(rates) - known:
            raise QPError.expected("rates", sorted(unknown), f"names among {sorted(known)}")
        groups = []
        for part in self.learned:
            rate = rates.get(part, rates.get("cost" if part in COST else "constraints"))
            if rate is None:
                raise QPError.expected(
                    "rates", f"nothing for {part}", "a rate for every learned part, or its family"
                )
            groups.append({"params": [self._leaf(part)], "lr": rate, "name": part})
        return groups

    def reset_parameters(self) -> None:
        """Return theta to where the constructor put it."""
        fresh = parametrize.type_before_parametrizations(self)(**self._arguments)
        for name, start in fresh.state_dict().items():
            owner, _, leaf = name.rpartition(".")
            # By attribute: a functional call puts plain tensors in the place of parameters.
            getattr(self.get_submodule(owner), leaf).data.copy_(start)

    def extra_repr(self) -> str:
        return (
            f"n_x={self.n_x}, n_u={self.n_u}, horizon={self.horizon}, hessian={self.hessian!r}, "
            f"learned={self.learned}, solver={self.solver!r}"
        )

    def __reduce_ex__(self, protocol: Any) -> tuple:
        # A parametrised module refuses to be pickled, which would bar it from spawned collectors.
        plain = parametrize.type_before_parametrizations(self)
        frozen = [name for name, part in self.named_parameters() if not part.requires_grad]
        return _rebuild, (plain, self._arguments, self.state_dict(), frozen, self.training)

    def _value(self, fixed: Tensor) -> Tensor:
        qp = self.quadratic_program()
        keep = self.n_x + self.n_u
        value = optimal_value(
            qp, fixed.to(qp.C.dtype), solver=self.solver, on_failure=self.on_failure, keep=keep
        )
        return value.to(fixed.dtype)

    def _state_action(self, s: Tensor, a: Tensor) -> Tensor:
        s, a = check_input("s", s, self.n_x), check_input("a", a, self.n_u)
        try:
            batch = broadcast(s.shape[:-1], a.shape[:-1])
        except RuntimeError as error:
            got = f"shape {tuple(a.shape)}"
            want = f"leading dimensions that broadcast with those of s, {tuple(s.shape[:-1])}"
            raise QPError.expected("a", got, want) from error
        return torch.cat((s.expand(*batch, -1), a.expand(*batch, -1).to(s.dtype)), dim=-1)

    def _per_entry(self, x: Tensor, u: Tensor) -> Tensor:
        """Lay out values ``(N + 1, n_x)`` and ``(N + 1, n_u)`` in the order of z (no u_N)."""
        return torch.cat((x, u), dim=-1).flatten()[: self.n_z]

    def _own(self, name: str, value: Tensor) -> None:
        """Register a part of theta, as a parameter if it is learned."""
        value = value.to(torch.float64).clone()
        if name in self.learned:
            self.register_parameter(name, nn.Parameter(value))
        else:
            self.register_buffer(name, value)

    def _own_slack_weights(self, state: float, action: float, discounted: bool) -> None:
        x, u = torch.full((self.n_x,), float(state)), torch.full((self.n_u,), float(action))
        w = self._per_entry(x.expand(self.horizon + 1, -1), u.expand(self.horizon + 1, -1))
        self.register_buffer("soft", w.isfinite())
        # A hard row's entry is a placeholder: inf as a parameter would have NaN gradients.
        w = w.masked_fill(~self.soft, 0.0).to(torch.float64)
        self._own("w", w * self.discount if discounted else w)
        if "w" in self.learned:
            parametrize.register_parametrization(self, "w", SquareRoot())

    def _hessian(self) -> Tensor:
        if self.hessian == "full":
            H = self.H
        elif self.hessian == "block":
            n = self.n_x + self.n_u
            H = torch.block_diag(*self.H.expand(self.horizon, n, n), self.H_f)
        else:
            stages = self.H.expand(self.horizon, self.n_x + self.n_u).flatten()
            return torch.diag_embed(self.discount * torch.cat((stages, self.H_f)))
        root = self.discount.sqrt()
        return root.unsqueeze(-1) * H * root

    def _leaf(self, name: str) -> nn.Parameter:
        """The parameter that the optimiser moves for a learned part: behind H its factor."""
        if parametrize.is_parametrized(self, name):
            return self.get_parameter(f"parametrizations.{name}.original")
        return self.get_parameter(name)


def _rebuild(
    cls: type[QPMPC], arguments: dict, state: dict, frozen: list[str], training: bool
) -> QPMPC:
    mpc = cls(**arguments)
    mpc.load_state_dict(state, assign=True)
    mpc.discount = mpc.discount.to(mpc.C_0)  # not part of the state
    for name in frozen:
        mpc.get_parameter(name).requires_grad_(False)
    return mpc.train(training)
