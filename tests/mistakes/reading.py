"""Mistakes with the analysis of a learned QP."""

# The wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnhashable=false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from tests.mistakes.objects import A2, B1, S, form, mpc, op
from torch_qpmpc.analysis.model_error import first_state_error, one_step_error, second_moment
from torch_qpmpc.analysis.policy import local_gain, policy_map, spectral_radius
from torch_qpmpc.analysis.prediction_form import canonical_matrix, model_form, prediction_form
from torch_qpmpc.analysis.report import read, structure_metrics
from torch_qpmpc.analysis.structure import (
    distance_by_band,
    markov_order,
    memory_energies,
    nearest_model,
)
from torch_qpmpc.mpc.projections import check_step, nearest_psd, nearest_psd_by_sdp
from torch_qpmpc.mpc.regulator import lqr_gain, stage_weight

MISTAKES: dict[str, tuple[Callable[[], Any], str]] = {
    "prediction_form: 1d": (
        lambda: prediction_form(torch.zeros(11), 2, 1),
        "C: got shape (11,), expected shape (*batch, N n_x, n_z). Pass mpc.C.",
    ),
    "prediction_form: n_x 0": (
        lambda: prediction_form(mpc.C, 0, 1),
        "n_x: got 0, expected a whole number >= 1.",
    ),
    "prediction_form: b batch": (
        lambda: prediction_form(torch.stack([mpc.C] * 2), 2, 1, torch.zeros(3, 6)),
        "b: got shape (3, 6), expected leading dimensions that broadcast with those ",
    ),
    "prediction_form: n_u neg": (
        lambda: prediction_form(mpc.C, 2, -1),
        "n_u: got -1, expected a whole number >= 1.",
    ),
    "PredictionForm.predict: U": (
        lambda: form.predict(torch.zeros(2).double(), torch.zeros(5, 1).double()),
        "U: got shape (5, 1), expected shape (*batch, 4, 1).",
    ),
    "PredictionForm.predict: batch": (
        lambda: form.predict(torch.zeros(3, 2).double(), torch.zeros(5, 4, 1).double()),
        "U: got shape (5, 4, 1), expected leading dimensions that broadcast with those of p, (3,).",
    ),
    "model_form: shape": (
        lambda: model_form(torch.eye(2), torch.ones(1, 2), 3),
        "B: got shape (1, 2), expected shape (2, 2) or (3, 2, 2).",
    ),
    "model_form: horizon 0": (
        lambda: model_form(A2, B1, 0),
        "horizon: got 0, expected a whole number >= 1.",
    ),
    "model_form: offset": (
        lambda: model_form(A2, B1, 3, torch.zeros(3)),
        "offset: got shape (3,), expected shape (*batch, 2).",
    ),
    "model_form: 1d": (
        lambda: model_form(torch.ones(2), torch.ones(2), 3),
        "A: got shape (2,), expected shape (*batch, n_x, L n_x).",
    ),
    "model_form: nan": (
        lambda: model_form(A2 * math.nan, B1, 3),
        "C, b: got NaN or inf, expected finite entries.",
    ),
    "canonical_matrix: form": (
        lambda: canonical_matrix(mpc.C, A2),
        "form: got Parameter, expected a PredictionForm.",
    ),
    "canonical_matrix: batched": (
        lambda: canonical_matrix(
            prediction_form(torch.stack([mpc.C] * 2), 2, 1), torch.zeros(3, 2, 2).double()
        ),
        "form.Phi: got shape (2, 6, 2), expected shape (N n_x, n_p). Pass the form of a single C.",
    ),
    "distance_by_band: row": (
        lambda: distance_by_band(mpc.C[0], mpc.C_0, 2, 1),
        "C: got shape (11,), expected shape (6, 11). Pass mpc.C.",
    ),
    "distance_by_band: n_x0": (
        lambda: distance_by_band(mpc.C, mpc.C_0, 0, 1),
        "n_x: got 0, expected a whole number >= 1.",
    ),
    "memory_energies: rtol": (
        lambda: memory_energies(form, rtol=-1),
        "rtol: got -1, expected a number in [0, 1).",
    ),
    "markov_order: list": (
        lambda: markov_order([1.0, 0.0]),
        "energies: got list, expected a floating-point torch.Tensor. Convert it: tor",
    ),
    "markov_order: tol": (
        lambda: markov_order(memory_energies(form), tolerance=-1.0),
        "tolerance: got -1.0, expected a number in [0, 1].",
    ),
    "read: C": (
        lambda: read(mpc.C),
        "mpc: got Parameter, expected a QPMPC.",
    ),
    "read: true one": (
        lambda: read(mpc, A2),
        "true_model: got Tensor, expected the pair (A, B), (A, B, offset) or (A, B, offset, E).",
    ),
    "read: true 1": (
        lambda: read(mpc, (A2,)),
        "true_model: got tuple of 1, expected the pair (A, B), (A, B, offset) or (A, B, offset, E",
    ),
    "structure_metrics: operator": (
        lambda: structure_metrics(op),
        "mpc: got QPActorValueOperator, expected a QPMPC.",
    ),
    "structure_metrics: true": (
        lambda: structure_metrics(mpc, A2),
        "true_model: got Tensor, expected the pair (A, B), (A, B, offset) or (A, B, offset, E).",
    ),
    "local_gain: operator": (
        lambda: local_gain(op, S),
        "mpc: got QPActorValueOperator, expected a QPMPC.",
    ),
    "local_gain: shape": (
        lambda: local_gain(mpc, torch.zeros(3)),
        "s: got shape (3,), expected shape (*batch, 2).",
    ),
    "lqr_gain: list": (
        lambda: lqr_gain([[1.0]], [[1.0]], [[1.0]]),
        "A: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t",
    ),
    "lqr_gain: W shape": (
        lambda: lqr_gain(A2, B1, torch.eye(2).double()),
        "W: got shape (2, 2), expected shape (3, 3). Pass stage_weight(mpc), the",
    ),
    "lqr_gain: swapped": (
        lambda: lqr_gain(B1, A2, torch.eye(3).double()),
        "A: got shape (2, 1), expected shape (2, 2).",
    ),
    "lqr_gain: gamma": (
        lambda: lqr_gain(A2, B1, torch.eye(3).double(), gamma=2),
        "gamma: got 2, expected a discount factor in (0, 1].",
    ),
    "lqr_gain: neg W": (
        lambda: lqr_gain(A2, B1, -torch.eye(3).double()),
        "W: got smallest eigenvalue -1, expected a positive semidefinite weight.",
    ),
    "lqr_gain: B 1d": (
        lambda: lqr_gain(A2, B1[:, 0], torch.eye(3).double()),
        "B: got shape (2,), expected shape (2, n_u).",
    ),
    "lqr_gain: nan": (
        lambda: lqr_gain(A2 * math.nan, B1, torch.eye(3).double()),
        "terminal_weight: got a Riccati equation without a solution (array must not ",
    ),
    "stage_weight: operator": (
        lambda: stage_weight(op),
        "mpc: got QPActorValueOperator, expected a QPMPC.",
    ),
    "spectral_radius: shape": (
        lambda: spectral_radius(A2, B1, torch.zeros(2, 1).double()),
        "K: got shape (2, 1), expected shape (*batch, 1, 2).",
    ),
    "spectral_radius: list": (
        lambda: spectral_radius([[1.0]], 1, 1),
        "A: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t",
    ),
    "spectral_radius: nan": (
        lambda: spectral_radius(A2 * math.nan, B1, torch.zeros(1, 2).double()),
        "A, B, K: got NaN or inf, expected finite entries.",
    ),
    "policy_map: operator": (
        lambda: policy_map(op, torch.ones(2), torch.ones(2)),
        "mpc: got QPActorValueOperator, expected a QPMPC.",
    ),
    "policy_map: axes3": (
        lambda: policy_map(mpc, torch.ones(2), torch.ones(2), axes=(0, 1, 2)),
        "axes: got (0, 1, 2), expected a pair of indices, such as (0, 1).",
    ),
    "policy_map: axes f": (
        lambda: policy_map(mpc, torch.ones(2), torch.ones(2), axes=(0.0, 1.0)),
        "axes: got 0.0, expected a whole number >= 0.",
    ),
    "policy_map: x nan": (
        lambda: policy_map(mpc, [math.nan], [0.0]),
        "x: got NaN or inf, expected finite entries.",
    ),
    "policy_map: empty": (
        lambda: policy_map(mpc, [], [0.0]),
        "x, y: got shapes (0,) and (1,), expected non-empty vectors. Pass torch.lin",
    ),
    "policy_map: axes str": (
        lambda: policy_map(mpc, [1.0], [0.0], axes="xy"),
        "axes: got 'xy', expected a pair of indices, such as (0, 1).",
    ),
    "second_moment: list": (
        lambda: second_moment([0.0], [0.0]),
        "s: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t",
    ),
    "second_moment: empty": (
        lambda: second_moment(torch.zeros(0, 2), torch.zeros(0, 1)),
        "s, a, d: got shapes (0, 2), (0, 1) and (0, 0), expected the same number of samples, at l",
    ),
    "one_step_error: model": (
        lambda: one_step_error((A2, B1), A2, B1),
        "model: got tuple, expected a NearestModel. Pass nearest_model(form), or stage_mode",
    ),
    "one_step_error: offset": (
        lambda: one_step_error(nearest_model(form), A2, B1, torch.zeros(3).double()),
        "offset: got shape (3,), expected shape (2,).",
    ),
    "one_step_error: moment": (
        lambda: one_step_error(nearest_model(form), A2, B1, moment=torch.eye(3)),
        "moment: got shape (3, 3), expected shape (4, 4). Pass second_moment(s, a).",
    ),
    "one_step_error: 1x1": (
        lambda: one_step_error(nearest_model(form), torch.eye(1).double(), torch.eye(1).double()),
        "A: got shape (1, 1), expected shape (2, 2).",
    ),
    "first_state_error: operator": (
        lambda: first_state_error(op, S, A2, B1),
        "mpc: got QPActorValueOperator, expected a QPMPC.",
    ),
    "first_state_error: shape": (
        lambda: first_state_error(mpc, S, torch.eye(3), B1),
        "A: got shape (3, 3), expected shape (2, 2).",
    ),
    "first_state_error: offset": (
        lambda: first_state_error(mpc, S, A2, B1, torch.zeros(3)),
        "offset: got shape (3,), expected shape (2,).",
    ),
    "nearest_psd: shape": (
        lambda: nearest_psd(torch.ones(2)),
        "H: got shape (2,), expected shape (*batch, n, n).",
    ),
    "nearest_psd: rect": (
        lambda: nearest_psd(torch.ones(2, 3)),
        "H: got shape (2, 3), expected shape (*batch, n, 2).",
    ),
    "nearest_psd_by_sdp: shape": (
        lambda: nearest_psd_by_sdp(torch.ones(2, 3)),
        "H: got shape (2, 3), expected shape (*batch, n, 2).",
    ),
    "nearest_psd_by_sdp: int": (
        lambda: nearest_psd_by_sdp(-torch.eye(2).long()),
        "H: got torch.int64, expected a floating-point torch.Tensor. Convert it: tor",
    ),
    "check_step: wrong": (
        lambda: check_step(None),
        "step: got None, expected one of cholesky, projection, sdp.",
    ),
}
