"""Error messages for users' mistakes: the argument, its value, and the expected one."""

# The wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnhashable=false

import re
from collections.abc import Callable
from functools import partial
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from tensordict import TensorDict
from torch import Tensor, eye, ones, tensor, zeros

import torch_qpmpc as qm
from tests.problems import known_qp, random_mpc
from tests.transitions import make_batch, make_loss, make_operator
from torch_qpmpc.analysis.policy import local_gain, spectral_radius
from torch_qpmpc.analysis.report import read, structure_metrics
from torch_qpmpc.analysis.structure import (
    canonical_matrix,
    nearest_model,
    one_step_error,
    prediction_form,
)
from torch_qpmpc.envs import (
    GrosZanonLTI,
    GymnasiumPlant,
    LinearSystemEnv,
    PointMass,
    PointMassGymEnv,
)
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.mpc.layout import banded_matrix
from torch_qpmpc.mpc.projections import check_step
from torch_qpmpc.mpc.riccati import lqr_gain

A2, B1 = tensor([[1.0, 0.1], [0, 0.9]]).double(), tensor([[0.0], [1.0]]).double()
I3 = eye(3).double()
KNOWN = known_qp(14, batch=(3,))
qp, fixed = KNOWN.qp, KNOWN.fixed
GOOD = dict(zip(("H", "q", "c", "C", "b", "G", "lb", "ub", "w"), qp.tensors(), strict=True))
mpc, free = random_mpc(0), qm.GaussNewton(random_mpc(0, learn=("H", "c", "C")))
S, Aa, V = zeros(4, 2), zeros(4, 1), zeros(4)
WEIGHTS = tensor([1.0, nan, 1.0])
TD = partial(TensorDict, batch_size=4)
op, gn = make_operator(), qm.GaussNewton(random_mpc(0))
deviation, si = qm.DeviationPenalty(mpc), qm.SystemIdentificationPenalty()
form = prediction_form(banded_matrix(A2, B1, 4), 2, 1)
model, pm = nearest_model(form), PointMass()
pendulum, episode = GymnasiumPlant("Pendulum-v1"), PointMassGymEnv()
episode.reset(seed=0)
Loss = partial(qm.QPQLearningLoss, op)


def one(s: Tensor) -> Tensor:
    return s[:, :1]


def two(s: Tensor) -> Tensor:
    return s[:, :2]


def Q(**changes: Any) -> Callable[[], Any]:
    data: dict[str, Any] = GOOD | changes
    return lambda: qm.QuadraticProgram(**data)


def M(**changes: Any) -> Callable[[], Any]:
    base = {"n_x": 2, "n_u": 1, "horizon": 3, "A": eye(2), "B": ones(2, 1)}
    base["stage_weight"] = [1.0, 1.0, 0.1]
    return lambda: qm.QPMPC.of(**(base | changes))


def G(**changes: Any) -> Callable[[], Any]:
    options: dict[str, Any] = {"mpc": random_mpc(0)} | changes
    return lambda: qm.GaussNewton(**options)


def lost(*keys: Any) -> Callable[[], Any]:
    return lambda: make_loss()(make_batch(3).exclude(*keys))


def with_entry(key: Any, value: Tensor) -> Callable[[], Any]:
    return lambda: make_loss()(make_batch(3).set(key, value))


def released_step() -> None:
    tied = random_mpc(0, structure="tied")
    optimizer = qm.GaussNewton(tied)
    tied.release()
    optimizer.step(S, Aa, zeros(4))


MISTAKES: list[tuple[str, Callable[[], Any]]] = [
    # The QP and its module
    ("q: got torch.float32, expected H's dtype torch.float64. Give all", Q(q=GOOD["q"].float())),
    ("q: got a tensor on meta, expected one on H's device, cpu. Move", Q(q=GOOD["q"].to("meta"))),
    ("H: got torch.float16", lambda: qm.QuadraticProgram(**{k: v.half() for k, v in GOOD.items()})),
    ("qp: got dict, expected a QuadraticProgram. Pass", lambda: qm.solve_qp(GOOD)),
    (
        "fixed: got a tensor on meta, expected one on cpu.",
        lambda: qm.solve_qp(qp, fixed.to("meta")),
    ),
    ("warm_start: got list, expected a", lambda: qm.solve_qp(qp, fixed, warm_start=[0])),
    ("A: got [[1.0, 0.0], [1.0]], expected a tensor, or what", M(A=[[1.0, 0.0], [1.0]])),
    ("A: got a torch.sparse_coo tensor, which is sparse, expected a", M(A=eye(2).to_sparse())),
    ("B: got csr_array, which is sparse, expected a", M(B=scipy.sparse.csr_array(np.ones((2, 1))))),
    ("discount_slack: got 'no', expected True or False.", M(discount_slack="no")),
    ("constants: got list, expected a Mapping.", M(constants=[(0, 1.0)])),
    ("held: got 'all', expected a tensor, or what torch.as_tensor takes", M(held="all")),
    ("offset: got 1000000", M(offset=10**400)),
    ("learn: got None, expected a collection of names among H, H_f, q, c, w, C, b", M(learn=None)),
    ("hessian: got ['block'], expected one of diagonal, block.", M(hessian=["block"])),
    ("terminal_weight: got 'ricatti' with hessian='diagonal'", M(terminal_weight="ricatti")),
    ("s: got a tensor on meta, expected one on cpu. Move it, or", lambda: mpc.value(S.to("meta"))),
    ("a: got shape (3, 1), expected leading", lambda: mpc.action_value(zeros(4, 2), zeros(3, 1))),
    ("a: got NoneType, expected a floating-point", lambda: mpc.action_value(S, None)),
    ("a: got a tensor on meta, expected one on cpu.", lambda: mpc.action_value(S, Aa.to("meta"))),
    # Operators, losses, penalties, the optimiser and the replay
    ("mpc: got Linear, expected a QPMPC.", lambda: qm.QPActorValueOperator(torch.nn.Linear(2, 1))),
    ("action: got a TensorDict with observation, expected one with", lambda: op(TD(observation=S))),
    ("a: got shape (4,)", lambda: op(TD(observation=S, action=Aa.squeeze(-1)))),
    ("delay_value: got 'no', expected True or False.", lambda: Loss(delay_value="no")),
    ("use_prioritized_weights: got 'yes', expected", lambda: Loss(use_prioritized_weights="yes")),
    ("gamma: got 2.0, expected a", lambda: qm.QPQLearningLoss(op).make_value_estimator(gamma=2.0)),
    ("('next', 'reward'): got no such entry, expected one of shape (3,", lost(("next", "reward"))),
    ("observation: got a TensorDict with no entry, expected", lost(("next", "observation"))),
    ("('next', 'reward'): got shape (3,)", with_entry(("next", "reward"), zeros(3).double())),
    ("('next', 'terminated'): got torch.float32", with_entry(("next", "terminated"), zeros(3, 1))),
    ("a: got torch.int64, expected a floating-point", with_entry("action", zeros(3, 1).long())),
    ("priority_weight: got NaN or inf, expected finite", with_entry("priority_weight", WEIGHTS)),
    ("tensordict: got an empty batch, expected at least", lambda: make_loss()(make_batch(3)[:0])),
    ("mpc: got QPActorValueOperator, expected a QPMPC. Pass the QPMPC", lambda: qm.GaussNewton(op)),
    ("rates: got list, expected a Mapping. Map names: {'cost': .., ", G(scales=[1.0])),
    ("scales[H]: got 0.0, expected a finite number >", G(scales={"cost": 0.0, "constraints": 0.0})),
    ("target: got shape (), expected shape (4,). Squeeze its", lambda: gn.step(S, Aa, tensor(0.0))),
    ("weighted: got 'yes', expected True or False.", lambda: Loss(weighted="yes")),
    (
        "penalty: got shape (3, 3), expected shape (12, 12).",
        lambda: free.step(S, Aa, V, penalty=eye(3)),
    ),
    ("s: got shape (2, 2, 2)", lambda: gn.step(zeros(2, 2, 2), zeros(2, 2, 1), zeros(2, 2))),
    ("mpc: got a QPMPC with new parameters of C, expected the parameters of this", released_step),
    ("s: got an empty batch, expected at least one", lambda: gn.step(S[:0], Aa[:0], zeros(0))),
    ("C: got shape (11,), expected shape (6, 11). Pass mpc.C.", lambda: deviation(mpc.C[0])),
    ("mpc: got Parameter, expected a QPMPC.", lambda: qm.DeviationPenalty(mpc.C)),
    ("scale: got -1.0, expected a finite", lambda: deviation.proximal_step_(random_mpc(0).C, -1.0)),
    ("windows: got shape (11, 6), expected shape (M, 11).", lambda: si(zeros(5, 11), mpc.C.mT)),
    ("C: got QPMPC, expected a floating-point torch.Tensor.", lambda: si(mpc, zeros(1, 11))),
    # Analysis
    ("C: got shape (11,), expected shape (N n_x, n_z)", lambda: prediction_form(zeros(11), 2, 1)),
    ("form: got Parameter, expected a PredictionForm.", lambda: canonical_matrix(mpc.C)),
    ("mpc: got Tensor, expected a QPMPC.", lambda: read(mpc.C_0)),
    ("true_model: got tuple of 1, expected the pair (A, B), (A, B,", lambda: read(mpc, (A2,))),
    ("mpc: got QPActorValueOperator, expected a QPMPC.", lambda: structure_metrics(op)),
    ("mpc: got QPActorValueOperator, expected a QPMPC.", lambda: local_gain(op, S)),
    ("s: got shape (3,), expected shape (*batch, 2).", lambda: local_gain(mpc, zeros(3))),
    ("terminal_weight: got a Riccati equation without a", lambda: lqr_gain(A2 * nan, B1, I3)),
    ("K: got shape (2, 1), expected shape", lambda: spectral_radius(A2, B1, zeros(2, 1).double())),
    ("A, B, K: got NaN or inf", lambda: spectral_radius(A2 * nan, B1, zeros(1, 2).double())),
    ("model: got tuple, expected a NearestModel. Pass", lambda: one_step_error((A2, B1), A2, B1)),
    ("offset: got shape (3,), expected", lambda: one_step_error(model, A2, B1, zeros(3).double())),
    ("moment: got shape (3, 3), expected", lambda: one_step_error(model, A2, B1, moment=eye(3))),
    ("step: got None, expected one of cholesky, projection, sdp.", lambda: check_step(None)),
    # Plants, closed loops and resuming
    ("s: got shape (32, 4), expected shape (*batch, 2).", lambda: closed_loop(mpc, pm)),
    ("steps: got 0, expected a whole number >= 1.", lambda: closed_loop(two, pm, steps=0)),
    ("starts: got 0, expected a whole number >= 1.", lambda: closed_loop(two, pm, starts=0)),
    ("seed: got -1, expected a whole number >= 0 and <", lambda: closed_loop(two, pm, seed=-1)),
    ("gamma: got 2.0, expected a discount", lambda: closed_loop(two, pm).discounted(2.0)),
    ("policy: got PointMass, expected a function. Pass a", lambda: closed_loop(pm, mpc.policy)),
    ("plant: got QPMPC, expected a LinearSystem, a Plant or a", lambda: closed_loop(two, mpc)),
    ("num_envs: got 0, expected a whole number >= 1.", lambda: LinearSystemEnv(pm, 0)),
    ("max_steps: got 1.5, expected a whole number >= 1.", lambda: LinearSystemEnv(pm, 2, 1.5)),
    ("dtype: got torch.int64, expected a", lambda: LinearSystemEnv(pm, dtype=torch.int64)),
    (f"seed: got {2**64}, expected a whole", lambda: LinearSystemEnv(pm).set_seed(2**64)),
    ("noise_kind: got 'pink', expected one of gaussian, brownian", lambda: PointMass("pink")),
    ("noise_std: got nan, expected a finite number >= 0", lambda: PointMass(noise_std=nan)),
    ("w: got inf, expected a finite number >= 0", lambda: GrosZanonLTI(inf)),
    ("start_position: got -1.0, expected a finite number", lambda: PointMass(start_position=-1.0)),
    ("B: got shape (4, 2), expected shape (3, n_u). Use", lambda: PointMass(A=eye(3))),
    ("A: got list, expected a floating-point torch.Tensor. Convert", lambda: PointMass(A=[[1.0]])),
    ("lb_a: got torch.float32, expected torch.float64. Use", lambda: PointMass(lb_a=ones(2) * 2)),
    ("A: got NaN or inf, expected finite entries.", lambda: PointMass(A=eye(4).double() * nan)),
    ("lb_s: got shape (), expected shape (4,). Use", lambda: PointMass(lb_s=tensor(-2.0).double())),
    ("s: got shape (3,), expected shape (*batch,", lambda: pm.step(zeros(3), zeros(2), zeros(4))),
    ("s: got shape (5, 3), expected shape (*batch, 4).", lambda: pm.cost(zeros(5, 3), zeros(5, 2))),
    ("a: got shape (5, 1), expected shape (*batch, 2).", lambda: pm.applied(zeros(5, 1))),
    ("rng: got 1, expected a NumPy or torch generator. From a seed:", lambda: pm.starts(1, 3)),
    ("nu: got shape (5, 1), expected", lambda: pm.step(zeros(5, 4), zeros(5, 2), zeros(5, 1))),
    (
        "action: got 'a', expected a tensor, or what torch.as_tensor takes",
        lambda: episode.step("a"),
    ),
    ("action: got NaN or inf, expected finite entries", lambda: episode.step(np.full(2, np.nan))),
    (
        "action: got shape (1, 2), expected shape (2,). Pass one action",
        lambda: episode.step(np.zeros((1, 2))),
    ),
    ("num_envs: got 0, expected a whole number >= 1.", lambda: pendulum.vectorised(0, 5, 1)),
    ("task.id: got NoneType, expected a str.", lambda: GymnasiumPlant(None)),
    ("max_steps: got 0, expected a whole number >= 1.", lambda: pendulum.vectorised(1, 0, 1)),
]


@pytest.mark.parametrize(("beginning", "mistake"), MISTAKES)
def test_a_mistake_is_named(beginning, mistake):
    with pytest.raises(qm.QPError, match="^" + re.escape(beginning)):
        mistake()


@pytest.mark.parametrize(
    "make", [qm.QPMPC.from_model, lambda A, B, N, **x: qm.QPMPC.from_data({}, N, **x)]
)
def test_the_nearest_keyword_is_suggested(make):
    with pytest.raises(TypeError, match=r"'stage_weigth'; did you mean 'stage_weight'\?"):
        make([[1.0]], [[1.0]], 3, stage_weigth=[1.0, 0.1])
