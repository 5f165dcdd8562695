"""The figure of an episode shows what was known, done and planned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.figures import legend_of, rendered
from tests.problems import normal
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.episode import episode_figure, plans_along

pytestmark = pytest.mark.layout

T, N_Y, N_U = 6, 2, 1
TIMES, Y, U = 0.25 * torch.arange(T + 1), normal(T + 1, N_Y), normal(T, N_U, seed=1)
LOWER, UPPER = torch.tensor([-1.0, -torch.inf]), torch.stack((Y[:, 0].double() + 1, Y[:, 1]), -1)


def test_panels_show_the_data():
    known = {"price": normal(T, seed=2), "outdoor": normal(T + 4, seed=3)}
    references = normal(T + 1, N_Y, seed=4)
    x, u = normal(4, N_Y, seed=5), normal(3, N_U, seed=6)
    figure = episode_figure(
        TIMES, Y, U, signals=known, band=(LOWER, UPPER), references=references, plans={2: (x, u)},
        outputs=["room", "wall"], actions=["heating"], xlabel="hour",
    )  # fmt: skip
    names = ["room", "wall", "heating", *known]
    assert [axes.get_ylabel() for axes in figure.axes] == names
    assert figure.axes[-1].get_xlabel() == "hour"
    assert legend_of(figure.axes[0]) == ["band", "reference", "realised", "planned"]
    for i, axes in enumerate(figure.axes[:N_Y]):
        lower, upper, reference, real, plan, *_ = (line.get_ydata() for line in axes.lines)
        assert np.array_equal(upper, UPPER[:, i])
        assert np.array_equal(lower, np.full(T + 1, [-1.0, np.nan][i]), equal_nan=True)
        assert np.array_equal(reference, references[:, i])
        assert np.array_equal(real, Y[:, i])
        assert np.array_equal(plan, x[:, i])
        assert np.allclose(axes.lines[4].get_xdata(), [0.5, 0.75, 1.0, 1.25])
    heating, plan = (line.get_ydata() for line in figure.axes[2].lines)
    assert np.array_equal(heating, [*U[:, 0], U[-1, 0]])
    assert np.array_equal(plan, [*u[:, 0], u[-1, 0]])
    price, outdoor = (axes.lines[0].get_ydata() for axes in figure.axes[3:])
    assert np.array_equal(price, [*known["price"], known["price"][-1]])
    assert np.array_equal(outdoor, known["outdoor"][: T + 1])
    rendered(figure)


def test_only_outputs_and_actions_are_needed():
    figure = episode_figure(TIMES, Y, U)
    assert [axes.get_ylabel() for axes in figure.axes] == ["$y_{1}$", "$y_{2}$", "$u_{1}$"]
    assert legend_of(figure.axes[0]) == ["realised"]
    rendered(figure)


def test_plans_are_those_of_the_qp():
    mpc = QPMPC.of(N_Y, N_U, 3, past=2, n_d=1, solver="daqp")
    p = normal(T, mpc.n_p)
    plans = plans_along(mpc, p, every=4)
    assert [*plans] == [0, 4]
    for k, plan in plans.items():
        assert_close(plan, mpc.predicted(mpc.solve(p[k]).z.detach()))
    rendered(episode_figure(TIMES, Y, U, plans=plans))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"y": Y[1:]}, r"y: got shape \(6, 2\), expected shape \(7, n_y\)"),
        ({"u": Y}, r"u: got shape \(7, 2\), expected shape \(6, n_u\)"),
        ({"references": Y[:, :1]}, r"references: got shape \(7, 1\), expected shape \(7, 2\)"),
        ({"signals": {"price": Y[:3, 0]}}, r"signals\['price'\]: got .*, expected at least 6"),
        ({"band": (LOWER, UPPER[1:])}, r"band, upper: got .*, expected shape \(2,\) or \(7, 2\)"),
        ({"outputs": ["room"]}, r"outputs: got \['room'\], expected 2 names"),
        ({"actions": "u"}, "actions: got 'u', expected 1 names"),
    ],
)
def test_what_does_not_fit_is_named(options, message):
    arguments: dict[str, Any] = {"times": TIMES, "y": Y, "u": U}
    with pytest.raises(QPError, match=message):
        episode_figure(**(arguments | options))


def test_rounding_errors_do_not_fill_a_panel():
    y, u = torch.linspace(0, 1, 5).unsqueeze(-1), 1e-13 * torch.randn(4, 1)
    _, panel = episode_figure(torch.arange(5.0), y, u).axes
    low, high = panel.get_ylim()
    assert 1 < high - low < 1.1
