"""A scheme describes a QPMPC: the short ways make one, and copies and identities follow from it."""

import copy
import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.problems import MIXED
from tests.refused import refused
from torch_qpmpc import QPMPC, Bounds, Cost, Layout, Model, Scheme

A, B = torch.tensor([[1.0, 0.1], [0.0, 0.9]]).double(), torch.tensor([[0.0], [0.1]]).double()
W = torch.diag(torch.tensor([1.0, 0.5, 0.1])).double()
BOX = {"state_bounds": ([-5.0, -1.0], [5.0, 1.0]), "action_bounds": ([-1.0], [1.0])}


def make(**changes: Any) -> Scheme:
    model = Model(A, B, offset=[0.1, 0.0])
    cost, bounds = Cost(W, hessian="block"), Bounds(**BOX, **MIXED)
    return replace(Scheme(model.layout(4), model, cost, bounds), **changes)


def same(one: QPMPC, other: QPMPC) -> None:
    mine, theirs = one.state_dict(), other.state_dict()
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine), "the identity, too"


def test_the_short_way_is_the_same():
    options = {"stage_weight": W, "hessian": "block", "offset": [0.1, 0.0], **BOX, **MIXED}
    short = QPMPC.from_model(A, B, 4, structure="tied", learn=["C", "G"], **options)
    same(QPMPC(make(), structure="tied", learn=["C", "G"]), short)
    same(QPMPC(short.scheme, structure="tied", learn=["C", "G"]), short)


def test_a_predictor_takes_the_place_of_the_models_C_and_b():
    generator = torch.Generator().manual_seed(0)
    C, b = (torch.randn(*shape, generator=generator).double() for shape in ((8, 14), (8,)))
    mpc = QPMPC(make(model=Model(A, B, C=C, b=b)))
    assert torch.equal(mpc.C, C)
    assert torch.equal(mpc.b, b)
    assert torch.equal(mpc.C_0, QPMPC(make()).C_0)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_have_the_same_fields_and_theta(copied):
    scheme = make(gamma=0.7)
    twin = copied(scheme)
    assert (twin.layout, twin.gamma) == (scheme.layout, scheme.gamma)
    assert all(torch.equal(twin.theta[name], x) for name, x in scheme.theta.items())
    assert not copied(Scheme(Layout(2, 1, 3, n_d=1))).is_complete


@refused(
    (lambda: make(gamma=0.0), r"gamma: got 0.0, expected a discount factor in \(0, 1\]"),
    (
        lambda: QPMPC(make(cost=Cost())),
        r"stage_weight: got none, expected a weight of .* such as stage_weight=\[1.0, 1.0, 0.1\]",
    ),
    (lambda: QPMPC(make(model=Model())), r"A, B: got None, expected the model x\+ = A x \+ B u, m"),
    (lambda: make(layout=(2, 1, 4)), "layout: got tuple, expected a Layout"),
    (lambda: QPMPC((2, 1, 3)), "scheme: got tuple, expected a Scheme. QPMPC.from_model takes"),  # pyright: ignore[reportArgumentType] - the mistake
)
def test_bad_arguments_are_named(make_it):
    make_it()
