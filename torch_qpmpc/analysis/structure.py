"""Measures of how far the constraints are from an MPC scheme, from their prediction form alone.

All but `distance_by_band` are free of C's gauge (see `prediction_form`): T C is the same QP for any
invertible T, and has the same numbers. Norms are Frobenius norms of the maps from (x_0, U) to the
states: all entries of x_0 and U weigh the same, in the QP's units.
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


def distance_by_band(C: Tensor, C_0: Tensor, n_x: int, n_u: int) -> dict[str, float]:
    """Return ``sum |C - C_0|`` on, above and below the band, for C, C_0 ``(N n_x, n_z)``.

    This distance, the paper's, depends on the gauge of C, unless C is a canonical matrix.

    Raises:
        QPError: if a shape does not fit.
    """
    check_whole("n_x", n_x, 1)
    check_whole("n_u", n_u, 1)
    check_tensor("C_0", C_0, "N n_x", "n_z", batched=False, remedy="Pass mpc.C_0.")
    check_tensor("C", C, *C_0.shape, batched=False, remedy="Pass mpc.C.")
    distance = band_distance(n_x, n_u, C_0.shape[0] // n_x).to(C.device)
    if distance.shape != C_0.shape:
        got, want = f"shape {tuple(C_0.shape)}", f"shape {tuple(distance.shape)}"
        raise QPError.expected("C_0", got, f"{want} for n_x = {n_x}, n_u = {n_u}")
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
class Model:
    """A model x+ = A x + B u + offset that is read from the constraints.

    Attributes:
        A, B, offset: ``(n_x, n_x)``, ``(n_x, n_u)``, ``(n_x,)``; with a leading N, one per stage.
        residual: share of the predictions' norm that the model does not explain, ``()`` or
            ``(N,)``.
    """

    A: Tensor
    B: Tensor
    offset: Tensor
    residual: Tensor


def stage_models(form: PredictionForm) -> Model:
    """Fit the model A_k, B_k of each step of the predictions, from stage k to k + 1.

    Predictions are maps of (x_0, U). A_k, B_k and the offset are the least-squares fit of the map
    of x_{k+1} by those of x_k, u_k and a constant. If u_k does not enter x_k, as in causal
    constraints, B_k is block (k, k) of Gamma. The residual is the part of x_{k+1} from earlier
    pairs or later actions: zero in all stages means Markovian. A_k is zero in directions of the
    state that no prediction of x_k reaches (the minimum-norm solution).
    """
    check_form(form)
    maps, regressors = form.maps, _regressors(form)
    fit = _fit(regressors, maps[1:])
    left = maps[1:] - fit @ regressors
    residual = (left.square().sum((-1, -2)) / _without_offset(maps[1:])).sqrt()
    A, B, offset = _split(fit, form)
    return Model(A, B, offset, residual)


def nearest_model(form: PredictionForm) -> Model:
    """Fit the time-invariant scheme with the nearest predictions; its residual is the distance.

    Minimises ``||[Phi, Gamma, phi] - [Phi, Gamma, phi](A, B, offset)||`` by Levenberg-Marquardt
    from the one-step fit of all stages; the residual is the minimum over ``||[Phi, Gamma]||``. For
    a scheme with tied stages the start is exact, and the residual zero up to rounding. Otherwise it
    is a local minimum, and an upper bound on the distance to the MPC schemes.
    """
    check_form(form)
    maps, N = form.maps, form.horizon
    n_x, n_v = maps.shape[-2:]
    inputs = _regressors(form)[:, n_x:]
    pooled = _regressors(form).movedim(0, 1).flatten(1)
    start = _fit(pooled, maps[1:].movedim(0, 1).flatten(1))
    shape = start.shape

    def rollout(theta: Tensor) -> Tensor:
        stages = [maps[0]]
        for k in range(N):
            stages.append(theta @ torch.cat((stages[-1], inputs[k])))
        return torch.stack(stages)

    def residuals(flat):
        return (rollout(torch.as_tensor(flat).view(shape)) - maps)[1:].flatten().numpy()

    def jacobian(flat):
        theta = torch.as_tensor(flat).view(shape)
        stages = rollout(theta)
        unit = torch.eye(n_x).to(maps)
        slope = maps.new_zeros(*shape, n_x, n_v)
        slopes = []
        for k in range(N):
            direct = torch.einsum("pi,qv->pqiv", unit, torch.cat((stages[k], inputs[k])))
            slope = direct + theta[:, :n_x] @ slope
            slopes.append(slope)
        return torch.stack(slopes, dim=2).flatten(2).flatten(0, 1).mT.numpy()

    # The predictions of an unstable fit may be far off or overflow: then zero is a better start.
    candidates = [np.zeros(start.numel()), start.flatten().numpy()]
    begin = min(candidates, key=lambda flat: np.linalg.norm(residuals(flat)))
    tight = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
    found = least_squares(residuals, begin, jac=jacobian, method="lm", **tight)  # pyright: ignore[reportArgumentType] - jac may be a function
    theta = torch.as_tensor(found.x).view(shape)
    scale = _without_offset(maps[1:]).sum().sqrt()
    A, B, offset = _split(theta, form)
    return Model(A, B, offset, math.sqrt(2 * found.cost) / scale)


def memory_energies(form: PredictionForm, rtol: float = 1e-9) -> Tensor:
    """Return the shares of the predictions' energy by past pair, ``(N + 1,)``, which sum to 1.

    The dependence of x_{k+1} on x_k, u_k, x_{k-1}, .. is not unique, as x_k follows from earlier
    pairs. Therefore (x_k, u_k) first explains as much as it can, in least squares over (x_0, U);
    then (x_{k-1}, u_{k-1}) explains part of the rest, and so on. Entry m is the share of the energy
    of x_1, .., x_N that the pair m stages before the latest explains. The last entry is the share
    that the whole past does not explain: dependence on later actions.

    Args:
        form: the prediction form of the constraints.
        rtol: singular values of the regressors below this share of the largest count as zero.

    Raises:
        QPError: if ``form`` has batch dimensions, or ``rtol`` is not in [0, 1).
    """
    check_form(form)
    check_number("rtol", rtol, lambda x: 0 <= x < 1, "a number in [0, 1)")
    maps, pairs, N = form.maps, _regressors(form), form.horizon
    energies = maps.new_zeros(N + 1)
    for k in range(N):
        left = maps[k + 1].clone()
        left[:, -1] = 0.0
        before = left.square().sum()
        for lag in range(k + 1):
            past = pairs[k - lag : k + 1].flatten(0, 1)
            explained = _row_space(past, rtol)
            rest = maps[k + 1] - maps[k + 1] @ explained.mT @ explained
            after = rest.square().sum()
            energies[lag] += (before - after).clamp(min=0)
            before = after
        energies[-1] += before
    return energies / energies.sum()


def markov_order(energies: Tensor, tolerance: float = 1e-6) -> float:
    """Return the number of latest pairs (x_k, u_k), .. that determine the next state.

    1 is a Markovian scheme, such as MPC; inf means that later actions matter. An order above 1 may
    be less than the reach of C's rows, because pairs may determine all earlier ones.

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


def _regressors(form: PredictionForm) -> Tensor:
    """Return x_k, u_k and 1 as maps of (x_0, U, 1), k < N, ``(N, n_x + n_u + 1, n_v)``."""
    maps, n_x, n_u, N = form.maps, form.n_x, form.n_u, form.horizon
    unit = torch.eye(maps.shape[-1]).to(maps)
    actions = unit[n_x:-1].unflatten(0, (N, n_u))
    return torch.cat((maps[:-1], actions, unit[-1:].expand(N, 1, -1)), dim=-2)


def _fit(regressors: Tensor, target: Tensor) -> Tensor:
    """Return the minimum-norm least-squares solution X of ``X regressors = target``."""
    # Unlike the default driver, gelsd handles rank deficiency.
    return torch.linalg.lstsq(regressors.mT, target.mT, driver="gelsd").solution.mT


def _split(fit: Tensor, form: PredictionForm) -> tuple[Tensor, Tensor, Tensor]:
    """Return A, B and the offset of a fit."""
    A, B, offset = fit.split((form.n_x, form.n_u, 1), dim=-1)
    return A, B, offset.squeeze(-1)


def _without_offset(maps: Tensor) -> Tensor:
    """Return the squared norms of the maps of (x_0, U), without the constant."""
    return maps[..., :-1].square().sum((-1, -2))


def _row_space(rows: Tensor, rtol: float) -> Tensor:
    """Return an orthonormal basis of the row space, as rows."""
    _, values, basis = torch.linalg.svd(rows, full_matrices=False)
    return basis[values > rtol * values[0]]
