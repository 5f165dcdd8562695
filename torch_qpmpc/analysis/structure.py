"""The constraints as a prediction model that does not depend on their gauge.

``C z = b`` and ``T C z = T b`` are the same constraints for any invertible T, so single entries of
C mean little. Independent of T is the *prediction form*,

    X = Phi p + Gamma U + phi,    X = [x_1, .., x_N],    U = [u_0, .., u_{N-1}],

and all that follows from it. p is what V fixes: x_0 or, with a preview, all of z up to x_0 (see
`torch_qpmpc.mpc.layout`). The *canonical matrix* is the T C whose row block k reads ``x_{k+1} = A_k
x_k + ..``, as in an MPC scheme: for such a scheme it is C_0 (eq:cband). Norms are Frobenius norms
of the maps from (p, U) to the states, in the QP's units.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout, band_distance
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import as_tensor, check_one_model, without_gradients

FORM_REMEDY = "Pass torch_qpmpc.analysis.structure.predictions(mpc)."
#: The largest accepted condition number of C's state columns, after scaling its rows. The relative
#: error of a prediction form is about 1e-16 times that number.
LARGEST_CONDITION = 1e12
#: The most evaluations of `nearest_model`'s predictions, of thousands whose last ones gain nothing,
#: and of their multiplications: with many outputs there are fewer evaluations, down to none.
EVALUATIONS, MULTIPLICATIONS = 100, 2e10


@dataclass(frozen=True, eq=False)
class PredictionForm:
    """X = Phi p + Gamma U + phi, in float64.

    Attributes:
        Phi: ``(N n_x, n_p)``.
        Gamma: ``(N n_x, N n_u)``; block (k, j) is the effect of u_j on x_{k+1}.
        phi: the offset, ``(N n_x,)``; zero if b is.
        condition: condition number of C's state columns, ``()``; depends on the gauge.
        layout: the sizes of z.
    """

    Phi: Tensor
    Gamma: Tensor
    phi: Tensor
    condition: Tensor
    layout: Layout

    @property
    def blocks(self) -> Tensor:
        """Gamma by blocks, ``(N, N, n_x, n_u)``: [k, j] is the effect of u_j on x_{k+1}."""
        N, n_x, n_u = self.layout.horizon, self.layout.n_x, self.layout.n_u
        return self.Gamma.view(N, n_x, N, n_u).transpose(1, 2)

    @property
    def maps(self) -> Tensor:
        """The states x_0, .., x_N as linear maps of (p, U, 1), ``(N + 1, n_x, n_v)``.

        n_v is n_p + N n_u + 1.
        """
        following = torch.cat((self.Phi, self.Gamma, self.phi.unsqueeze(-1)), dim=-1)
        n_x, n_p = self.layout.n_x, self.layout.n_p
        first = torch.eye(n_p, following.shape[-1])[-n_x:].to(following)
        return torch.cat((first, following)).unflatten(0, (-1, n_x))


@without_gradients
def prediction_form(
    C: Tensor, n_x: int, n_u: int, b: Tensor | None = None, n_d: int = 0
) -> PredictionForm:
    """Solve ``C z = b`` for x_1, .., x_N.

    Args:
        C: ``(N n_x, n_z)``.
        n_x, n_u, n_d: numbers of states, actions and entries of d_k, as in `QPMPC`.
        b: ``(N n_x,)``; zero by default.

    Raises:
        QPError: if the shapes do not fit, or C's state columns are singular, so that p and the
            actions do not determine the states.

    Example:
        >>> import torch
        >>> from torch_qpmpc.mpc.layout import banded_matrix
        >>> C_0 = banded_matrix(torch.tensor([[0.5]]), torch.tensor([[1.0]]), 3)
        >>> T = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [1.0, 0.0, 1.0]])
        >>> form = prediction_form(T @ C_0, 1, 1)
        >>> (form.Gamma + 0.0).round(decimals=6)
        tensor([[1.0000, 0.0000, 0.0000],
                [0.5000, 1.0000, 0.0000],
                [0.2500, 0.5000, 1.0000]], dtype=torch.float64)
    """
    check_tensor("C", C, "N n_x", "n_z", batched=False, remedy="Pass mpc.C.")
    n_c, n_z = C.shape
    N = n_c // max(n_x, 1)
    layout = Layout(n_x, n_u, max(N, 1), n_d)
    if N < 1 or n_c != N * n_x or n_z != layout.n_z:
        want = f"(N n_x, n_p + N (n_x + n_u)) with n_x = {n_x}, n_u = {n_u}"
        raise QPError.expected("C", f"shape {tuple(C.shape)}", f"{want}, n_p = {layout.n_p}")
    b = C.new_zeros(n_c) if b is None else check_tensor("b", b, n_c, batched=False)
    C, b = as_tensor("C", C), as_tensor("b", b)
    # Rows of unit norm, so that their scale does not affect the condition number.
    size = C.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(C.dtype).tiny)
    C, b = C / size, b.unsqueeze(-1) / size
    following, p, u = (C[:, columns] for columns in _columns(layout))
    condition = _condition(following)
    solved = torch.linalg.solve(following, torch.cat((-p, -u, b), -1))
    Phi, Gamma, phi = solved.split((layout.n_p, N * n_u, 1), dim=-1)
    return PredictionForm(Phi, Gamma, phi.squeeze(-1), condition, layout)


def predictions(mpc: QPMPC) -> PredictionForm:
    """Return the prediction form, X = Phi p + Gamma U + phi; `QPError` if there are dynamics."""
    check_one_model(mpc)
    with torch.no_grad():
        return prediction_form(mpc.C, mpc.n_x, mpc.n_u, mpc.b, mpc.n_d)


def canonical(mpc: QPMPC) -> Tensor:
    """Return C ``(n_c, n_z)`` in the gauge that makes an MPC scheme's C banded."""
    return canonical_matrix(predictions(mpc))[0]


def canonical_matrix(form: PredictionForm) -> tuple[Tensor, Tensor]:
    """Return the same constraints with row blocks ``A_k x_k + .. - x_{k+1}``, by `stage_models`.

    For an MPC scheme the result is the banded C_0; otherwise entries off the band are what x_k, u_k
    and d_k do not explain. It is C ``(N n_x, n_z)`` and b ``(N n_x,)``.
    """
    A, n_x, N = stage_models(form).A, form.layout.n_x, form.layout.horizon
    F = form.Phi.new_zeros(N * n_x, form.layout.n_z)
    following, p, u = _columns(form.layout)
    F[:, p], F[:, u] = form.Phi, form.Gamma
    F[:, following] = -torch.eye(N * n_x).to(F)
    rows = torch.cat((F, -form.phi.unsqueeze(-1)), dim=-1).unflatten(0, (N, n_x))
    canonical = rows.clone()
    canonical[1:] -= A[1:] @ rows[:-1]
    canonical = canonical.flatten(0, 1)
    return canonical[:, :-1], canonical[:, -1]


def _columns(layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns of x_1, .., x_N, of p and of U in z."""
    z = torch.arange(layout.n_z)
    plan = z[layout.n_p :].unflatten(0, (layout.horizon, layout.n))
    return plan[:, layout.n_u :].flatten(), z[: layout.n_p], plan[:, : layout.n_u].flatten()


def _condition(following: Tensor) -> Tensor:
    """Return the condition number of ``(n_c, n_c)``; raise `QPError` if it is too large."""
    values = torch.linalg.svdvals(following)
    condition = values[0] / values[-1]
    # Written so that nan, from 0 / 0, is rejected, too.
    if not condition <= LARGEST_CONDITION:
        rank = int((values > values[0] / LARGEST_CONDITION).sum())
        got = f"state columns of rank {rank} of {len(values)} (condition number {condition:.2g})"
        remedy = (
            "The constraints do not determine x_1, .., x_N from what is known and the actions, so "
            "they have no prediction form. Penalise the deviation from C_0, or learn C at a "
            "smaller rate."
        )
        want = f"a condition number of at most {LARGEST_CONDITION:.0e}"
        raise QPError.expected("C", got, want, remedy)
    return condition


def causality_defect(form: PredictionForm) -> Tensor:
    """Return ``||Gamma above its block diagonal|| / ||Gamma||``, ``()``.

    It is zero if no u_j enters an x_k with k <= j, and at most 1.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    squares = form.blocks.square().sum((-1, -2))
    return (squares.triu(1).sum() / squares.sum()).sqrt()


def toeplitz_defect(form: PredictionForm) -> Tensor:
    """Return ``||Gamma - its nearest block Toeplitz matrix|| / ||Gamma||``, ``()``.

    It is zero if an action's effect depends on its lag alone, as in a time-invariant scheme.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    N, blocks = form.layout.horizon, form.blocks
    means = torch.zeros_like(blocks)
    for lag in range(1 - N, N):
        diagonal = means.diagonal(offset=-lag)
        diagonal += blocks.diagonal(offset=-lag).mean(-1, keepdim=True)
    return ((blocks - means).square().sum() / blocks.square().sum()).sqrt()


@dataclass(frozen=True, eq=False)
class NearestModel:
    """A model x+ = A x + B u + E d + offset that is read from the constraints.

    Attributes:
        A, B, E: ``(n_x, n_x)``, ``(n_x, n_u)`` and ``(n_x, n_d)``; with a leading N, one per stage.
        offset: ``(n_x,)``, likewise.
        residual: share of the predictions' norm that the model does not explain, ``()`` or
            ``(N,)``.
    """

    A: Tensor
    B: Tensor
    E: Tensor
    offset: Tensor
    residual: Tensor


def stage_models(form: PredictionForm) -> NearestModel:
    """Fit the model A_k, B_k of each step of the predictions, from stage k to k + 1.

    A_k, B_k, E_k and the offset are the least-squares fit of the map of x_{k+1} by those of x_k,
    u_k, d_k and a constant, zero in directions that no prediction of x_k reaches. The residual
    is the part of x_{k+1} from earlier pairs or later actions: zero in all stages means Markovian.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    maps, pairs = form.maps, _pairs(form)
    fit = _fit(pairs, maps[1:])
    left = maps[1:] - fit @ pairs
    residual = (left.square().sum((-1, -2)) / _without_offset(maps[1:])).sqrt()
    return NearestModel(*_split(fit, form), residual)


def nearest_model(form: PredictionForm) -> NearestModel:
    """Fit the time-invariant scheme with the nearest predictions; its residual is the distance.

    Trust-region steps from the one-step fit of all stages minimise ``||[Phi, Gamma, phi] - [Phi,
    Gamma, phi](A, B, E, offset)||``; the residual is that over ``||[Phi, Gamma]||``, of a local
    minimum: an upper bound on the distance to the MPC schemes.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    maps, pairs = form.maps, _pairs(form)
    n_x, n_v = maps.shape[-2:]
    pooled = pairs.movedim(0, 1).flatten(1)
    start = _fit(pooled, maps[1:].movedim(0, 1).flatten(1))
    shape = start.shape

    def rollout(theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps of the pairs and of x_1, .., x_N that theta predicts."""
        x, predicted = [maps[0]], []
        for inputs in pairs[:, n_x:]:
            predicted.append(torch.cat((x[-1], inputs)))
            x.append(theta @ predicted[-1])
        return torch.stack(predicted), torch.stack(x[1:])

    def residuals(flat):
        return (rollout(torch.as_tensor(flat).view(shape))[1] - maps[1:]).flatten().numpy()

    def jacobian(flat):
        theta = torch.as_tensor(flat).view(shape)
        unit, slopes = torch.eye(n_x).to(maps), [maps.new_zeros(*shape, n_x, n_v)]
        for pair in rollout(theta)[0]:
            slope = torch.einsum("pi,qv->pqiv", unit, pair)
            slopes.append(slope + theta[:, :n_x] @ slopes[-1])
        return torch.stack(slopes[1:], dim=2).flatten(2).flatten(0, 1).mT.numpy()

    # The predictions of an unstable fit may be far off or overflow: then zero is a better start.
    candidates = [np.zeros(start.numel()), start.flatten().numpy()]
    begin = min(candidates, key=lambda flat: np.linalg.norm(residuals(flat)))
    each = maps[1:].numel() * start.numel() ** 2
    if evaluations := min(EVALUATIONS, int(MULTIPLICATIONS / each)):
        options = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12, "max_nfev": evaluations}
        begin = least_squares(residuals, begin, jac=jacobian, **options).x  # pyright: ignore[reportArgumentType] - jac may be a function
    theta = torch.as_tensor(begin).view(shape)
    scale = _without_offset(maps[1:]).sum().sqrt()
    return NearestModel(*_split(theta, form), float(np.linalg.norm(residuals(begin))) / scale)


def _pairs(form: PredictionForm) -> Tensor:
    """Return [x_k, u_k, d_k, 1] as maps of (p, U, 1), k < N, ``(N, n_x + n_u + n_d + 1, n_v)``."""
    maps, layout, N = form.maps, form.layout, form.layout.horizon
    unit = torch.eye(maps.shape[-1]).to(maps)
    d = unit[: layout.n_preview].unflatten(0, (N + 1, layout.n_d))[:N]
    u = unit[layout.n_p : -1].unflatten(0, (N, layout.n_u))
    return torch.cat((maps[:-1], u, d, unit[-1:].expand(N, 1, -1)), dim=-2)


def _fit(regressors: Tensor, target: Tensor) -> Tensor:
    """Return the minimum-norm least-squares solution X of ``X regressors = target``."""
    # Unlike the default driver, gelsd handles rank deficiency.
    return torch.linalg.lstsq(regressors.mT, target.mT, driver="gelsd").solution.mT


def _split(fit: Tensor, form: PredictionForm) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return A, B, E and the offset of a fit."""
    sizes = (form.layout.n_x, form.layout.n_u, form.layout.n_d, 1)
    A, B, E, offset = fit.split(sizes, dim=-1)
    return A, B, E, offset.squeeze(-1)


def _without_offset(maps: Tensor) -> Tensor:
    """Return the squared norms of the maps of (p, U), without the constant."""
    return maps[..., :-1].square().sum((-1, -2))


def second_moment(s: Tensor, a: Tensor) -> Tensor:
    """Return E[v v'] ``(n_v, n_v)`` of v = (s, a, 1) over samples ``(*batch, n)``."""
    v = torch.cat((s, a, torch.ones_like(a[..., :1])), dim=-1)
    v = v.reshape(-1, v.shape[-1])
    return v.mT @ v / len(v)


def one_step_error(
    model: NearestModel,
    A: Tensor,
    B: Tensor,
    offset: Tensor | None = None,
    moment: Tensor | None = None,
    E: Tensor | None = None,
) -> Tensor:
    """Return the root mean square of the model's error in s+ over a distribution of (s, a).

    Args:
        model: the model, with tensors ``(*batch, ..)``, such as one per stage.
        A, B: the true model, ``(n_x, n_x)`` and ``(n_x, n_u)``.
        offset: the true offset, the mean of the noise, ``(n_x,)``; zero by default.
        moment: `second_moment` of the distribution; by default that of independent entries with
            mean 0 and variance 1.
        E: the true ``(n_x, n_d)``; zero by default.

    Returns:
        ``(*batch,)``.
    """
    check_kind("model", model, NearestModel, "Pass nearest_model(form), or stage_models(form).")
    own = (model.A, model.B, model.E, model.offset.unsqueeze(-1))
    n_x = model.A.shape[-2]
    offset = model.A.new_zeros(n_x) if offset is None else offset
    E = model.A.new_zeros(n_x, own[2].shape[-1]) if E is None else E
    for name, part, like in zip("ABE", (A, B, E), own, strict=False):
        check_tensor(name, part, n_x, like.shape[-1], batched=False)
    check_tensor("offset", offset, n_x, batched=False)
    true = [part.to(model.A) for part in (A, B, E, offset.unsqueeze(-1))]
    error = torch.cat(own, dim=-1) - torch.cat(true, dim=-1)
    n = error.shape[-1]
    if moment is not None:
        check_tensor("moment", moment, n, n, batched=False, remedy="Pass second_moment(s, a).")
    moment = torch.eye(n).to(error) if moment is None else moment.to(error)
    return ((error @ moment) * error).sum((-1, -2)).clamp(min=0).sqrt()


def distance_by_band(mpc: QPMPC) -> dict[str, float]:
    """Return the paper's ``sum |C - C_0|`` on, above and below the band.

    It depends on the gauge of C, unless C is a canonical matrix.
    """
    check_kind("mpc", mpc, QPMPC)
    distance, deviation = band_distance(mpc.layout).to(mpc.C.device), (mpc.C - mpc.C_0).detach()
    sides = {"on": distance == 0, "above": distance > 0, "below": distance < 0}
    return {name: deviation.abs()[side].sum().item() for name, side in sides.items()}
