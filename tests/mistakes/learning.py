"""Mistakes with operators, losses, the optimiser, penalties and the replay."""

# The wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnhashable=false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict

import torch_qpmpc as qm
from tests.mistakes.objects import (
    Aa,
    G,
    S,
    batch_with,
    batch_without,
    free,
    gn,
    mpc,
    op,
)
from tests.problems import random_mpc
from tests.transitions import make_batch, make_loss
from torch_qpmpc.learning.replay import make_replay, windows_to_tau


def released_step() -> None:
    tied = random_mpc(0, structure="tied")
    optimizer = qm.GaussNewton(tied)
    tied.release()
    optimizer.step(S, Aa, torch.zeros(4))


MISTAKES: dict[str, tuple[Callable[[], Any], str]] = {
    "QPActorValueOperator: model": (
        lambda: qm.QPActorValueOperator(torch.nn.Linear(2, 1)),
        "mpc: got Linear, expected a QPMPC.",
    ),
    "QPActorValueOperator: missing action": (
        lambda: op(TensorDict(observation=S, batch_size=4)),
        "action: got a TensorDict with observation, expected one with action. Rename the module",
    ),
    "QPActorValueOperator: missing obs": (
        lambda: op(TensorDict(action=Aa, batch_size=4)),
        "observation: got a TensorDict with action, expected one with observation. Rename the mod",
    ),
    "QPPolicyOperator: missing obs": (
        lambda: op.get_policy_operator()(TensorDict(state=S, batch_size=4)),
        "observation: got a TensorDict with state, expected one with observation. Rename the mod",
    ),
    "QPActorValueOperator: squeezed action": (
        lambda: op(TensorDict(observation=S, action=Aa.squeeze(-1), batch_size=4)),
        "a: got shape (4,), expected shape (*batch, 1).",
    ),
    "QPActorValueOperator: active float": (
        lambda: qm.QPActorValueOperator(random_mpc(0), active_set_key="act")(
            TensorDict(observation=S, action=Aa, act=torch.zeros(4, 3), batch_size=4)
        ),
        "warm_start: got shape (4, 3) of torch.float32, expected (4, 11) of torch.in",
    ),
    "QPQLearningLoss: delay": (
        lambda: qm.QPQLearningLoss(op, delay_value="no"),
        "delay_value: got 'no', expected True or False.",
    ),
    "QPQLearningLoss: prio": (
        lambda: qm.QPQLearningLoss(op, use_prioritized_weights="yes"),
        "use_prioritized_weights: got 'yes', expected 'auto', True or False.",
    ),
    "QPQLearningLoss: gamma 2": (
        lambda: qm.QPQLearningLoss(op).make_value_estimator(gamma=2.0),
        "gamma: got 2.0, expected a number in [0, 1].",
    ),
    "QPQLearningLoss: no reward": (
        lambda: make_loss()(batch_without(("next", "reward"))),
        "('next', 'reward'): got no such entry, expected one of shape (3, 1). Name a",
    ),
    "QPQLearningLoss: no action": (
        lambda: make_loss()(batch_without("action")),
        "action: got a TensorDict with observation, expected one with action. Rename the module",
    ),
    "QPQLearningLoss: no done": (
        lambda: make_loss()(batch_without(("next", "done"), ("next", "terminated"))),
        "('next', 'done'): got no such entry, expected one of shape (3, 1). Name ano",
    ),
    "QPQLearningLoss: no next obs": (
        lambda: make_loss()(batch_without(("next", "observation"))),
        "('next', 'observation'): got a TensorDict with done, reward, terminated, truncated, "
        "expected one with observation. Collect the next",
    ),
    "QPQLearningLoss: flat reward": (
        lambda: make_loss()(batch_with(("next", "reward"), torch.zeros(3).double())),
        "('next', 'reward'): got shape (3,), expected shape (3, 1). TorchRL's rewa",
    ),
    "QPQLearningLoss: term float": (
        lambda: make_loss()(batch_with(("next", "terminated"), torch.zeros(3, 1))),
        "('next', 'terminated'): got torch.float32, expected torch.bool. Convert it: .b",
    ),
    "QPQLearningLoss: term flat": (
        lambda: make_loss()(batch_with(("next", "terminated"), torch.zeros(3).bool())),
        "('next', 'terminated'): got shape (3,), expected shape (3, 1). TorchRL's re",
    ),
    "QPQLearningLoss: done flat": (
        lambda: make_loss()(batch_with(("next", "done"), torch.zeros(3).bool())),
        "('next', 'done'): got shape (3,), expected shape (3, 1). TorchRL's rewards",
    ),
    "QPQLearningLoss: done float": (
        lambda: make_loss()(batch_with(("next", "done"), torch.zeros(3, 1))),
        "('next', 'done'): got torch.float32, expected torch.bool. Convert it: .bool().",
    ),
    "QPQLearningLoss: action int": (
        lambda: make_loss()(batch_with("action", torch.zeros(3, 1).long())),
        "a: got torch.int64, expected a floating-point torch.Tensor. Convert it: tor",
    ),
    "QPQLearningLoss: empty": (
        lambda: make_loss()(make_batch(3)[:0]),
        "tensordict: got an empty batch, expected at least one transition.",
    ),
    "GaussNewton: operator": (
        lambda: qm.GaussNewton(op),
        "mpc: got QPActorValueOperator, expected a QPMPC. Pass the QPMPC itself: its",
    ),
    "GaussNewton: scales list": (
        G(scales=[1.0]),
        "rates: got list, expected a mapping such as {'cost': .., 'constraints': ..}",
    ),
    "GaussNewton: scales neg": (
        G(scales={"cost": -1.0, "constraints": 1.0}),
        "rates[H]: got -1.0, expected a finite number >= 0.",
    ),
    "GaussNewton: scales zero": (
        G(scales={"cost": 0.0, "constraints": 0.0}),
        "scales[H]: got 0.0, expected a finite number > 0.",
    ),
    "GaussNewton: trust": (
        G(trust_region="no"),
        "trust_region: got 'no', expected True or False.",
    ),
    "GaussNewton: target scalar": (
        lambda: gn.step(S, Aa, torch.tensor(0.0)),
        "target: got shape (), expected shape (4,). Squeeze its last dimension.",
    ),
    "GaussNewton: weighted": (
        lambda: qm.GaussNewton(mpc, weighted="yes"),
        "weighted: got 'yes', expected True or False.",
    ),
    "GaussNewton: penalty": (
        lambda: qm.GaussNewton(free).step(S, Aa, torch.zeros(4), penalty=torch.eye(3)),
        "penalty: got shape (3, 3), expected shape (12, 12). Pass SystemIdentificati",
    ),
    "GaussNewton: warm": (
        lambda: gn.step(S, Aa, torch.zeros(4), warm_start=torch.zeros(2, 3)),
        "warm_start: got shape (2, 3) of torch.float32, expected (4, 11) of torch.in",
    ),
    "GaussNewton: 3d": (
        lambda: gn.step(torch.zeros(2, 2, 2), torch.zeros(2, 2, 1), torch.zeros(2, 2)),
        "s: got shape (2, 2, 2), expected shape (B, 2).",
    ),
    "GaussNewton: released": (
        released_step,
        "mpc: got a QPMPC with new parameters of C, expected the parameters of this optimiser. "
        "QPMPC.release and load_state_dict(assign=True) replace",
    ),
    "GaussNewton: empty": (
        lambda: gn.step(S[:0], Aa[:0], torch.zeros(0)).accepted,
        "s: got an empty batch, expected at least one pair.",
    ),
    "DeviationPenalty: n_x 0": (
        lambda: qm.DeviationPenalty(mpc.C_0, 0, 1),
        "n_x: got 0, expected a whole number >= 1.",
    ),
    "DeviationPenalty: C row": (
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1)(mpc.C[0]),
        "C: got shape (11,), expected shape (6, 11). Pass mpc.C.",
    ),
    "DeviationPenalty: 1d": (
        lambda: qm.DeviationPenalty(mpc.C_0[0], 2, 1),
        "C_0: got shape (11,), expected shape (N n_x, n_z). Pass the C_0 of a QPMPC.",
    ),
    "DeviationPenalty: nan": (
        lambda: qm.DeviationPenalty(mpc.C_0 * math.nan, 2, 1),
        "C_0: got NaN or inf, expected finite entries. Pass the C_0 of a QPMPC.",
    ),
    "DeviationPenalty: prox shape": (
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1).proximal_step_(torch.zeros(3, 3)),
        "C: got shape (3, 3), expected shape (6, 11). Pass mpc.C.",
    ),
    "DeviationPenalty: prox scale neg": (
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1).proximal_step_(random_mpc(0).C, -1.0),
        "scale: got -1.0, expected a finite number >= 0.",
    ),
    "SystemIdentificationPenalty: swapped": (
        lambda: qm.SystemIdentificationPenalty()(torch.zeros(5, 11), mpc.C.mT),
        "windows: got shape (11, 6), expected shape (M, 11). Sample N consecutive tr",
    ),
    "SystemIdentificationPenalty: mpc": (
        lambda: qm.SystemIdentificationPenalty()(mpc, torch.zeros(1, 11)),
        "C: got QPMPC, expected a floating-point torch.Tensor. Convert i",
    ),
    "SystemIdentificationPenalty: curv 3d": (
        lambda: qm.SystemIdentificationPenalty().curvature(torch.zeros(2, 3, 11)).shape,
        "windows: got shape (2, 3, 11), expected shape (M, n_z). Sample N consecutiv",
    ),
    "make_replay: batch 0": (
        lambda: make_replay(64, 2, 0, 3, 2),
        "batch_size: got 0, expected a whole number >= 1.",
    ),
    "make_replay: window 0": (
        lambda: make_replay(64, 2, 4, 0, 2),
        "window: got 0, expected a whole number >= 1.",
    ),
    "make_replay: num_windows 0": (
        lambda: make_replay(64, 2, 4, 3, 0),
        "num_windows: got 0, expected a whole number >= 1.",
    ),
    "make_replay: neg": (
        lambda: make_replay(-64, 2, 4, 3, 2),
        "capacity: got -64, expected a whole number >= 0.",
    ),
    "make_replay: neg envs": (
        lambda: make_replay(64, -2, 4, 3, 2),
        "num_envs: got -2, expected a whole number >= 1.",
    ),
    "make_replay: seed": (
        lambda: make_replay(64, 2, 4, 3, 2, seed="a"),
        "seed: got 'a', expected a whole number >= 0 and < 2^63.",
    ),
    "make_replay: active": (
        lambda: make_replay(64, 2, 4, 3, 2, active_rows=-1),
        "active_rows: got -1, expected a whole number >= 0.",
    ),
    "make_replay: sample empty": (
        lambda: make_replay(64, 2, 4, 3, 2).sample(),
        "replay: got nothing stored, expected transitions. Call extend() first.",
    ),
    "make_replay: extend list": (
        lambda: make_replay(64, 2, 4, 3, 2).extend([1]),
        "batch: got list, expected a TensorDictBase. Pass the collector's batch as i",
    ),
    "make_replay: extend envs first": (
        lambda: (lambda r: (r.extend(make_batch(3, 2)), r.sample()))(make_replay(64, 2, 4, 3, 2)),
        "batch: got shape (3, 2), expected (num_envs, T) with num_envs = 2. Transpose it",
    ),
    "make_replay: remember": (
        lambda: make_replay(64, 2, 4, 3, 2, active_rows=3).remember(make_batch(3)),
        "sample: got no entry index, expected one. Pass what sample() returned, afte",
    ),
    "make_replay: remember 2": (
        lambda: (
            lambda r: (r.extend(make_batch(2, 8)), r.remember(r.sample().exclude("active_set")))
        )(make_replay(64, 2, 4, 3, 2, active_rows=3)),
        "sample: got no entry active_set, expected one. Pass what sample() returned,",
    ),
    "make_replay: load": (
        lambda: make_replay(64, 2, 4, 3, 2).load_state_dict({}),
        "state: got no generator, storage, writer, expected what state_dict() return",
    ),
    "windows_to_tau: tensor": (
        lambda: windows_to_tau(S),
        "windows: got Tensor, expected a TensorDictBase.",
    ),
    "windows_to_tau: missing": (
        lambda: windows_to_tau(TensorDict(observation=S, batch_size=4)),
        "windows: got shape (4,) with observation, expected consecutive transitions ",
    ),
}
