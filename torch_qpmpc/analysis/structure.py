"""What kind of MPC scheme, if any, the constraints are: read from their prediction form alone.

All but `distance_by_band` is free of C's gauge (see `canonical`): T C for any invertible T is the
same QP, and gives the same numbers. Norms are Frobenius norms over the maps from (x_0, U) to the
states, which weighs all entries of x_0 and U alike, in the units that the QP has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from torch_qpmpc.analysis.prediction_form import FORM, PredictionForm, check_form
from torch_qpmpc.checks import check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.banded import band_distance


def distance_by_band(C: Tensor, C_0: Tensor, n_x: int, n_u: int) -> dict[str, float]:
    """``sum |C - C_0|`` on, above and below the band: C, C_0 ``(N n_x, n_z)``.

    A raw distance, as in the paper: it depends on the gauge of C, unless C is a canonical matrix.
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
    """``||Gamma above its block diagonal|| / ||Gamma||``, ``(*batch,)``.

    Zero if no u_j enters an x_k with k <= j; at most 1.
    """
    energy = gamma_energies(form)
    return (energy[..., : form.horizon - 1].sum(-1) / energy.sum(-1)).sqrt()


def gamma_energies(form: PredictionForm) -> Tensor:
    """Squared norm of each block diagonal of Gamma, ``(*batch, 2 N - 1)``, by lag k - j.

    From lag -(N - 1), which is u_{N-1} in x_1, to N - 1, u_0 in x_N. Negative lags are not causal.
    """
    check_kind("form", form, PredictionForm, FORM)
    N = form.horizon
    squares = form.blocks.square().sum((-1, -2))
    diagonals = [squares.diagonal(offset=-lag, dim1=-2, dim2=-1).sum(-1) for lag in range(1 - N, N)]
    return torch.stack(diagonals, dim=-1)


def toeplitz_defect(form: PredictionForm) -> Tensor:
    """``||Gamma - its nearest block Toeplitz matrix|| / ||Gamma||``, ``(*batch,)``.

    Zero if what an action does depends on how long ago it was only, as in a time-invariant scheme.
    """
    check_kind("form", form, PredictionForm, FORM)
    N, blocks = form.horizon, form.blocks
    means = torch.zeros_like(blocks)
    for lag in range(1 - N, N):
        diagonal = means.diagonal(offset=-lag, dim1=-4, dim2=-3)
        diagonal += blocks.diagonal(offset=-lag, dim1=-4, dim2=-3).mean(-1, keepdim=True)
    every = (-1, -2, -3, -4)
    return ((blocks - means).square().sum(every) / blocks.square().sum(every)).sqrt()


@dataclass(frozen=True, eq=False)
class Model:
    """x+ = A x + B u + offset, as read from the constraints.

    Attributes:
        A, B, offset: ``(n_x, n_x)``, ``(n_x, n_u)``, ``(n_x,)``; with a leading N, one per stage.
        residual: the part of the predictions that it does not explain, as a share of their norm;
            ``()``, or ``(N,)``.
    """

    A: Tensor
    B: Tensor
    offset: Tensor
    residual: Tensor


def stage_models(form: PredictionForm) -> Model:
    """The model A_k, B_k by which the predictions go from stage k to k + 1.

    Predictions are maps of (x_0, U); A_k, B_k and the offset are the least-squares fit of that of
    x_{k+1} by those of x_k, u_k and a constant. If u_k does not enter x_k, as in causal
    constraints, B_k is block (k, k) of Gamma. The residual is what x_{k+1} takes from elsewhere,
    earlier pairs or later actions: zero in all stages means Markovian. Directions of the state that
    no prediction for stage k reaches are unknown, and zero in A_k (the smallest solution).
    """
    check_form(form)
    maps, regressors = form.maps, _regressors(form)
    fit = _fit(regressors, maps[1:])
    left = maps[1:] - fit @ regressors
    residual = (left.square().sum((-1, -2)) / _without_offset(maps[1:])).sqrt()
    A, B, offset = _split(fit, form)
    return Model(A, B, offset, residual)


def nearest_model(form: PredictionForm) -> Model:
    """The time-invariant scheme whose predictions are nearest, and the distance to it.

    Minimises ``||[Phi, Gamma, phi] - [Phi, Gamma, phi](A, B, offset)||`` by Levenberg-Marquardt
    from the one-step fit that all stages share; the residual is that over ``||[Phi, Gamma]||``. For
    a scheme with tied stages the start is exact, and the residual is zero up to rounding. Otherwise
    it is a local minimum, and an upper bound on the distance to the MPC schemes.
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

    # The predictions of an unstable fit may be far off, or no numbers: then no model is better.
    candidates = [np.zeros(start.numel()), start.flatten().numpy()]
    begin = min(candidates, key=lambda flat: np.linalg.norm(residuals(flat)))
    tight = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
    found = least_squares(residuals, begin, jac=jacobian, method="lm", **tight)  # pyright: ignore[reportArgumentType] - a function is meant
    theta = torch.as_tensor(found.x).view(shape)
    scale = _without_offset(maps[1:]).sum().sqrt()
    A, B, offset = _split(theta, form)
    return Model(A, B, offset, math.sqrt(2 * found.cost) / scale)


def memory_energies(form: PredictionForm, rtol: float = 1e-9) -> Tensor:
    """How far back the predictions look, ``(N + 1,)``; adds up to 1.

    How x_{k+1} depends on x_k, u_k, x_{k-1}, .. is not unique, as x_k follows from earlier ones. So
    the pair (x_k, u_k) explains all that it can, in least squares over (x_0, U); then what
    (x_{k-1}, u_{k-1}) adds to it is counted; and so on. Entry m is the share of the energy of
    x_1, .., x_N that the pair m stages before the latest adds. The last entry is what not even all
    of the past explains: dependence on later actions.

    Args:
        form: of the constraints.
        rtol: directions of the regressors below this share of the largest are not told from zero.
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
    """Of how many pairs (x_k, u_k), .. the next state is a function, by `memory_energies`.

    1 is a Markovian scheme, as MPC is; inf is one that looks at later actions. An order above 1 is
    not always how far back the rows of C reach: some pairs may tell all that was before them.

    Args:
        energies: ``(N + 1,)``.
        tolerance: of the norm, as a share, that the pairs need not explain.
    """
    check_tensor("energies", energies, "N + 1", batched=False, remedy="Pass memory_energies(form).")
    check_number("tolerance", tolerance, lambda x: 0 <= x <= 1, "a number in [0, 1]")
    # Not as 1 minus what is explained, which has only half the digits.
    left = energies.flip(0).cumsum(0).flip(0)[1:].sqrt()
    enough = (left <= tolerance).nonzero()
    return float(enough[0, 0] + 1) if len(enough) else math.inf


def _regressors(form: PredictionForm) -> Tensor:
    """x_k, u_k and 1 as maps of (x_0, U, 1) for k < N, ``(N, n_x + n_u + 1, n_v)``."""
    maps, n_x, n_u, N = form.maps, form.n_x, form.n_u, form.horizon
    unit = torch.eye(maps.shape[-1]).to(maps)
    actions = unit[n_x:-1].unflatten(0, (N, n_u))
    return torch.cat((maps[:-1], actions, unit[-1:].expand(N, 1, -1)), dim=-2)


def _fit(regressors: Tensor, target: Tensor) -> Tensor:
    """The smallest least-squares solution X of ``X regressors = target``."""
    # Of the drivers, this one stands rank deficiency.
    return torch.linalg.lstsq(regressors.mT, target.mT, driver="gelsd").solution.mT


def _split(fit: Tensor, form: PredictionForm) -> tuple[Tensor, Tensor, Tensor]:
    A, B, offset = fit.split((form.n_x, form.n_u, 1), dim=-1)
    return A, B, offset.squeeze(-1)


def _without_offset(maps: Tensor) -> Tensor:
    """Squared norms of the maps of (x_0, U), without the constant."""
    return maps[..., :-1].square().sum((-1, -2))


def _row_space(rows: Tensor, rtol: float) -> Tensor:
    """An orthonormal basis, as rows."""
    _, values, basis = torch.linalg.svd(rows, full_matrices=False)
    return basis[values > rtol * values[0]]
