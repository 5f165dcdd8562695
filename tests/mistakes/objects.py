"""Valid objects that the mistakes start from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict

import torch_qpmpc as qm
from tests.problems import known_qp, random_mpc
from tests.transitions import make_batch, make_operator
from torch_qpmpc.analysis.structure import prediction_form
from torch_qpmpc.envs import PointMass
from torch_qpmpc.mpc.banded import banded_matrix

A2 = torch.tensor([[1.0, 0.1], [0, 0.9]]).double()
B1 = torch.tensor([[0.0], [1.0]]).double()
W3 = [1.0, 1.0, 1.0]
KNOWN = known_qp(14, batch=(3,))
qp, fixed = KNOWN.qp, KNOWN.fixed
GOOD = dict(zip(("H", "q", "c", "C", "b", "G", "lb", "ub", "w"), qp.tensors(), strict=True))
mpc = random_mpc(0)
free = random_mpc(0, learn=("H", "c", "C"))
S, Aa = torch.zeros(4, 2), torch.zeros(4, 1)
op = make_operator()
gn = qm.GaussNewton(random_mpc(0))
form = prediction_form(banded_matrix(A2, B1, 4), 2, 1)
pm = PointMass()


def Q(**changes: Any) -> Callable[[], Any]:
    data: dict[str, Any] = GOOD | changes
    return lambda: qm.QuadraticProgram(**data)


def M(**changes: Any) -> Callable[[], Any]:
    base = {"n_x": 2, "n_u": 1, "horizon": 3, "A": torch.eye(2), "B": torch.ones(2, 1)}
    return lambda: qm.QPMPC.of(**(base | changes))


def G(**changes: Any) -> Callable[[], Any]:
    options: dict[str, Any] = {"mpc": random_mpc(0)} | changes
    return lambda: qm.GaussNewton(**options)


def batch_without(*keys: Any) -> TensorDict:
    return make_batch(3).exclude(*keys)


def batch_with(key: Any, value: torch.Tensor) -> TensorDict:
    batch = make_batch(3)
    batch[key] = value
    return batch
