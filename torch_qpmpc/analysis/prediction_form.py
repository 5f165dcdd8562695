"""Forms of the constraints that do not depend on their gauge.

``C z = b`` and ``T C z = T b`` are the same constraints for any invertible T, so single entries of
C mean little. Independent of T is the *prediction form*,

    X = Phi p + Gamma U + phi,    X = [x_1, .., x_N],    U = [u_0, .., u_{N-1}],

and all that follows from it. p is what V fixes: x_0 or, with a window and a preview, all of z up to
x_0 (see `torch_qpmpc.mpc.layout`). The *canonical matrix* is the T C whose row block k reads
``x_{k+1} = A_k x_k + ..``, as in an MPC scheme: for such a scheme it is C_0 (eq:cband).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.qp.batching import broadcast

FORM_REMEDY = "Pass torch_qpmpc.analysis.report.predictions(mpc)."
#: The largest accepted condition number of C's state columns, after scaling its rows. The relative
#: error of a prediction form is about 1e-16 times that number.
LARGEST_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class PredictionForm:
    """X = Phi p + Gamma U + phi, in float64.

    Attributes:
        Phi: ``(*batch, N n_x, n_p)``.
        Gamma: ``(*batch, N n_x, N n_u)``; block (k, j) is the effect of u_j on x_{k+1}.
        phi: the offset, ``(*batch, N n_x)``; zero if b is.
        condition: condition number of C's state columns, ``(*batch,)``; depends on the gauge.
        layout: the sizes of z.
    """

    Phi: Tensor
    Gamma: Tensor
    phi: Tensor
    condition: Tensor
    layout: Layout

    @property
    def n_x(self) -> int:
        """The number of states."""
        return self.layout.n_x

    @property
    def n_u(self) -> int:
        """The number of actions."""
        return self.layout.n_u

    @property
    def n_p(self) -> int:
        """The number of entries of p."""
        return self.layout.n_p

    @property
    def horizon(self) -> int:
        """The horizon N."""
        return self.layout.horizon

    @property
    def blocks(self) -> Tensor:
        """Gamma by blocks, ``(*batch, N, N, n_x, n_u)``: [k, j] is the effect of u_j on x_{k+1}."""
        N = self.horizon
        rows = self.Gamma.unflatten(-1, (N, self.n_u)).unflatten(-3, (N, self.n_x))
        return rows.movedim(-2, -3)

    @property
    def maps(self) -> Tensor:
        """The states x_0, .., x_N as linear maps of (p, U, 1), ``(*batch, N + 1, n_x, n_v)``.

        n_v is n_p + N n_u + 1.
        """
        following = torch.cat((self.Phi, self.Gamma, self.phi.unsqueeze(-1)), dim=-1)
        first = torch.eye(self.n_p, following.shape[-1])[-self.n_x :].to(following)
        stages = following.unflatten(-2, (self.horizon, self.n_x))
        return torch.cat((first.expand(*stages.shape[:-3], 1, -1, -1), stages), dim=-3)

    def predict(self, p: Tensor, U: Tensor) -> Tensor:
        """Predict ``(*batch, N, n_x)`` from p ``(*batch, n_p)`` and U ``(*batch, N, n_u)``.

        Raises:
            QPError: if a shape does not fit.
        """
        check_tensor("p", p, self.n_p)
        check_tensor("U", U, self.horizon, self.n_u)
        p, U = p.to(self.Phi), U.to(self.Phi)
        try:
            broadcast(self.Phi.shape[:-2], p.shape[:-1], U.shape[:-2])
        except RuntimeError as error:
            got, want = f"shape {tuple(U.shape)}", "leading dimensions that broadcast with those of"
            raise QPError.expected("U", got, f"{want} p, {tuple(p.shape[:-1])}") from error
        X = self.Phi @ p.unsqueeze(-1) + self.Gamma @ U.flatten(-2).unsqueeze(-1)
        return (X.squeeze(-1) + self.phi).unflatten(-1, (self.horizon, self.n_x))


def check_form(form: PredictionForm) -> None:
    """Raise `QPError` unless ``form`` is a prediction form without batch dimensions."""
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    remedy = "Pass the form of a single C."
    check_tensor("form.Phi", form.Phi, "N n_x", "n_p", batched=False, remedy=remedy)


def prediction_form(
    C: Tensor, n_x: int, n_u: int, b: Tensor | None = None, past: int = 1, n_d: int = 0
) -> PredictionForm:
    """Solve ``C z = b`` for x_1, .., x_N.

    T C and T b have the same prediction form for any invertible T, up to rounding.

    Args:
        C: ``(*batch, N n_x, n_z)``; n_z is N (n_x + n_u) + n_x without a window and a preview.
        n_x, n_u: numbers of states and actions.
        b: ``(*batch, N n_x)``; zero by default.
        past, n_d: L and the entries of d_k, as in `QPMPC`.

    Raises:
        QPError: if the shapes do not fit, or C's state columns are singular, so that p and the
            actions do not determine the states.

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
    check_whole("past", past, 1)
    check_whole("n_d", n_d, 0)
    check_tensor("C", C, "N n_x", "n_z", remedy="Pass mpc.C.")
    n_c, n_z = C.shape[-2:]
    N = n_c // n_x
    layout = Layout(n_x, n_u, max(N, 1), past, n_d)
    if N < 1 or n_c != N * n_x or n_z != layout.n_z:
        want = f"(*batch, N n_x, n_p + N (n_x + n_u)) with n_x = {n_x}, n_u = {n_u}"
        raise QPError.expected("C", f"shape {tuple(C.shape)}", f"{want}, n_p = {layout.n_p}")
    b = C.new_zeros(n_c) if b is None else check_tensor("b", b, n_c)
    try:
        broadcast(C.shape[:-2], b.shape[:-1])
    except RuntimeError as error:
        got, want = f"shape {tuple(b.shape)}", "leading dimensions that broadcast with those of C"
        raise QPError.expected("b", got, f"{want}, {tuple(C.shape[:-2])}") from error
    C, b = (x.detach().to("cpu", torch.float64) for x in (C, b))
    if not (C.isfinite().all() and b.isfinite().all()):
        raise QPError.expected("C, b", "NaN or inf", "finite entries")
    # Rows of unit norm, so that their scale does not affect the condition number.
    size = C.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(C.dtype).tiny)
    C, b = C / size, b.unsqueeze(-1) / size
    following, p, u = (C[..., columns] for columns in _columns(layout))
    condition = _condition(following)
    solved = torch.linalg.solve(following, torch.cat((-p, -u, b.expand(*p.shape[:-1], 1)), -1))
    Phi, Gamma, phi = solved.split((layout.n_p, N * n_u, 1), dim=-1)
    return PredictionForm(Phi, Gamma, phi.squeeze(-1), condition, layout)


def canonical_matrix(form: PredictionForm, A: Tensor) -> tuple[Tensor, Tensor]:
    """Return the same constraints with row blocks ``A_k x_k + .. - x_{k+1}``.

    They are ``T C`` and ``T b`` for a T that follows from the constraints: from each row block of
    ``[Phi, Gamma, -I]``, A_k times the block before it is subtracted; with a window of L, each lag
    of A_k times its block. For an MPC scheme whose predictions determine its A_k, as
    `stage_models`, only the band remains, and the result is C_0. In general, a row's other entries,
    in p and the actions, are what (x_k, u_k), or the window at k, do not explain.

    Args:
        form: the prediction form of the constraints.
        A: ``(N, n_x, L n_x)``, such as ``stage_models(form).A``; lags that reach x_0 or an earlier
            state are not used.

    Returns:
        C ``(N n_x, n_z)`` and b ``(N n_x,)``.

    Raises:
        QPError: if ``form`` has batch dimensions, or the shape of A does not fit.
    """
    check_form(form)
    n_x, N, past = form.n_x, form.horizon, form.layout.past
    check_tensor("A", A, N, n_x, past * n_x, batched=False, remedy="Pass stage_models(form).A.")
    A = A.to(form.Phi)
    F = form.Phi.new_zeros(N * n_x, form.layout.n_z)
    following, p, u = _columns(form.layout)
    F[:, p], F[:, u] = form.Phi, form.Gamma
    F[:, following] = -torch.eye(N * n_x).to(F)
    rows = torch.cat((F, -form.phi.unsqueeze(-1)), dim=-1).unflatten(0, (N, n_x))
    canonical = rows.clone()
    for lag, A_lag in enumerate(A.split(n_x, dim=-1), start=1):
        canonical[lag:] -= A_lag[lag:] @ rows[:-lag]
    canonical = canonical.flatten(0, 1)
    return canonical[:, :-1], canonical[:, -1]


def _columns(layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns of x_1, .., x_N, of p and of U in z."""
    z = torch.arange(layout.n_z)
    plan = z[layout.n_p :].unflatten(0, (layout.horizon, layout.n))
    return plan[:, layout.n_u :].flatten(), z[: layout.n_p], plan[:, : layout.n_u].flatten()


def _condition(following: Tensor) -> Tensor:
    """Return the condition number of ``(*batch, n_c, n_c)``; raise `QPError` if it is too large."""
    values = torch.linalg.svdvals(following)
    condition = values[..., 0] / values[..., -1]
    # Written so that nan, from 0 / 0, is rejected, too.
    if not (condition <= LARGEST_CONDITION).all():
        worst = values.reshape(-1, values.shape[-1])[values[..., -1].argmin()]
        rank = int((worst > worst[0] / LARGEST_CONDITION).sum())
        got = f"state columns of rank {rank} of {len(worst)}"
        got += f" (condition number {worst[0] / worst[-1]:.2g})"
        raise QPError.expected(
            "C",
            got,
            f"a condition number of at most {LARGEST_CONDITION:.0e}",
            "The constraints do not determine x_1, .., x_N from what is known and the actions, so "
            "they have no prediction form. Penalise the deviation from C_0, or learn C at a "
            "smaller rate.",
        )
    return condition
