"""Contenders of the gradient benchmark: our solvers, cold and warm, and other packages' layers.

A contender's `Gradient` computes one Q-learning gradient (eq:thup): V on the next states, Q on the
visited pairs, and the gradient of half the mean squared TD error in all of theta.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tests.benchmarks.peers import PEERS, Values
from tests.benchmarks.problems import GAMMA, PAPER, Transitions, make_mpc, move, transitions
from torch_qpmpc import QPMPC, QuadraticProgram
from torch_qpmpc.qp.solvers import BACKENDS

BATCHES = (1, 256, 1024)
REFERENCE = next(iter(PEERS))
#: Relative change of theta since the solutions that warm starts use.
MOVED = 1e-3


@dataclass
class Gradient:
    """A gradient: `step` returns V(s+) and Q(s, a), and sets theta's ``grad``."""

    mpc: QPMPC
    batch: Transitions
    value: Callable[[Tensor, QuadraticProgram], Tensor]
    action_value: Callable[[Tensor, Tensor, QuadraticProgram], Tensor]

    def __post_init__(self) -> None:
        self.parameters = [*self.mpc.parameters()]

    def step(self) -> tuple[Tensor, Tensor]:
        for parameter in self.parameters:
            parameter.grad = None
        qp = self.mpc.quadratic_program()
        with torch.no_grad():
            V = self.value(self.batch.following, qp)
        Q = self.action_value(self.batch.s, self.batch.a, qp)
        value = Q.detach()
        minus_delta = (value - self.batch.cost).sub_(V, alpha=GAMMA)
        Q.backward(minus_delta.div_(float(len(V))))  # by an integer, torch would make a tensor
        return V, value

    def flat(self) -> Tensor:
        """Return the gradient in all of theta as one vector."""
        gradients = (p.grad for p in self.parameters)
        return torch.cat([g.flatten() for g in gradients if g is not None])


@dataclass(frozen=True)
class Contender:
    """A row of the table.

    ``make`` builds its `Gradient` from the QP and the batch; ``largest`` is the largest batch that
    it is worth waiting for; ``fast`` allows more rounds.
    """

    label: str
    solver: str
    make: Callable[[QPMPC, Transitions], Gradient]
    largest: int = BATCHES[-1]
    fast: bool = True
    ours: bool = True

    def gradient(self, dense: bool, batch: int) -> Gradient:
        mpc = make_mpc(PAPER, dense=dense, solver=self.solver)
        return self.make(mpc, transitions(PAPER.n_x, PAPER.n_u, BATCHES[-1]).first(batch))


def cold(mpc: QPMPC, batch: Transitions) -> Gradient:
    return Gradient(mpc, batch, mpc.value, mpc.action_value)


def warm(mpc: QPMPC, batch: Transitions) -> Gradient:
    """Warm-start from the same transitions' active sets at a theta changed by 0.1 %."""
    with torch.no_grad():
        theta = {name: p.clone() for name, p in mpc.named_parameters()}
        move(mpc, MOVED)
        of_V, of_Q = mpc.solve(batch.following).active, mpc.solve(batch.s, batch.a).active
        for name, parameter in mpc.named_parameters():
            parameter.copy_(theta[name])
    return Gradient(
        mpc,
        batch,
        lambda s, qp: mpc.solve(s, warm_start=of_V, qp=qp).value,
        lambda s, a, qp: mpc.solve(s, a, warm_start=of_Q, qp=qp).value,
    )


def peer(values: Callable[[], Values]) -> Callable[[QPMPC, Transitions], Gradient]:
    def make(mpc: QPMPC, batch: Transitions) -> Gradient:
        of = values()
        return Gradient(
            mpc, batch, lambda s, qp: of(qp, s), lambda s, a, qp: of(qp, torch.cat((s, a), dim=-1))
        )

    return make


def _ours() -> list[Contender]:
    contenders = []
    for name in BACKENDS:
        contenders.append(Contender(name, name, cold))
        contenders.append(Contender(f"{name}, warm", name, warm))
    return contenders


#: Largest batch of peers for which larger ones take minutes.
PATIENCE = {"qpth": 256, "cvxpylayers": 256, "Moreau": 256}

CONTENDERS: list[Contender] = [
    *(
        Contender(
            name,
            "daqp",
            peer(make),
            largest=PATIENCE.get(name, BATCHES[-1]),
            fast=False,
            ours=False,
        )
        for name, make in PEERS.items()
    ),
    *_ours(),
]
