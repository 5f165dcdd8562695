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

MISTAKES: dict[str, tuple[Callable[[], Any], str]] = {
    "QuadraticProgram: dtype mix": (
        Q(q=GOOD["q"].float()),
        "q: got torch.float32, expected H's dtype torch.float64. Give all nine tenso",
    ),
    "QuadraticProgram: device": (
        Q(q=GOOD["q"].to("meta")),
        "q: got a tensor on meta, expected one on H's device, cpu. Move all nine to",
    ),
    "QuadraticProgram: half": (
        lambda: qm.QuadraticProgram(**{k: v.half() for k, v in GOOD.items()}),
        "H: got torch.float16, expected torch.float32 or torch.float64. Half precisi",
    ),
    "QuadraticProgram: H vector": (
        Q(H=torch.ones(12).double()),
        "H: got shape (12,), expected shape (*batch, n_z, n_z).",
    ),
    "solve_qp: dict": (
        lambda: qm.solve_qp(GOOD),
        "qp: got dict, expected a QuadraticProgram. Pass mpc.quadratic_progra",
    ),
    "solve_qp: fixed meta": (
        lambda: qm.solve_qp(qp, fixed.to("meta")),
        "fixed: got a tensor on meta, expected one on the QP's cpu. Move it: fixed.t",
    ),
    "solve_qp: warm list": (
        lambda: qm.solve_qp(qp, fixed, warm_start=[0]),
        "warm_start: got list, expected a QPSolution, or its `active`.",
    ),
    "solve_qp: nan fixed": (
        lambda: qm.solve_qp(qp, fixed * torch.nan),
        "3 of 3 QPs have no certified solution. 3 INVALID_DATA, first at batch index",
    ),
    "QPMPC: n_x bool": (
        M(n_x=True),
        "n_x: got True, expected a positive integer.",
    ),
    "QPMPC: n_x float": (
        M(n_x=2.0),
        "n_x: got 2.0, expected a positive integer.",
    ),
    "QPMPC: gamma str": (
        M(gamma="0.9"),
        "gamma: got '0.9', expected a discount factor in (0, 1].",
    ),
    "QPMPC: gamma nan": (
        M(gamma=math.nan),
        "gamma: got nan, expected a discount factor in (0, 1].",
    ),
    "QPMPC: A 1d": (
        M(A=torch.ones(2)),
        "A, B: got shapes (2,) and (2, 1), expected matrices (n_x, n_x) and (n_x, n_u).",
    ),
    "QPMPC: A complex": (
        M(A=torch.eye(2).to(torch.complex64)),
        "A: got a tensor of torch.complex64 on cpu, expected a tensor, or what torch",
    ),
    "QPMPC: A transposed B": (
        M(B=torch.ones(1, 2)),
        "A, B: got shapes (2, 2) and (1, 2), expected (n_x, L n_x) and (n_x, L n_u). L is",
    ),
    "QPMPC: A meta": (
        M(A=torch.eye(2, device="meta")),
        "A: got a tensor of torch.float32 on meta, expected a tensor, or what torch.",
    ),
    "QPMPC: A str": (
        M(A="eye"),
        "A: got 'eye', expected a tensor, or what torch.as_tensor takes, of real num",
    ),
    "QPMPC: A ragged": (
        M(A=[[1.0, 0.0], [1.0]]),
        "A: got [[1.0, 0.0], [1.0]], expected a tensor, or what torch.as_tensor take",
    ),
    "QPMPC: A 3x2": (
        M(A=torch.ones(3, 2)),
        "A, B: got shapes (3, 2) and (2, 1), expected (n_x, L n_x) and (n_x, L n_u). L is",
    ),
    "QPMPC: A sparse": (
        M(A=torch.eye(2).to_sparse()),
        "A: got a torch.sparse_coo tensor, which is sparse, expected a dense matrix. Convert it: "
        "A.to_dense().",
    ),
    "QPMPC: B sparse by scipy": (
        M(B=scipy.sparse.csr_array(np.ones((2, 1)))),
        "B: got csr_array, which is sparse, expected a dense matrix. Convert it: B.toarray().",
    ),
    "QPMPC: seed huge": (
        M(seed=2**63),
        "seed: got 9223372036854775808, expected a whole number >= 0 and < 2^63.",
    ),
    "QPMPC: seed float": (
        M(seed=1.5),
        "seed: got 1.5, expected a whole number >= 0 and < 2^63.",
    ),
    "QPMPC: seed neg": (
        M(seed=-1),
        "seed: got -1, expected a whole number >= 0 and < 2^63.",
    ),
    "QPMPC: slack str": (
        M(state_slack="inf"),
        "state_slack: got 'inf', expected a non-negative weight, or inf for hard row",
    ),
    "QPMPC: discount_slack": (
        M(discount_slack="no"),
        "discount_slack: got 'no', expected True or False.",
    ),
    "QPMPC: learn None": (
        M(learn=None),
        "learn: got None, expected a collection of names among H, H_f, q, c, w, C, b",
    ),
    "QPMPC: learn nonhash": (
        M(learn=[["C"]]),
        "learn: got [['C']], expected a collection of names among H, H_f, q, c, w, C",
    ),
    "QPMPC: hessian": (
        M(hessian="diag"),
        "hessian: got 'diag', expected one of diagonal, block, full.",
    ),
    "QPMPC: hessian list": (
        M(hessian=["block"]),
        "hessian: got ['block'], expected one of diagonal, block, full.",
    ),
    "QPMPC: terminal_w str": (
        M(terminal_weight="ricatti"),
        "terminal_weight: got 'ricatti' with hessian='diagonal', expected a tensor, ",
    ),
    "QPMPC: offset": (
        M(offset=[1.0]),
        "offset: got shape (1,), expected shape (2,).",
    ),
    "QPMPC: constraints pair": (
        M(constraints=([[1.0, 0, 0]], [1.0])),
        "constraints: got ([[1.0, 0, 0]], [1.0]), expected the triple (D, lower, upp",
    ),
    "QPMPC: constraints bounds": (
        M(constraints=([[1.0, 0, 0]], [0.0, 0.0], [1.0, 1.0])),
        "constraints, bounds: got shape (2,), expected shape (1,) on each side.",
    ),
    "QPMPC.from_model: a reward's weight": (
        lambda: qm.QPMPC.from_model(A2, B1, 3, stage_weight=[-1.0, -1.0, -0.1]),
        "stage_weight: got smallest eigenvalue -1, expected a positive semidefinite weight. It "
        "weights a cost: negate a reward's weight.",
    ),
    "QPMPC.from_model: none": (
        lambda: qm.QPMPC.from_model(None, None, 3),
        "A: got None, expected a tensor, or what torch.as_tensor takes, of real numb",
    ),
    "QPMPC.linear_mpc: 1d": (
        lambda: qm.QPMPC.linear_mpc([1.0], [1.0], 3),
        "A, B: got shapes (1,) and (1,), expected matrices (n_x, n_x) and (n_x, n_u)",
    ),
    "QPMPC.linear_mpc: swapped": (
        lambda: qm.QPMPC.linear_mpc(torch.ones(2, 1), torch.eye(2), 3),
        "A, B: got shapes (2, 1) and (2, 2), expected (n_x, L n_x) and (n_x, L n_u). L is",
    ),
    "QPMPC.value: meta": (
        lambda: mpc.value(S.to("meta")),
        "s: got a tensor on meta, expected one on cpu. Move it, or the module: .to('",
    ),
    "QPMPC.action_value: swapped": (
        lambda: mpc.action_value(Aa, S),
        "s: got shape (4, 1), expected shape (*batch, 2).",
    ),
    "QPMPC.action_value: batch": (
        lambda: mpc.action_value(torch.zeros(4, 2), torch.zeros(3, 1)),
        "a: got shape (3, 1), expected leading dimensions that broadcast with those ",
    ),
    "QPMPC.action_value: meta a": (
        lambda: mpc.action_value(S, Aa.to("meta")),
        "a: got a tensor on meta, expected one on cpu. Move it, or the module: .to('",
    ),
    "QPMPC.value: qp": (
        lambda: mpc.value(S, GOOD),
        "qp: got dict, expected a QuadraticProgram. Pass mpc.quadratic_program(), or",
    ),
    "solve_qp: qp wrong": (
        lambda: mpc.solve(S, qp=GOOD),
        "qp: got dict, expected a QuadraticProgram. Pass mpc.quadratic_program(), or",
    ),
    "solve_qp: qp other": (
        lambda: mpc.solve(S, qp=qp),
        "fixed: got shape (4, 2), expected leading dimensions that broadcast with th",
    ),
    "solve_qp: warm wrong": (
        lambda: mpc.solve(S, warm_start=3),
        "warm_start: got int, expected a QPSolution, or its `active`.",
    ),
    "QPMPC.from_model: a matrix": (
        lambda: qm.QPMPC.from_model(A2, B1, 4, stage_weight=torch.eye(3)),
        "stage_weight: got shape (3, 3), expected shape (3,) or (4, 3). A matrix needs hessian='b",
    ),
    "QPMPC.parameter_groups: list": (
        lambda: mpc.parameter_groups([1.0]),
        "rates: got list, expected a mapping such as {'cost': .., 'constraints': ..}",
    ),
    "QPMPC.parameter_groups: negative": (
        lambda: mpc.parameter_groups({"cost": -1.0, "constraints": 1.0}),
        "rates[H]: got -1.0, expected a finite number >= 0.",
    ),
    "QPMPC.parameter_groups: unlearned": (
        lambda: mpc.parameter_groups({"cost": 1.0, "constraints": 1.0, "G": 1.0}),
        "rates: got ['G'], expected parts that are learned: H, c, C. Add them to lear",
    ),
}
