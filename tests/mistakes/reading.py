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
from torch_qpmpc.analysis.policy import local_gain, policy_map, spectral_radius
from torch_qpmpc.analysis.report import read, structure_metrics
from torch_qpmpc.analysis.structure import (
    canonical_matrix,
    nearest_model,
    one_step_error,
    prediction_form,
    second_moment,
)
from torch_qpmpc.mpc.banded import banded_matrix
from torch_qpmpc.mpc.projections import check_step, nearest_psd, nearest_psd_by_sdp
from torch_qpmpc.mpc.regulator import lqr_gain, stage_weight

MISTAKES: dict[str, list[Callable[[], Any]]] = {
    "C: got shape (11,), expected shape (*batch, N n_x, n_z). Pass mpc.C.": [
        lambda: prediction_form(torch.zeros(11), 2, 1)
    ],
    "n_x: got 0, expected a whole number >= 1.": [
        lambda: prediction_form(mpc.C, 0, 1),
    ],
    "n_u: got -1, expected a whole number >= 1.": [lambda: prediction_form(mpc.C, 2, -1)],
    "B: got shape (1, 2), expected shape (2, 2) or (3, 2, 2).": [
        lambda: banded_matrix(torch.eye(2), torch.ones(1, 2), 3)
    ],
    "C, b: got NaN or inf, expected finite entries.": [
        lambda: prediction_form(mpc.C * math.nan, 2, 1)
    ],
    "form: got Parameter, expected a PredictionForm.": [lambda: canonical_matrix(mpc.C, A2)],
    "form.Phi: got shape (2, 6, 2), expected shape (N n_x, n_p). Pass the form of a single C.": [
        lambda: canonical_matrix(
            prediction_form(torch.stack([mpc.C] * 2), 2, 1), torch.zeros(3, 2, 2).double()
        )
    ],
    "mpc: got Parameter, expected a QPMPC.": [lambda: read(mpc.C)],
    "true_model: got Tensor, expected the pair (A, B), (A, B, offset) or (A, B, offset, E).": [
        lambda: read(mpc, A2),
        lambda: structure_metrics(mpc, A2),
    ],
    "true_model: got tuple of 1, expected the pair (A, B), (A, B, offset) or (A, B, offset, E": [
        lambda: read(mpc, (A2,))
    ],
    "mpc: got QPActorValueOperator, expected a QPMPC.": [
        lambda: structure_metrics(op),
        lambda: local_gain(op, S),
        lambda: stage_weight(op),
        lambda: policy_map(op, torch.ones(2), torch.ones(2)),
    ],
    "s: got shape (3,), expected shape (*batch, 2).": [lambda: local_gain(mpc, torch.zeros(3))],
    "A: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t": [
        lambda: lqr_gain([[1.0]], [[1.0]], [[1.0]]),
        lambda: spectral_radius([[1.0]], 1, 1),
    ],
    "W: got shape (2, 2), expected shape (3, 3). Pass stage_weight(mpc), the": [
        lambda: lqr_gain(A2, B1, torch.eye(2).double())
    ],
    "A: got shape (2, 1), expected shape (2, 2).": [
        lambda: lqr_gain(B1, A2, torch.eye(3).double())
    ],
    "gamma: got 2, expected a discount factor in (0, 1].": [
        lambda: lqr_gain(A2, B1, torch.eye(3).double(), gamma=2)
    ],
    "W: got smallest eigenvalue -1, expected a positive semidefinite weight.": [
        lambda: lqr_gain(A2, B1, -torch.eye(3).double())
    ],
    "B: got shape (2,), expected shape (2, n_u).": [
        lambda: lqr_gain(A2, B1[:, 0], torch.eye(3).double())
    ],
    "terminal_weight: got a Riccati equation without a solution (array must not ": [
        lambda: lqr_gain(A2 * math.nan, B1, torch.eye(3).double())
    ],
    "K: got shape (2, 1), expected shape (*batch, 1, 2).": [
        lambda: spectral_radius(A2, B1, torch.zeros(2, 1).double())
    ],
    "A, B, K: got NaN or inf, expected finite entries.": [
        lambda: spectral_radius(A2 * math.nan, B1, torch.zeros(1, 2).double())
    ],
    "x: got NaN or inf, expected finite entries.": [lambda: policy_map(mpc, [math.nan], [0.0])],
    "s: got list, expected a floating-point torch.Tensor. Convert it: torch.as_t": [
        lambda: second_moment([0.0], [0.0])
    ],
    "model: got tuple, expected a NearestModel. Pass nearest_model(form), or stage_mode": [
        lambda: one_step_error((A2, B1), A2, B1)
    ],
    "offset: got shape (3,), expected shape (2,).": [
        lambda: one_step_error(nearest_model(form), A2, B1, torch.zeros(3).double()),
    ],
    "moment: got shape (3, 3), expected shape (4, 4). Pass second_moment(s, a).": [
        lambda: one_step_error(nearest_model(form), A2, B1, moment=torch.eye(3))
    ],
    "A: got shape (1, 1), expected shape (2, 2).": [
        lambda: one_step_error(nearest_model(form), torch.eye(1).double(), torch.eye(1).double())
    ],
    "H: got shape (2,), expected shape (*batch, n, n).": [lambda: nearest_psd(torch.ones(2))],
    "H: got shape (2, 3), expected shape (*batch, n, 2).": [
        lambda: nearest_psd(torch.ones(2, 3)),
        lambda: nearest_psd_by_sdp(torch.ones(2, 3)),
    ],
    "H: got torch.int64, expected a floating-point torch.Tensor. Convert it: tor": [
        lambda: nearest_psd_by_sdp(-torch.eye(2).long())
    ],
    "step: got None, expected one of cholesky, projection, sdp.": [lambda: check_step(None)],
}
