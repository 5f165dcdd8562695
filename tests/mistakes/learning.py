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
from tests.mistakes.objects import Aa, G, S, batch_with, batch_without, free, gn, mpc, op
from tests.problems import random_mpc
from tests.transitions import make_batch, make_loss
from torch_qpmpc.learning.replay import Replay, windows_to_tau


def released_step() -> None:
    tied = random_mpc(0, structure="tied")
    optimizer = qm.GaussNewton(tied)
    tied.release()
    optimizer.step(S, Aa, torch.zeros(4))


MISTAKES: dict[str, list[Callable[[], Any]]] = {
    "mpc: got Linear, expected a QPMPC.": [lambda: qm.QPActorValueOperator(torch.nn.Linear(2, 1))],
    "action: got a TensorDict with observation, expected one with action. Rename the module": [
        lambda: op(TensorDict(observation=S, batch_size=4)),
        lambda: make_loss()(batch_without("action")),
    ],
    "observation: got a TensorDict with action, expected one with observation. Rename the mod": [
        lambda: op(TensorDict(action=Aa, batch_size=4))
    ],
    "observation: got a TensorDict with state, expected one with observation. Rename the mod": [
        lambda: op.get_policy_operator()(TensorDict(state=S, batch_size=4))
    ],
    "a: got shape (4,), expected shape (*batch, 1).": [
        lambda: op(TensorDict(observation=S, action=Aa.squeeze(-1), batch_size=4))
    ],
    "warm_start: got shape (4, 3) of torch.float32, expected (4, 11) of torch.in": [
        lambda: qm.QPActorValueOperator(random_mpc(0), active_set_key="act")(
            TensorDict(observation=S, action=Aa, act=torch.zeros(4, 3), batch_size=4)
        )
    ],
    "delay_value: got 'no', expected True or False.": [
        lambda: qm.QPQLearningLoss(op, delay_value="no")
    ],
    "use_prioritized_weights: got 'yes', expected 'auto', True or False.": [
        lambda: qm.QPQLearningLoss(op, use_prioritized_weights="yes")
    ],
    "gamma: got 2.0, expected a number in [0, 1].": [
        lambda: qm.QPQLearningLoss(op).make_value_estimator(gamma=2.0)
    ],
    "('next', 'reward'): got no such entry, expected one of shape (3, 1). Name a": [
        lambda: make_loss()(batch_without(("next", "reward")))
    ],
    "('next', 'done'): got no such entry, expected one of shape (3, 1). Name ano": [
        lambda: make_loss()(batch_without(("next", "done"), ("next", "terminated")))
    ],
    (
        "('next', 'observation'): got a TensorDict with done, reward, terminated, truncated, "
        "expected one with observation. Collect the next"
    ): [lambda: make_loss()(batch_without(("next", "observation")))],
    "('next', 'reward'): got shape (3,), expected shape (3, 1). TorchRL's rewa": [
        lambda: make_loss()(batch_with(("next", "reward"), torch.zeros(3).double()))
    ],
    "('next', 'terminated'): got torch.float32, expected torch.bool. Convert it: .b": [
        lambda: make_loss()(batch_with(("next", "terminated"), torch.zeros(3, 1)))
    ],
    "('next', 'terminated'): got shape (3,), expected shape (3, 1). TorchRL's re": [
        lambda: make_loss()(batch_with(("next", "terminated"), torch.zeros(3).bool()))
    ],
    "('next', 'done'): got shape (3,), expected shape (3, 1). TorchRL's rewards": [
        lambda: make_loss()(batch_with(("next", "done"), torch.zeros(3).bool()))
    ],
    "('next', 'done'): got torch.float32, expected torch.bool. Convert it: .bool().": [
        lambda: make_loss()(batch_with(("next", "done"), torch.zeros(3, 1)))
    ],
    "a: got torch.int64, expected a floating-point torch.Tensor. Convert it: tor": [
        lambda: make_loss()(batch_with("action", torch.zeros(3, 1).long()))
    ],
    "tensordict: got an empty batch, expected at least one transition.": [
        lambda: make_loss()(make_batch(3)[:0])
    ],
    "mpc: got QPActorValueOperator, expected a QPMPC. Pass the QPMPC itself: its": [
        lambda: qm.GaussNewton(op)
    ],
    "rates: got list, expected a mapping such as {'cost': .., 'constraints': ..}": [
        G(scales=[1.0])
    ],
    "rates[H]: got -1.0, expected a finite number >= 0.": [
        G(scales={"cost": -1.0, "constraints": 1.0})
    ],
    "scales[H]: got 0.0, expected a finite number > 0.": [
        G(scales={"cost": 0.0, "constraints": 0.0})
    ],
    "trust_region: got 'no', expected True or False.": [G(trust_region="no")],
    "target: got shape (), expected shape (4,). Squeeze its last dimension.": [
        lambda: gn.step(S, Aa, torch.tensor(0.0))
    ],
    "weighted: got 'yes', expected True or False.": [lambda: qm.GaussNewton(mpc, weighted="yes")],
    "penalty: got shape (3, 3), expected shape (12, 12). Pass SystemIdentificati": [
        lambda: qm.GaussNewton(free).step(S, Aa, torch.zeros(4), penalty=torch.eye(3))
    ],
    "warm_start: got shape (2, 3) of torch.float32, expected (4, 11) of torch.in": [
        lambda: gn.step(S, Aa, torch.zeros(4), warm_start=torch.zeros(2, 3))
    ],
    "s: got shape (2, 2, 2), expected shape (B, 2).": [
        lambda: gn.step(torch.zeros(2, 2, 2), torch.zeros(2, 2, 1), torch.zeros(2, 2))
    ],
    (
        "mpc: got a QPMPC with new parameters of C, expected the parameters of this optimiser. "
        "QPMPC.release and load_state_dict(assign=True) replace"
    ): [released_step],
    "s: got an empty batch, expected at least one pair.": [
        lambda: gn.step(S[:0], Aa[:0], torch.zeros(0)).accepted
    ],
    "n_x: got 0, expected a whole number >= 1.": [lambda: qm.DeviationPenalty(mpc.C_0, 0, 1)],
    "C: got shape (11,), expected shape (6, 11). Pass mpc.C.": [
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1)(mpc.C[0])
    ],
    "C_0: got shape (11,), expected shape (N n_x, n_z). Pass the C_0 of a QPMPC.": [
        lambda: qm.DeviationPenalty(mpc.C_0[0], 2, 1)
    ],
    "C_0: got NaN or inf, expected finite entries. Pass the C_0 of a QPMPC.": [
        lambda: qm.DeviationPenalty(mpc.C_0 * math.nan, 2, 1)
    ],
    "C: got shape (3, 3), expected shape (6, 11). Pass mpc.C.": [
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1).proximal_step_(torch.zeros(3, 3))
    ],
    "scale: got -1.0, expected a finite number >= 0.": [
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1).proximal_step_(random_mpc(0).C, -1.0)
    ],
    "windows: got shape (11, 6), expected shape (M, 11). Sample N consecutive tr": [
        lambda: qm.SystemIdentificationPenalty()(torch.zeros(5, 11), mpc.C.mT)
    ],
    "C: got QPMPC, expected a floating-point torch.Tensor. Convert i": [
        lambda: qm.SystemIdentificationPenalty()(mpc, torch.zeros(1, 11))
    ],
    "windows: got shape (2, 3, 11), expected shape (M, n_z). Sample N consecutiv": [
        lambda: qm.SystemIdentificationPenalty().curvature(torch.zeros(2, 3, 11)).shape
    ],
    "batch_size: got 0, expected a whole number >= 1.": [lambda: Replay(64, 2, 0, 3, 2)],
    "window: got 0, expected a whole number >= 1.": [lambda: Replay(64, 2, 4, 0, 2)],
    "num_windows: got 0, expected a whole number >= 1.": [lambda: Replay(64, 2, 4, 3, 0)],
    "capacity: got -64, expected a whole number >= 0.": [lambda: Replay(-64, 2, 4, 3, 2)],
    "num_envs: got -2, expected a whole number >= 1.": [lambda: Replay(64, -2, 4, 3, 2)],
    "seed: got 'a', expected a whole number >= 0 and < 2^63.": [
        lambda: Replay(64, 2, 4, 3, 2, seed="a")
    ],
    "active_rows: got -1, expected a whole number >= 0.": [
        lambda: Replay(64, 2, 4, 3, 2, active_rows=-1)
    ],
    "replay: got nothing stored, expected transitions. Call extend() first.": [
        lambda: Replay(64, 2, 4, 3, 2).sample()
    ],
    "batch: got list, expected a TensorDictBase. Pass the collector's batch as i": [
        lambda: Replay(64, 2, 4, 3, 2).extend([1])
    ],
    "batch: got shape (3, 2), expected (num_envs, T) with num_envs = 2. Transpose it": [
        lambda: (lambda r: (r.extend(make_batch(3, 2)), r.sample()))(Replay(64, 2, 4, 3, 2))
    ],
    "sample: got no entry active_set, expected one. Pass what sample() returned,": [
        lambda: (
            lambda r: (r.extend(make_batch(2, 8)), r.remember(r.sample().exclude("active_set")))
        )(Replay(64, 2, 4, 3, 2, active_rows=3))
    ],
    "state: got no generator, storage, writer, expected what state_dict() return": [
        lambda: Replay(64, 2, 4, 3, 2).load_state_dict({})
    ],
    "windows: got Tensor, expected a TensorDictBase.": [lambda: windows_to_tau(S)],
    "windows: got shape (4,) with observation, expected consecutive transitions ": [
        lambda: windows_to_tau(TensorDict(observation=S, batch_size=4))
    ],
}
