"""Forms of the constraints that do not depend on their gauge.

``C z = b`` and ``T C z = T b`` are the same constraints for any invertible T, so the entries of C
by themselves say little. What they determine is the *prediction form*, which exists once only,

    X = Phi x_0 + Gamma U + phi,    X = [x_1, .., x_N],    U = [u_0, .., u_{N-1}],

and whatever is computed from it alone. The *canonical matrix* is the T C whose row block k reads
``x_{k+1} = A_k x_k + ..`` as that of an MPC scheme does: for such a scheme it is C_0 (eq:cband).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.qp.batching import broadcast

#: The remedy for what is no prediction form.
FORM = "Pass prediction_form(mpc.C, mpc.n_x, mpc.n_u, mpc.b)."
#: The largest condition number of C's state columns (after scaling its rows) that can be read: the
#: relative error of what is read is about 1e-16 times it.
LARGEST_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class PredictionForm:
    """X = Phi x_0 + Gamma U + phi, in float64.

    Attributes:
        Phi: ``(*batch, N n_x, n_x)``.
        Gamma: ``(*batch, N n_x, N n_u)``; block (k, j) is what u_j does to x_{k+1}.
        phi: the offset, ``(*batch, N n_x)``; zero where b is.
        condition: how far C's state columns are from singular, ``(*batch,)``; not gauge-free.
    """

    Phi: Tensor
    Gamma: Tensor
    phi: Tensor
    condition: Tensor

    @property
    def n_x(self) -> int:
        return self.Phi.shape[-1]

    @property
    def horizon(self) -> int:
        """N."""
        return self.Phi.shape[-2] // self.n_x

    @property
    def n_u(self) -> int:
        return self.Gamma.shape[-1] // self.horizon

    @property
    def blocks(self) -> Tensor:
        """Gamma by blocks, ``(*batch, N, N, n_x, n_u)``: [k, j] is what u_j does to x_{k+1}."""
        N = self.horizon
        rows = self.Gamma.unflatten(-1, (N, self.n_u)).unflatten(-3, (N, self.n_x))
        return rows.movedim(-2, -3)

    @property
    def maps(self) -> Tensor:
        """Each x_0, .., x_N as a linear map of (x_0, U, 1), ``(*batch, N + 1, n_x, n_v)``.

        n_v = n_x + N n_u + 1.
        """
        following = torch.cat((self.Phi, self.Gamma, self.phi.unsqueeze(-1)), dim=-1)
        first = torch.eye(self.n_x, following.shape[-1]).to(following)
        stages = following.unflatten(-2, (self.horizon, self.n_x))
        return torch.cat((first.expand(*stages.shape[:-3], 1, -1, -1), stages), dim=-3)

    def predict(self, x_0: Tensor, U: Tensor) -> Tensor:
        """x_1, .., x_N ``(*batch, N, n_x)`` from x_0 ``(*batch, n_x)``, U ``(*batch, N, n_u)``."""
        check_tensor("x_0", x_0, self.n_x)
        check_tensor("U", U, self.horizon, self.n_u)
        x_0, U = x_0.to(self.Phi), U.to(self.Phi)
        try:
            broadcast(self.Phi.shape[:-2], x_0.shape[:-1], U.shape[:-2])
        except RuntimeError as error:
            got, want = f"shape {tuple(U.shape)}", "leading dimensions that broadcast with x_0's"
            raise QPError.expected("U", got, f"{want}, {tuple(x_0.shape[:-1])}") from error
        X = self.Phi @ x_0.unsqueeze(-1) + self.Gamma @ U.flatten(-2).unsqueeze(-1)
        return (X.squeeze(-1) + self.phi).unflatten(-1, (self.horizon, self.n_x))


def check_form(form: PredictionForm) -> None:
    """Raise `QPError` unless ``form`` is one of a single C, without batch dimensions."""
    check_kind("form", form, PredictionForm, FORM)
    check_tensor("form.Phi", form.Phi, "N n_x", "n_x", batched=False, remedy="Take one at a time.")


def prediction_form(C: Tensor, n_x: int, n_u: int, b: Tensor | None = None) -> PredictionForm:
    """Solve ``C z = b`` for x_1, .., x_N.

    The result is that of T C and T b for any invertible T, up to rounding.

    Args:
        C: ``(*batch, N n_x, N (n_x + n_u) + n_x)``.
        n_x, n_u: numbers of states and actions.
        b: ``(*batch, N n_x)``; zero by default.

    Raises:
        QPError: the shapes do not fit, or C's state columns are singular: then the constraints
            do not determine the states from x_0 and the actions, and there is no such form.

    Example:
        >>> import torch
        >>> from torch_qpmpc.mpc.banded import banded_matrix
        >>> C_0 = banded_matrix(torch.tensor([[0.5]]), torch.tensor([[1.0]]), 3)
        >>> T = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [1.0, 0.0, 1.0]])
        >>> form = prediction_form(T @ C_0, 1, 1)
        >>> (form.Gamma + 0.0).round(decimals=6)
        tensor([[1.0000, 0.0000, 0.0000],
                [0.5000, 1.0000, 0.0000],
                [0.2500, 0.5000, 1.0000]], dtype=torch.float64)
    """
    check_whole("n_x", n_x, 1)
    check_whole("n_u", n_u, 1)
    check_tensor("C", C, "N n_x", "N (n_x + n_u) + n_x", remedy="Pass mpc.C.")
    n_c, n_z = C.shape[-2:]
    N = n_c // n_x
    if N < 1 or n_c != N * n_x or n_z != N * (n_x + n_u) + n_x:
        want = f"(*batch, N n_x, N (n_x + n_u) + n_x) with n_x = {n_x}, n_u = {n_u}"
        raise QPError.expected("C", f"shape {tuple(C.shape)}", want)
    b = C.new_zeros(n_c) if b is None else check_tensor("b", b, n_c)
    try:
        broadcast(C.shape[:-2], b.shape[:-1])
    except RuntimeError as error:
        got, want = f"shape {tuple(b.shape)}", "leading dimensions that broadcast with those of C"
        raise QPError.expected("b", got, f"{want}, {tuple(C.shape[:-2])}") from error
    C, b = (x.detach().to("cpu", torch.float64) for x in (C, b))
    if not (C.isfinite().all() and b.isfinite().all()):
        raise QPError.expected("C, b", "NaN or inf", "finite entries")
    # Rows of unit norm, so that a mere scale does not count as bad condition.
    size = C.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(C.dtype).tiny)
    C, b = C / size, b.unsqueeze(-1) / size
    following, x_0, u = (C[..., columns] for columns in _columns(n_x, n_u, N))
    condition = _condition(following)
    solved = torch.linalg.solve(following, torch.cat((-x_0, -u, b.expand(*x_0.shape[:-1], 1)), -1))
    Phi, Gamma, phi = solved.split((n_x, N * n_u, 1), dim=-1)
    return PredictionForm(Phi, Gamma, phi.squeeze(-1), condition)


def model_form(A: Tensor, B: Tensor, horizon: int, offset: Tensor | None = None) -> PredictionForm:
    """The prediction form of x+ = A x + B u + offset.

    Args:
        A, B: ``(n_x, n_x)`` and ``(n_x, n_u)``, or with a leading N for one per stage.
        horizon: N.
        offset: ``(n_x,)``, or ``(N, n_x)``; zero by default.

    Raises:
        QPError: shapes that do not fit each other or the horizon.
    """
    check_whole("horizon", horizon, 1)
    check_tensor("A", A, "n_x", "n_x")
    check_tensor("B", B, "n_x", "n_u")
    n_x, n_u = B.shape[-2:]
    offset = A.new_zeros(n_x) if offset is None else check_tensor("offset", offset, n_x)
    if offset.shape[:-1] not in ((), (horizon,)):
        got = f"shape {tuple(offset.shape)}"
        raise QPError.expected("offset", got, f"shape ({n_x},) or ({horizon}, {n_x})")
    C_0 = banded_matrix(A, B, horizon)
    return prediction_form(C_0, n_x, n_u, -offset.expand(horizon, n_x).flatten())


def canonical_matrix(form: PredictionForm, A: Tensor) -> tuple[Tensor, Tensor]:
    """The same constraints with row blocks ``A_k x_k + .. - x_{k+1}``, in x_0 and the actions.

    That is ``T C`` and ``T b`` for a T that follows from the constraints: of the rows of
    ``[Phi, Gamma, -I]``, each block has A_k times the one before subtracted. With the
    `stage_models` of an MPC scheme whose A_k can be told from its predictions, only the band is
    left, and this is C_0; in general, what a row has besides is what (x_k, u_k) do not explain.

    Args:
        form: of the constraints.
        A: ``(N, n_x, n_x)``, as `stage_models` finds them; the first does not matter.

    Returns:
        C ``(N n_x, N (n_x + n_u) + n_x)`` and b ``(N n_x,)``.
    """
    check_form(form)
    n_x, n_u, N = form.n_x, form.n_u, form.horizon
    check_tensor("A", A, N, n_x, n_x, batched=False, remedy="Pass stage_models(form).A.")
    A = A.to(form.Phi)
    F = form.Phi.new_zeros(N * n_x, N * (n_x + n_u) + n_x)
    following, x_0, u = _columns(n_x, n_u, N)
    F[:, x_0], F[:, u] = form.Phi, form.Gamma
    F[:, following] = -torch.eye(N * n_x).to(F)
    rows = torch.cat((F, -form.phi.unsqueeze(-1)), dim=-1).unflatten(0, (N, n_x))
    canonical = torch.cat((rows[:1], rows[1:] - A[1:] @ rows[:-1])).flatten(0, 1)
    return canonical[:, :-1], canonical[:, -1]


def _columns(n_x: int, n_u: int, horizon: int) -> tuple[Tensor, Tensor, Tensor]:
    """The columns of z = [x_0, u_0, x_1, ..] that hold x_1, .., x_N, those of x_0, those of U."""
    z = torch.arange(horizon * (n_x + n_u) + n_x)
    is_state = z % (n_x + n_u) < n_x
    return z[is_state & (z >= n_x)], z[:n_x], z[~is_state]


def _condition(following: Tensor) -> Tensor:
    """Of C's state columns ``(*batch, n_c, n_c)``; `QPError` if they cannot be solved for."""
    values = torch.linalg.svdvals(following)
    condition = values[..., 0] / values[..., -1]
    # Not the negation: 0 / 0 is nan, which is no good condition either.
    if not (condition <= LARGEST_CONDITION).all():
        worst = values.reshape(-1, values.shape[-1])[values[..., -1].argmin()]
        rank = int((worst > worst[0] / LARGEST_CONDITION).sum())
        got = f"state columns of rank {rank} of {len(worst)}"
        got += f" (condition number {worst[0] / worst[-1]:.2g})"
        raise QPError.expected(
            "C",
            got,
            f"a condition number of at most {LARGEST_CONDITION:.0e}",
            "These constraints do not determine x_1, .., x_N from x_0 and the actions, so have no "
            "prediction form. Penalise the deviation from C_0, or learn C at a smaller rate.",
        )
    return condition
