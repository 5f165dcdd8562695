"""Figures of a QP are drawn, with finite numbers and labels."""

from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.figures import image_of, legend_of, make_mpc, rendered
from tests.problems import drawn_mpc, normal
from tests.refused import refused
from torch_qpmpc.analysis.plots import canonical_figure, episode_figure, plans_along
from torch_qpmpc.analysis.structure import nearest_model, predictions

pytestmark = pytest.mark.layout

T, N_Y, N_U = 6, 2, 1
TIMES, Y, U = 0.25 * torch.arange(T + 1), normal(T + 1, N_Y), normal(T, N_U, seed=1)
LOWER, UPPER = torch.tensor([-1.0, -torch.inf]), torch.stack((Y[:, 0].double() + 1, Y[:, 1]), -1)


def test_the_canonical_figure():
    mpc = make_mpc()
    figure = canonical_figure(mpc)
    axes = [a for a in figure.axes if a.images]
    assert len(axes) == 4
    assert all(np.isfinite(image_of(ax)).all() for ax in axes)
    distance = nearest_model(predictions(mpc)).residual
    assert f"distance to MPC {distance:.2g}" in axes[3].get_title()
    rendered(figure)


def test_an_episode_has_a_panel_for_each_signal():
    known = {"price": normal(T, seed=2), "outdoor": normal(T + 4, seed=3)}
    references = normal(T + 1, N_Y, seed=4)
    x, u = normal(4, N_Y, seed=5), normal(3, N_U, seed=6)
    figure = episode_figure(
        TIMES, Y, U, signals=known, band=(LOWER, UPPER), references=references, plans={2: (x, u)},
        outputs=["room", "wall"], actions=["heating"], xlabel="hour",
    )  # fmt: skip
    assert [axes.get_ylabel() for axes in figure.axes] == ["room", "wall", "heating", *known]
    assert figure.axes[-1].get_xlabel() == "hour"
    assert legend_of(figure.axes[0]) == ["band", "reference", "realised", "planned"]
    assert np.allclose(figure.axes[0].lines[4].get_xdata(), [0.5, 0.75, 1.0, 1.25])
    rendered(figure)
    plain = episode_figure(TIMES, Y, U)
    assert [axes.get_ylabel() for axes in plain.axes] == ["$y_{1}$", "$y_{2}$", "$u_{1}$"]
    rendered(plain)


def test_plans_are_those_of_the_qp():
    mpc = drawn_mpc(N_Y, N_U, 3, n_d=1, solver="daqp")
    p = normal(T, mpc.n_p)
    plans = plans_along(mpc, p, every=4)
    assert [*plans] == [0, 4]
    for k, plan in plans.items():
        assert_close(plan, mpc.predicted(mpc.solve(p[k]).z.detach()))


@refused(
    ({"y": Y[1:]}, r"y: got shape \(6, 2\), expected shape \(7, n_y\)"),
    ({"u": Y}, r"u: got shape \(7, 2\), expected shape \(6, n_u\)"),
)
def test_what_does_not_fit_is_named(options):
    arguments: dict[str, Any] = {"times": TIMES, "y": Y, "u": U}
    episode_figure(**(arguments | options))
