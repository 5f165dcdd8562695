"""Mistakes with the QP itself: its data, solving it, and the module that owns theta."""

# The wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportUnhashable=false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
import torch

import torch_qpmpc as qm
from tests.mistakes.objects import A2, B1, GOOD, Aa, M, Q, S, fixed, mpc, qp

MISTAKES: dict[str, list[Callable[[], Any]]] = {
    "q: got torch.float32, expected H's dtype torch.float64. Give all nine tenso": [
        Q(q=GOOD["q"].float())
    ],
    "q: got a tensor on meta, expected one on H's device, cpu. Move all nine to": [
        Q(q=GOOD["q"].to("meta"))
    ],
    "H: got torch.float16, expected torch.float32 or torch.float64. Half precisi": [
        lambda: qm.QuadraticProgram(**{k: v.half() for k, v in GOOD.items()})
    ],
    "H: got shape (12,), expected shape (*batch, n_z, n_z).": [Q(H=torch.ones(12).double())],
    "qp: got dict, expected a QuadraticProgram. Pass mpc.quadratic_progra": [
        lambda: qm.solve_qp(GOOD)
    ],
    "fixed: got a tensor on meta, expected one on the QP's cpu. Move it: fixed.t": [
        lambda: qm.solve_qp(qp, fixed.to("meta"))
    ],
    "warm_start: got list, expected a QPSolution, or its `active`.": [
        lambda: qm.solve_qp(qp, fixed, warm_start=[0])
    ],
    "3 of 3 QPs have no certified solution. 3 INVALID_DATA, first at batch index": [
        lambda: qm.solve_qp(qp, fixed * torch.nan)
    ],
    "n_x: got True, expected a positive integer.": [M(n_x=True)],
    "gamma: got nan, expected a discount factor in (0, 1].": [M(gamma=math.nan)],
    "A, B: got shapes (2,) and (2, 1), expected matrices (n_x, n_x) and (n_x, n_u).": [
        M(A=torch.ones(2))
    ],
    "A: got a tensor of torch.complex64 on cpu, expected a tensor, or what torch": [
        M(A=torch.eye(2).to(torch.complex64))
    ],
    "A, B: got shapes (2, 2) and (1, 2), expected (n_x, L n_x) and (n_x, L n_u). L is": [
        M(B=torch.ones(1, 2))
    ],
    "A: got a tensor of torch.float32 on meta, expected a tensor, or what torch.": [
        M(A=torch.eye(2, device="meta"))
    ],
    "A: got [[1.0, 0.0], [1.0]], expected a tensor, or what torch.as_tensor take": [
        M(A=[[1.0, 0.0], [1.0]])
    ],
    "A, B: got shapes (3, 2) and (2, 1), expected (n_x, L n_x) and (n_x, L n_u). L is": [
        M(A=torch.ones(3, 2))
    ],
    (
        "A: got a torch.sparse_coo tensor, which is sparse, expected a dense matrix. Convert it: "
        "A.to_dense()."
    ): [M(A=torch.eye(2).to_sparse())],
    "B: got csr_array, which is sparse, expected a dense matrix. Convert it: B.toarray().": [
        M(B=scipy.sparse.csr_array(np.ones((2, 1))))
    ],
    "seed: got 9223372036854775808, expected a whole number >= 0 and < 2^63.": [M(seed=2**63)],
    "seed: got 1.5, expected a whole number >= 0 and < 2^63.": [M(seed=1.5)],
    "state_slack: got 'inf', expected a non-negative weight, or inf for hard row": [
        M(state_slack="inf")
    ],
    "discount_slack: got 'no', expected True or False.": [M(discount_slack="no")],
    "learn: got None, expected a collection of names among H, H_f, q, c, w, C, b": [M(learn=None)],
    "hessian: got ['block'], expected one of diagonal, block, full.": [M(hessian=["block"])],
    "terminal_weight: got 'ricatti' with hessian='diagonal', expected a tensor, ": [
        M(terminal_weight="ricatti")
    ],
    "offset: got shape (1,), expected shape (2,).": [M(offset=[1.0])],
    "constraints: got ([[1.0, 0, 0]], [1.0]), expected the triple (D, lower, upp": [
        M(constraints=([[1.0, 0, 0]], [1.0]))
    ],
    "constraints, bounds: got shape (2,), expected shape (1,) on each side.": [
        M(constraints=([[1.0, 0, 0]], [0.0, 0.0], [1.0, 1.0]))
    ],
    (
        "stage_weight: got smallest eigenvalue -1, expected a positive semidefinite weight. It "
        "weights a cost: negate a reward's weight."
    ): [lambda: qm.QPMPC.from_model(A2, B1, 3, stage_weight=[-1.0, -1.0, -0.1])],
    "A: got None, expected a tensor, or what torch.as_tensor takes, of real numb": [
        lambda: qm.QPMPC.from_model(None, None, 3)
    ],
    "A, B: got shapes (1,) and (1,), expected matrices (n_x, n_x) and (n_x, n_u)": [
        lambda: qm.QPMPC.linear_mpc([1.0], [1.0], 3)
    ],
    "A, B: got shapes (2, 1) and (2, 2), expected (n_x, L n_x) and (n_x, L n_u). L is": [
        lambda: qm.QPMPC.linear_mpc(torch.ones(2, 1), torch.eye(2), 3)
    ],
    "s: got a tensor on meta, expected one on cpu. Move it, or the module: .to('": [
        lambda: mpc.value(S.to("meta"))
    ],
    "s: got shape (4, 1), expected shape (*batch, 2).": [lambda: mpc.action_value(Aa, S)],
    "a: got shape (3, 1), expected leading dimensions that broadcast with those ": [
        lambda: mpc.action_value(torch.zeros(4, 2), torch.zeros(3, 1))
    ],
    "a: got a tensor on meta, expected one on cpu. Move it, or the module: .to('": [
        lambda: mpc.action_value(S, Aa.to("meta"))
    ],
    "qp: got dict, expected a QuadraticProgram. Pass mpc.quadratic_program(), or": [
        lambda: mpc.value(S, GOOD),
        lambda: mpc.solve(S, qp=GOOD),
    ],
    "fixed: got shape (4, 2), expected leading dimensions that broadcast with th": [
        lambda: mpc.solve(S, qp=qp)
    ],
    "warm_start: got int, expected a QPSolution, or its `active`.": [
        lambda: mpc.solve(S, warm_start=3)
    ],
    "stage_weight: got shape (3, 3), expected shape (3,) or (4, 3). A matrix needs hessian='b": [
        lambda: qm.QPMPC.from_model(A2, B1, 4, stage_weight=torch.eye(3))
    ],
    "rates: got list, expected a mapping such as {'cost': .., 'constraints': ..}": [
        lambda: mpc.parameter_groups([1.0])
    ],
    "rates[H]: got -1.0, expected a finite number >= 0.": [
        lambda: mpc.parameter_groups({"cost": -1.0, "constraints": 1.0})
    ],
    "rates: got ['G'], expected parts that are learned: H, c, C. Add them to lear": [
        lambda: mpc.parameter_groups({"cost": 1.0, "constraints": 1.0, "G": 1.0})
    ],
}
