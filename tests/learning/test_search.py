from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import random_mpc
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.learning.search import KNOBS, PARTS, _set, available, search


def scheme(**options: Any) -> QPMPC:
    bounds: dict[str, Any] = {
        "state_bounds": ([-2.0, -3.0], [2.0, 3.0]),
        "action_bounds": ([-1.0], [1.0]),
    }
    dense = options.get("hessian", "diagonal") != "diagonal"
    weight = torch.tensor([2.0, 1.0, 0.5]).double()
    weights: dict[str, Any] = {"stage_weight": weight.diag() if dense else weight}
    return QPMPC(2, 1, 3, **{**bounds, **weights, **options})


def values(mpc: QPMPC) -> dict[str, Tensor]:
    return {part: getattr(mpc, part).detach().clone() for part in PARTS}


@pytest.mark.parametrize("hessian", ["diagonal", "block"])
@pytest.mark.parametrize("learn", [("H", "c", "C"), ("H", "H_f", "q", "b", "lb", "ub", "w")])
@pytest.mark.parametrize("name", KNOBS)
def test_a_scalar_moves_its_part_alone(name, learn, hessian):
    mpc = scheme(learn=learn, hessian=hessian)
    before = values(mpc)
    _set(mpc, before, {name: 0.3})
    after = values(mpc)
    moved = {part for part in PARTS if not torch.equal(before[part], after[part])}
    _set(mpc, before, {name: 0.0})
    back = values(mpc)
    for part in PARTS:
        assert_close(back[part], before[part])
    bounds = {"lb", "ub"}
    parts = {"margin": bounds, "H_u": {"H"}, "q_f": {"q"}}
    assert moved >= parts.get(name, {name})
    unchanged = set(PARTS) - parts.get(name, {name})
    for part in unchanged:  # up to the rounding of a factor of H
        assert_close(after[part], before[part])


def test_a_margin_tightens_soft_rows_alone():
    mpc = scheme()
    before = values(mpc)
    _set(mpc, before, {"margin": 0.1})
    soft = mpc.soft
    assert_close(mpc.lb[soft], before["lb"][soft] + 0.1)
    assert_close(mpc.ub[soft], before["ub"][soft] - 0.1)
    assert_close(mpc.lb[~soft], before["lb"][~soft])


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        ({"structure": "tied", "learn": ("C", "lb")}, set()),
        ({"structure": "tied", "learn": ("C",)}, set()),
        ({"hessian": "full"}, {"H_u", "H_f"}),
        ({"state_slack": math.inf}, {"margin", "w"}),
    ],
)
def test_scalars_that_a_QP_lacks_are_refused(options, missing):
    mpc = scheme(**options)
    assert {*available(mpc)} == {*KNOBS} - missing
    for name in missing:
        message = rf"knobs: got \['{name}'\], expected names among those of this QP"
        with pytest.raises(QPError, match=message):
            search(mpc, lambda mpc, seed: torch.ones(1), {name: 1.0})


def test_factors_of_weights():
    W = torch.tensor([[2.0, 0.5, 0.2], [0.5, 1.0, 0.1], [0.2, 0.1, 3.0]]).double()
    mpc = scheme(hessian="block", stage_weight=W)
    before = values(mpc)
    _set(mpc, before, {"H_u": math.log(4.0)})
    expected = W.clone()
    expected[2] *= 2
    expected[:, 2] *= 2
    assert_close(mpc.H.detach(), expected)
    _set(mpc, before, {"H_f": math.log(3.0), "w": math.log(2.0)})
    assert_close(mpc.H_f.detach(), 3 * before["H_f"])
    assert_close(mpc.w.detach(), 2 * before["w"])


def test_the_search_finds_the_minimum():
    mpc = random_mpc(0)
    start = values(mpc)

    def costs(mpc: QPMPC, seed: int) -> Tensor:
        noise = torch.randn(8, generator=torch.Generator().manual_seed(seed)).double()
        offset = (mpc.b - start["b"]).mean().detach() - 0.3
        weight = (mpc.H_f.sum() / start["H_f"].sum()).log().detach() + 0.5
        return offset**2 + weight**2 + noise

    found = search(mpc, costs, {"b": 0.5, "H_f": 0.5}, loops=150, seed=3)
    assert found["b"] == pytest.approx(0.3, abs=0.02)
    assert found["H_f"] == pytest.approx(-0.5, abs=0.02)
    assert_close(mpc.b.detach(), start["b"] + found["b"])


def test_candidates_of_a_generation_share_the_disturbances():
    seeds = []

    def costs(mpc: QPMPC, seed: int) -> Tensor:
        seeds.append(seed)
        return mpc.b.detach().square()

    search(random_mpc(0), costs, {"b": 1.0}, loops=12)
    assert len(seeds) == 12
    assert len(set(seeds)) == 2


def test_policies_that_fail_are_not_chosen():
    mpc = random_mpc(0)
    start = mpc.b.detach().clone()

    def costs(mpc: QPMPC, seed: int) -> Tensor:
        offset = (mpc.b - start).mean().detach()
        return torch.where(offset > 0, torch.nan, 1 + offset).reshape(1)

    assert search(mpc, costs, {"b": 1.0}, loops=30)["b"] < 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"knobs": {}}, "knobs.*none"),
        ({"knobs": {"speed": 1.0}}, "knobs.*speed"),
        ({"knobs": {"b": 0.0}}, r"knobs\[b\]"),
        ({"loops": 0}, "loops"),
        ({"seed": -1}, "seed"),
    ],
)
def test_errors(options, message):
    arguments = {"knobs": {"b": 1.0}} | options
    with pytest.raises(QPError, match=message):
        search(random_mpc(0), lambda mpc, seed: torch.ones(1), **arguments)
