"""Figures of a QP show the numbers of its analysis."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.figures import image_of, legend_of, make_mpc, rendered
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.plots import (
    canonical_figure,
    energies_figure,
    forms,
    policy_figure,
    slice_between,
)
from torch_qpmpc.analysis.policy import policy_map
from torch_qpmpc.analysis.prediction_form import canonical_matrix
from torch_qpmpc.analysis.structure import (
    gamma_energies,
    memory_energies,
    nearest_model,
    stage_models,
)

pytestmark = pytest.mark.layout


@pytest.fixture(scope="module")
def mpc() -> QPMPC:
    return make_mpc()


def test_canonical_figure_shows_both_forms_of_C_and_both_predictions(mpc):
    figure = canonical_figure(mpc)
    start, learned = forms(mpc).values()
    canonical, _ = canonical_matrix(learned, stage_models(learned).A)
    expected = [mpc.C.detach(), canonical]
    expected += [torch.cat((form.Phi, form.Gamma), -1) for form in (start, learned)]
    axes = [a for a in figure.axes if a.images]
    for ax, matrix in zip(axes, expected, strict=True):
        assert np.array_equal(image_of(ax), matrix.numpy())
    assert f"distance to MPC {nearest_model(learned).residual:.2g}" in axes[3].get_title()
    rendered(figure)


@pytest.mark.parametrize("horizon", [1, 2, 12])
def test_figures_of_any_horizon(horizon):
    mpc = make_mpc(horizon)
    rendered(canonical_figure(mpc))
    rendered(energies_figure(mpc))


def test_energies_figure_shows_shares(mpc):
    figure = energies_figure(mpc)
    left, right = figure.axes
    for i, form in enumerate(forms(mpc).values()):
        energies = gamma_energies(form)
        for axes, shares in ((left, energies / energies.sum()), (right, memory_energies(form))):
            heights = [bar.get_height() for bar in axes.containers[i]]
            assert heights == pytest.approx(shares.clamp(min=1e-12).tolist())
    assert legend_of(left) == legend_of(right) == ["start", "learned"]
    assert right.get_xticklabels()[-1].get_text() == "later\nactions"
    rendered(figure)


def test_a_C_without_canonical_form_shows_the_reason():
    mpc = make_mpc()
    with torch.no_grad():
        mpc.C.zero_()
    for draw in (canonical_figure, energies_figure):
        with pytest.raises(QPError, match="of rank 0 of 16"):
            draw(mpc)


def test_policy_figure_shows_the_map(mpc):
    grid = torch.linspace(-1, 1, 9)
    found = policy_map(mpc, grid, grid[:7], axes=(0, 2))
    figure = policy_figure(found, action=1)
    fields = [found.values, found.actions[..., 1], found.gains[..., 1, :].norm(dim=-1)]
    panels = figure.axes[:4]
    for axes, field in zip(panels, [*fields, found.regions % 20], strict=True):
        (mesh,) = axes.collections
        assert np.array_equal(np.asarray(mesh.get_array()), field.mT.numpy())
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("$s_{1}$", "$s_{3}$")
    assert f"{len(found.active_sets)} regions" in panels[3].get_title()
    rendered(figure)


def test_borders_are_between_regions(mpc):
    grid = torch.linspace(-1, 1, 9)
    found = policy_map(mpc, grid, grid[:7], axes=(0, 2))
    crossings = sum(int((found.regions.diff(dim=axis) != 0).sum()) for axis in (0, 1))
    lines = policy_figure(found).axes[3].lines
    assert sum(int(np.isnan(line.get_xdata()).sum()) for line in lines) == crossings > 0
    vertical = np.asarray(lines[0].get_xdata())[::3]
    assert np.isin(vertical.round(9), ((grid[1:] + grid[:-1]) / 2).numpy().round(9)).all()


def test_states_without_a_solution_are_left_blank():
    mpc = QPMPC.from_model(
        torch.eye(2), torch.eye(2)[:, :1], 2, state_bounds=([-1.0] * 2, [1.0] * 2),
        stage_weight=[1.0, 1.0, 0.0], state_slack=torch.inf, on_failure="mask", solver="daqp",
    )  # fmt: skip
    grid = torch.linspace(-2, 2, 5)
    figure = policy_figure(policy_map(mpc, grid, grid))
    for axes in figure.axes[:4]:
        (mesh,) = axes.collections
        shown = np.ma.masked_invalid(np.asarray(mesh.get_array()))
        assert 0 < shown.count() < shown.size
    rendered(figure)


def test_a_slice_is_as_wide_as_the_starts(mpc):
    starts = torch.zeros(3, mpc.n_x)
    starts[:, 0] = torch.tensor([-2.0, 0.5, 1.0])
    found = slice_between(mpc, starts, points=5)
    assert found.axes == (0, mpc.n_x // 2)
    torch.testing.assert_close(found.x, torch.linspace(-2, 1, 5).double())
    torch.testing.assert_close(found.y, torch.linspace(-1, 1, 5).double())  # that all share
