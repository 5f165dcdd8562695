"""Measures of how far the constraints are from an MPC scheme, from their prediction form alone.

All but `distance_by_band` are free of C's gauge (see `prediction_form`): T C is the same QP for any
invertible T, and has the same numbers. Norms are Frobenius norms of the maps from (p, U) to the
states: all entries of p and U weigh the same, in the QP's units. p is x_0 or, with a window and a
preview, all that V fixes; the *window at k* is then (x_{k+1-L}, u_{k+1-L}, .., x_k, u_k) and d_k,
and without them (x_k, u_k).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torch_qpmpc.analysis.prediction_form import FORM_REMEDY, PredictionForm, check_form
from torch_qpmpc.checks import check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import band_distance
from torch_qpmpc.mpc.layout import Layout

#: The most evaluations of `nearest_model`'s predictions, of thousands whose last ones gain nothing,
#: and of their multiplications: with many outputs there are fewer evaluations, down to none.
EVALUATIONS, MULTIPLICATIONS = 100, 2e10


def distance_by_band(
    C: Tensor, C_0: Tensor, n_x: int, n_u: int, past: int = 1, n_d: int = 0
) -> dict[str, float]:
    """Return ``sum |C - C_0|`` on, above and below the band, for C, C_0 ``(N n_x, n_z)``.

    This distance, the paper's, depends on the gauge of C, unless C is a canonical matrix. ``past``
    and ``n_d`` are those of the `QPMPC`.

    Raises:
        QPError: if a shape does not fit.
    """
    check_whole("n_x", n_x, 1)
    check_whole("n_u", n_u, 1)
    check_whole("past", past, 1)
    check_whole("n_d", n_d, 0)
    check_tensor("C_0", C_0, "N n_x", "n_z", batched=False, remedy="Pass mpc.C_0.")
    check_tensor("C", C, *C_0.shape, batched=False, remedy="Pass mpc.C.")
    distance = band_distance(Layout(n_x, n_u, max(C_0.shape[0] // n_x, 1), past, n_d)).to(C.device)
    if distance.shape != C_0.shape:
        got, want = f"shape {tuple(C_0.shape)}", f"shape {tuple(distance.shape)}"
        sizes = f"n_x = {n_x}, n_u = {n_u}, past = {past}, n_d = {n_d}"
        raise QPError.expected("C_0", got, f"{want} for {sizes}")
    deviation = (C.detach() - C_0).abs()
    return {
        "on": deviation[distance == 0].sum().item(),
        "above": deviation[distance > 0].sum().item(),
        "below": deviation[distance < 0].sum().item(),
    }


def causality_defect(form: PredictionForm) -> Tensor:
    """Return ``||Gamma above its block diagonal|| / ||Gamma||``, ``(*batch,)``.

    It is zero if no u_j enters an x_k with k <= j, and at most 1.
    """
    energy = gamma_energies(form)
    return (energy[..., : form.horizon - 1].sum(-1) / energy.sum(-1)).sqrt()


def gamma_energies(form: PredictionForm) -> Tensor:
    """Return the squared norm of each block diagonal of Gamma, ``(*batch, 2 N - 1)``, by lag k - j.

    Lags run from -(N - 1), u_{N-1} in x_1, to N - 1, u_0 in x_N. Negative ones are not causal.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    N = form.horizon
    squares = form.blocks.square().sum((-1, -2))
    diagonals = [squares.diagonal(offset=-lag, dim1=-2, dim2=-1).sum(-1) for lag in range(1 - N, N)]
    return torch.stack(diagonals, dim=-1)


def toeplitz_defect(form: PredictionForm) -> Tensor:
    """Return ``||Gamma - its nearest block Toeplitz matrix|| / ||Gamma||``, ``(*batch,)``.

    It is zero if an action's effect depends on its lag alone, as in a time-invariant scheme.
    """
    check_kind("form", form, PredictionForm, FORM_REMEDY)
    N, blocks = form.horizon, form.blocks
    means = torch.zeros_like(blocks)
    for lag in range(1 - N, N):
        diagonal = means.diagonal(offset=-lag, dim1=-4, dim2=-3)
        diagonal += blocks.diagonal(offset=-lag, dim1=-4, dim2=-3).mean(-1, keepdim=True)
    every = (-1, -2, -3, -4)
    return ((blocks - means).square().sum(every) / blocks.square().sum(every)).sqrt()


@dataclass(frozen=True, eq=False)
class NearestModel:
    """A model x+ = A x + B u + offset that is read from the constraints.

    With a window of L and a preview it is ``x+ = A [x_k; ..; x_{k+1-L}] + B [u_k; ..; u_{k+1-L}] +
    E d_k + offset``.

    Attributes:
        A, B, E: ``(n_x, L n_x)``, ``(n_x, L n_u)`` and ``(n_x, n_d)``; with a leading N, one per
            stage.
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

    Predictions are maps of (p, U). A_k, B_k, E_k and the offset are the least-squares fit of the
    map of x_{k+1} by those of the window at k and a constant. If u_k does not enter x_k, as in
    causal constraints, B_k is block (k, k) of Gamma. The residual is the part of x_{k+1} from
    earlier pairs or later actions: zero in all stages means Markovian. A_k is zero in directions of
    the state that no prediction of x_k reaches (the minimum-norm solution).
    """
    check_form(form)
    maps, windows = form.maps, _windows(form)
    fit = _fit(windows, maps[1:])
    left = maps[1:] - fit @ windows
    residual = (left.square().sum((-1, -2)) / _without_offset(maps[1:])).sqrt()
    return NearestModel(*_split(fit, form), residual)


def nearest_model(form: PredictionForm) -> NearestModel:
    """Fit the time-invariant scheme with the nearest predictions; its residual is the distance.

    Minimises ``||[Phi, Gamma, phi] - [Phi, Gamma, phi](A, B, E, offset)||`` by trust-region steps
    from the one-step fit of all stages, as many as `EVALUATIONS` and `MULTIPLICATIONS` allow; the
    residual is the minimum over ``||[Phi, Gamma]||``. For a scheme with tied stages the start is
    exact, and the residual zero up to rounding. Otherwise it is a local minimum, or on the way to
    one, and an upper bound on the distance to the MPC schemes.
    """
    check_form(form)
    maps, past = form.maps, form.layout.past
    n_x, n_v = maps.shape[-2:]
    windows = _windows(form)
    states, inputs = windows.tensor_split((past * n_x,), dim=1)
    pooled = windows.movedim(0, 1).flatten(1)
    start = _fit(pooled, maps[1:].movedim(0, 1).flatten(1))
    shape = start.shape

    def rollout(theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps of the windows and of x_1, .., x_N that theta predicts."""
        x, lagged = [*states[0].split(n_x)[::-1]], []
        for rest in inputs:
            lagged.append(torch.cat((*x[: -past - 1 : -1], rest)))
            x.append(theta @ lagged[-1])
        return torch.stack(lagged), torch.stack(x[past:])

    def residuals(flat):
        return (rollout(torch.as_tensor(flat).view(shape))[1] - maps[1:]).flatten().numpy()

    def jacobian(flat):
        theta = torch.as_tensor(flat).view(shape)
        lags = theta[:, : past * n_x].split(n_x, dim=1)
        unit = torch.eye(n_x).to(maps)
        slopes = [maps.new_zeros(*shape, n_x, n_v)] * past
        for window in rollout(theta)[0]:
            slope = torch.einsum("pi,qv->pqiv", unit, window)
            for lag, A in enumerate(lags, start=1):
                slope = slope + A @ slopes[-lag]
            slopes.append(slope)
        return torch.stack(slopes[past:], dim=2).flatten(2).flatten(0, 1).mT.numpy()

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


def memory_energies(form: PredictionForm, rtol: float = 1e-9) -> Tensor:
    """Return the shares of the predictions' energy by past pair, ``(N + 1,)``, which sum to 1.

    The dependence of x_{k+1} on x_k, u_k, x_{k-1}, .. is not unique, as x_k follows from earlier
    pairs. Therefore (x_k, u_k) first explains as much as it can, in least squares over (p, U);
    then (x_{k-1}, u_{k-1}) explains part of the rest, and so on. Entry m is the share of the energy
    of x_1, .., x_N that the pair m stages before the latest explains. The last entry is the share
    that the whole past does not explain: dependence on later actions or previews.

    With a window or a preview, the windows at k, k - 1, .. take the place of these pairs: entry 0
    is the share that a model of L lags can explain.

    Args:
        form: the prediction form of the constraints.
        rtol: singular values of the regressors below this share of the largest count as zero.

    Raises:
        QPError: if ``form`` has batch dimensions, or ``rtol`` is not in [0, 1).
    """
    check_form(form)
    check_number("rtol", rtol, lambda x: 0 <= x < 1, "a number in [0, 1)")
    maps, windows, N = form.maps, _windows(form), form.horizon
    n_x, n_u, past = form.n_x, form.n_u, form.layout.past
    states, actions, others = windows.tensor_split((past * n_x, past * (n_x + n_u)), dim=1)
    # The part of the window at k that the one at k + 1 does not contain.
    oldest = torch.cat((states[:, -n_x:], actions[:, -n_u:], others), dim=1)
    energies = maps.new_zeros(N + 1)
    for k in range(N):
        left = maps[k + 1].clone()
        left[:, -1] = 0.0
        before = left.square().sum()
        for lag in range(k + 1):
            known = torch.cat((oldest[k - lag : k].flatten(0, 1), windows[k]))
            explained = _row_space(known, rtol)
            rest = maps[k + 1] - maps[k + 1] @ explained.mT @ explained
            after = rest.square().sum()
            energies[lag] += (before - after).clamp(min=0)
            before = after
        energies[-1] += before
    return energies / energies.sum()


def markov_order(energies: Tensor, tolerance: float = 1e-6) -> float:
    """Return the number of latest pairs (x_k, u_k), .., or windows, that determine the next state.

    1 is a Markovian scheme, such as MPC; inf means that later actions or previews matter. An order
    above 1 may be less than the reach of C's rows, because pairs may determine all earlier ones.

    Args:
        energies: `memory_energies`, ``(N + 1,)``.
        tolerance: share of the norm that the pairs need not explain.

    Raises:
        QPError: if an argument does not fit.
    """
    check_tensor("energies", energies, "N + 1", batched=False, remedy="Pass memory_energies(form).")
    check_number("tolerance", tolerance, lambda x: 0 <= x <= 1, "a number in [0, 1]")
    # Summing the unexplained shares avoids the cancellation in 1 minus the explained ones.
    left = energies.flip(0).cumsum(0).flip(0)[1:].sqrt()
    enough = (left <= tolerance).nonzero()
    return float(enough[0, 0] + 1) if len(enough) else math.inf


def _windows(form: PredictionForm) -> Tensor:
    """Return [x_k, .., x_{k+1-L}, u_k, .., u_{k+1-L}, d_k, 1] as maps of (p, U, 1), k < N.

    Returns:
        ``(N, L (n_x + n_u) + n_d + 1, n_v)``.
    """
    maps, layout, N = form.maps, form.layout, form.horizon
    unit = torch.eye(maps.shape[-1]).to(maps)
    d = unit[: layout.n_preview].unflatten(0, (N + 1, layout.n_d))[:N]
    past = unit[layout.n_preview : layout.n_before].unflatten(0, (layout.past - 1, layout.n))
    x = torch.cat((past[:, : layout.n_x], maps[:-1]))
    u = torch.cat((past[:, layout.n_x :], unit[layout.n_p : -1].unflatten(0, (N, layout.n_u))))
    first = range(layout.past - 1, -1, -1)  # that of x_k, .., x_{k+1-L} for k = 0
    lags = [part[i : i + N] for part in (x, u) for i in first]
    return torch.cat((*lags, d, unit[-1:].expand(N, 1, -1)), dim=-2)


def _fit(regressors: Tensor, target: Tensor) -> Tensor:
    """Return the minimum-norm least-squares solution X of ``X regressors = target``."""
    # Unlike the default driver, gelsd handles rank deficiency.
    return torch.linalg.lstsq(regressors.mT, target.mT, driver="gelsd").solution.mT


def _split(fit: Tensor, form: PredictionForm) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return A, B, E and the offset of a fit."""
    past = form.layout.past
    sizes = (past * form.n_x, past * form.n_u, form.layout.n_d, 1)
    A, B, E, offset = fit.split(sizes, dim=-1)
    return A, B, E, offset.squeeze(-1)


def _without_offset(maps: Tensor) -> Tensor:
    """Return the squared norms of the maps of (p, U), without the constant."""
    return maps[..., :-1].square().sum((-1, -2))


def _row_space(rows: Tensor, rtol: float) -> Tensor:
    """Return an orthonormal basis of the row space, as rows."""
    _, values, basis = torch.linalg.svd(rows, full_matrices=False)
    return basis[values > rtol * values[0]]
