"""A tensor that requires grad is differentiated or refused by its name, at every public door."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_qpmpc as qm
from tests.logs import arx_log, room
from tests.problems import central_difference
from torch_qpmpc import QPError
from torch_qpmpc.analysis.plots import episode_figure, plans_along
from torch_qpmpc.analysis.policy import local_gain, spectral_radius
from torch_qpmpc.analysis.report import read
from torch_qpmpc.analysis.structure import prediction_form, second_moment
from torch_qpmpc.learning.gate import PairedTest
from torch_qpmpc.mpc.projections import nearest_psd, nearest_psd_by_sdp
from torch_qpmpc.mpc.riccati import lqr_gain
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten
from torch_qpmpc.proofs.plant import Plant, Polytope

A, B, E = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], [[0.1], [0.0]]
COST: Any = {"stage_weight": [1.0, 0.1, 0.01], "action_bounds": ([-1.0], [1.0])}
S = torch.tensor([[1.0, 0.5]]).double()
GAIN = torch.tensor(B).double(), torch.tensor([[0.3, 0.2]]).double()


@functools.cache
def scheme() -> qm.QPMPC:
    return qm.QPMPC.from_model(A, B, 5, solver="daqp", **COST)


@functools.cache
def linear(**options: Any) -> qm.LinearMPC:
    return qm.LinearMPC((A, B), 5, Q=(1.0, 0.2), R=0.1, dR=0.1, E=((0.1,), (0.0,)), **options)


@functools.cache
def target() -> Any:
    return linear().target(r=[0.3, 0.0], known=[[0.2]] * 6)


def arranged(**changes: Any) -> Tensor:
    known = torch.linspace(0, 1, 6).unsqueeze(-1)
    signals = {"x": [1.0, 0.5], "u_last": [0.1], "known": known} | changes
    return linear().plan.value(linear().arrange(target=target(), **signals))


@functools.cache
def identified() -> Any:
    return qm.identify(room().rename(columns={"T": "y", "q": "u", "T_out": "d"}), 4)


def simulated(**changes: Any) -> Tensor:
    signals = {"u": [[0.1], [0.2], [0.3]], "y": [[1.0]], "d": [[1.0], [2.0], [3.0]]} | changes
    return identified().simulate(**signals)


def steps(key: Any, value: Tensor) -> Any:
    return arx_log(steps=40).set(key, value)


DIFFERENTIATED: dict[str, tuple[Callable[[Tensor], Tensor], Any]] = {
    "value s": (lambda t: scheme().value(t), [[1.0, 0.5]]),
    "policy s": (lambda t: scheme().policy(t), [[0.02, 0.01]]),
    "action_value s": (lambda t: scheme().action_value(t, S[:, :1]), [[1.0, 0.5]]),
    "action_value a": (lambda t: scheme().action_value(S, t), [[0.3]]),
    "solve s": (lambda t: scheme().solve(t).z, [[0.2, 0.1]]),
    "residuals": (lambda t: scheme().value(S, scheme().quadratic_program({"b": t})), [[0.1] * 10]),
    "arrange x": (lambda t: arranged(x=t), [1.0, 0.5]),
    "arrange u_last": (lambda t: arranged(u_last=t), [0.1]),
    "arrange known": (lambda t: arranged(known=t), [[0.1]] * 6),
    "arrange target": (
        lambda t: linear().plan.value(linear().arrange([1.0, 0.5], target()._replace(x=t))),
        [0.3, 0.0],
    ),
    "DeviationPenalty C": (lambda t: qm.DeviationPenalty(scheme())(t), scheme().C_0 + 0.1),
    "target r": (lambda t: linear().target(t).y, [0.3, 0.0]),
    "target known": (lambda t: linear().target([0.3, 0.0], known=t).u, [0.2]),
    "nearest_psd H": (nearest_psd, [[1.0, 2.0], [2.0, 1.0]]),
    "spectral_radius A": (lambda t: spectral_radius(t, *GAIN), A),
    "second_moment s": (lambda t: second_moment(t, S[:, :1]), S + 0.1),
    "prediction_covariance W": (
        lambda t: prediction_covariance(torch.tensor(A).double(), t, 3),
        [[0.2, 0.1], [0.1, 0.3]],
    ),
    "curvature windows": (qm.SystemIdentificationPenalty(1.0).curvature, [[0.3, 0.5]]),
    "SystemIdentificationPenalty C": (
        lambda t: qm.SystemIdentificationPenalty(1.0)(t, torch.ones(4, 17).double()),
        scheme().C_0 + 0.1,
    ),
}


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_a_gradient_is_that_of_finite_differences(name):
    function, start = DIFFERENTIATED[name]
    start = torch.as_tensor(start, dtype=torch.float64).detach()
    leaf = start.clone().requires_grad_()
    weight = torch.randn(function(start).shape, generator=torch.Generator().manual_seed(0)).double()
    (gradient,) = torch.autograd.grad((weight * function(leaf)).sum(), leaf)
    direction = torch.linspace(1, 2, start.numel()).double().reshape(start.shape)
    slope = central_difference(lambda: (weight * function(start)).sum(), start, direction, 1e-5)
    assert (gradient * direction).sum().item() == pytest.approx(slope.item(), rel=1e-4, abs=1e-6)
    assert abs(slope) > 1e-6


def model(**changes: Any) -> Any:
    return qm.QPMPC.from_model(**{"A": A, "B": B, "horizon": 5, **COST, **changes})


def controlled(**changes: Any) -> Any:
    return qm.LinearMPC(**{"model": (A, B), "horizon": 5, "Q": 1.0, **changes})


REFUSED: dict[str, tuple[Callable[[Any], Any], Any]] = {
    **{f"{name}": (lambda t, name=name: model(**{name: t}), x) for name, x in {
        "A": A, "B": B, "E": E, "offset": [0.1, 0.0], "stage_weight": [1.0, 0.1, 0.01],
        "terminal_weight": [1.0, 0.1], "q": [0.0] * 17, "state_slack": [1.0, 1.0],
    }.items()},
    "action_bounds": (lambda t: model(action_bounds=([-1.0], t)), [0.1]),
    "constraints": (lambda t: model(constraints=(t, [-1.0], [1.0])), [[1.0, 0.0, 1.0]]),
    "C": (lambda t: model(C=t), scheme().C_0),
    **{f"{name}": (lambda t, name=name: controlled(**{name: t}), x) for name, x in {
        "Q": [1.0, 0.2], "R": [0.1], "dR": [[0.1]], "E": E, "y_slack": [1.0, 1.0],
    }.items()},
    "model[0]": (lambda t: controlled(model=(t, B)), A),
    "u_bounds, side 1": (lambda t: controlled(u_bounds=(-1.0, t)), [1.0]),
    "stage_weight ": (lambda t: model(stage_weight=[t, 0.1, 0.01]), 1.0),
    "y": (lambda t: qm.Controller(linear()).step(t, [0.3, 0.0], [0.2]), [1.0, 0.5]),
    "r": (lambda t: qm.Controller(linear()).step([1.0, 0.5], t, [0.2]), [0.3, 0.0]),
    "known": (lambda t: qm.Controller(linear()).step([1.0, 0.5], [0.3, 0.0], t), [0.2]),
    "u ": (lambda t: simulated(u=t), [[0.1], [0.2], [0.3]]),
    "y ": (lambda t: simulated(y=t), [[1.0]]),
    "d": (lambda t: simulated(d=t), [[1.0], [2.0], [3.0]]),
    "u": (lambda t: qm.identify({"y": np.arange(9.0), "u": t}, 2), np.sin(np.arange(9))),
    "T": (lambda t: qm.read_log({"T": t, "q": np.arange(9)}, ["T"], ["q"]), [1.0] * 9),
    "action": (lambda t: qm.identify(steps("action", t), 2, order=0), arx_log()["action"]),
    "reward": (
        lambda t: qm.QPMPC.from_data(steps(("next", "reward"), t), 2), torch.ones(3, 40, 1)
    ),
    "s": (lambda t: local_gain(scheme(), t), [[1.0, 0.5]]),
    "observation": (scheme().predict, [[1.0, 0.5]]),
    "covariances": (lambda t: tighten(model(), t), [[[0.1, 0.0], [0.0, 0.1]]] * 6),
    "K": (lambda t: tighten(model(), torch.zeros(6, 2, 2).double(), K=t), [[0.1, 0.1]]),
    "W": (lambda t: lqr_gain(torch.tensor(A), torch.tensor(B), t), np.eye(3)),
    "H": (nearest_psd_by_sdp, [[1.0, 2.0], [2.0, 1.0]]),
    "C ": (lambda t: prediction_form(t, 2, 1), scheme().C_0),
    "at": (lambda t: read(scheme(), at=t), [0.1, 0.2]),
    "true_model": (lambda t: read(scheme(), (t, torch.tensor(B))), A),
    "p": (lambda t: plans_along(scheme(), t), [[1.0, 0.5]]),
    "times": (lambda t: episode_figure(t, S[:, :1].expand(3, 1), S[:, :1].expand(2, 1)), [0, 1, 2]),
    "signals": (
        lambda t: episode_figure(
            torch.arange(3.0), S[:, :1].expand(3, 1), S[:, :1].expand(2, 1), signals={"d": t}
        ), [0, 1, 2]
    ),
    "differences": (PairedTest().add, [0.1]),
    "target": (lambda t: qm.GaussNewton(model(learn=["q"])).step(S, S[:, :1], t), [1.0]),
    "lower": (lambda t: Polytope.box(t, [1.0]), [0.0]),
    "b": (lambda t: Polytope.of([[1.0], [-1.0]], t), [1.0, 1.0]),
    "B ": (lambda t: Plant.of(A, t), B),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_gradient_that_would_be_lost_is_refused(name):
    function, start = REFUSED[name]
    leaf = torch.as_tensor(start, dtype=torch.float64).detach().clone().requires_grad_()
    name = name.strip()
    with pytest.raises(QPError) as caught:
        function(leaf)
    assert str(caught.value).startswith(
        f"{name}: got a tensor that requires grad, expected one without. Pass {name}.detach()"
    )
    with torch.no_grad():  # nothing is to be differentiated
        function(leaf)
