"""The anchor of C at an identified model."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.problems import normal
from torch_qpmpc import Identified, QPError, identify
from torch_qpmpc.learning.anchor import Anchor

HORIZON, STEPS, NOISE = 3, 400, 0.1


def found(steps: int = STEPS, noise: float = NOISE, horizon: int = HORIZON) -> Identified:
    """Identify y+ = 0.8 y + [1, 0.5] u + e, of which the second action hardly moves."""
    u = normal(steps, 2) * torch.tensor([1.0, 1e-2]).double()
    e, y = noise * normal(steps, seed=1), torch.zeros(steps + 1, 1).double()
    for t in range(steps):
        y[t + 1] = 0.8 * y[t] + u[t] @ torch.tensor([1.0, 0.5]).double() + 3.0 + e[t]
    log = {"observation": y[:-1], "action": u, "next": {"observation": y[1:]}}
    return identify(TensorDict(log, [steps]), horizon=horizon)


def test_it_is_the_curvature_of_the_log_likelihood():
    identified = found()
    anchor, (C, b) = Anchor.of(identified), identified.constraints
    (log,) = identified.data
    tau = torch.stack(
        [
            torch.cat([log.y[t], *[torch.cat((log.u[t + k], log.y[t + k + 1])) for k in range(3)]])
            for t in range(STEPS - HORIZON)
        ]
    )
    assert_close(anchor.S, tau.mT @ tau)
    variance = (tau @ C.mT - b).square().mean()
    assert variance.item() == pytest.approx(NOISE**2, rel=0.2)
    assert_close(anchor.weights, (1 / variance).repeat(HORIZON))
    assert_close(anchor.C_0, C)


def test_what_the_log_determines_is_held():
    anchor = Anchor.of(found())
    held = anchor.weights[0] * anchor.S.diagonal()
    assert held[2] < 1e-3 * held[1]  # the second action is hardly excited


def test_a_learned_b_takes_up_the_mean():
    """A change of C by the mean output of the log is as likely as before, with another b."""
    identified = found()
    shift = torch.zeros_like(identified.constraints.C)
    shift[0, 0] = 1.0
    fixed, free = (
        Anchor.of(identified, b_learned=learned).value(identified.constraints.C + shift)
        for learned in (False, True)
    )
    (log,) = identified.data
    y = log.y[: STEPS - HORIZON]
    assert_close(fixed / free, (y.square().mean() / y.var(correction=0)))


def test_its_gradient_is_that_of_its_value():
    anchor = Anchor.of(found(), beta=1e-3).times(0.5)
    C = (anchor.C_0 + 0.1 * normal(*anchor.C_0.shape)).requires_grad_()
    assert anchor.value(anchor.C_0) == 0
    assert torch.autograd.gradcheck(anchor.value, C)
    (gradient,) = torch.autograd.grad(anchor.value(C), C)
    assert_close(gradient, anchor.gradient(C.detach()))


def test_a_log_without_noise_has_finite_weights():
    anchor = Anchor.of(found(noise=0.0))
    assert anchor.weights.isfinite().all()
    assert anchor.weights.max() > 1e5


def test_bad_arguments_are_named():
    identified = found(steps=30)
    for beta in (0.0, -1.0, torch.inf):
        with pytest.raises(QPError, match=r"beta: got .*, expected a finite number > 0"):
            Anchor.of(identified, beta)
    short = found(steps=12, horizon=12)
    message = "identified: got trajectories of at most 12 steps, expected at least 13 steps. Coll"
    with pytest.raises(QPError, match=message):
        Anchor.of(short)
