"""Entries of theta that ``learn={"C": mask}`` keeps fixed."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.gauss_newton import Reference
from tests.mpc.settings import rows
from tests.problems import random_mpc, random_states
from tests.refused import refused
from tests.transitions import make_batch, make_loss
from torch_qpmpc.learning.penalties import Penalties
from torch_qpmpc.learning.updates import first_order

HORIZON, N_Z = 3, 11


def entries() -> Tensor:
    """Make a mask with a different pattern in each row."""
    generator = torch.Generator().manual_seed(3)
    return torch.rand(2 * HORIZON, N_Z, generator=generator) < 0.6


MASKS = {"rows": rows, "entries": entries}


def masked(mask: Any, **options: Any) -> qm.QPMPC:
    return random_mpc(
        1, free=0.0, horizon=HORIZON, learn={"H": True, "c": True, "C": mask}, **options
    )


def targets(mpc: qm.QPMPC) -> tuple[Tensor, Tensor, Tensor]:
    s, a = random_states(24), random_states(24, 1, size=0.4)
    return s, a, mpc.action_value(s, a).detach() + random_states(24, 1, seed=4).squeeze(-1)


def moves(mpc: qm.QPMPC, C: Tensor, mask: Tensor) -> None:
    moved = mpc.C.detach() != C
    assert not moved[~mask].any()
    assert moved[mask].float().mean() > 0.5


@pytest.mark.parametrize("kind", MASKS)
def test_a_gauss_newton_step_is_that_in_the_learned_entries_alone(kind):
    mask = MASKS[kind]()
    mpc = masked(mask)
    s, a, target = targets(mpc)
    optimizer = qm.GaussNewton(mpc, damping=0.1)
    reference = Reference(mpc, optimizer)
    before, expected = reference.theta(), reference.step(s, a, target)
    C = mpc.C.detach().clone()
    assert optimizer.step(s, a, target).accepted
    assert_close(reference.theta() - before, expected, rtol=1e-5, atol=1e-9)
    moves(mpc, C, mask)
    S = qm.SystemIdentificationPenalty(1e-2).curvature(random_states(20, N_Z))
    with pytest.raises(
        qm.QPError, match="penalty: got a C that is tied, masked or frozen, expected"
    ):
        optimizer.step(s, a, target, penalty=S)


def test_the_proximal_step_of_an_update_leaves_frozen_entries():
    mask = rows()
    mpc = masked(mask, action_slack=10.0)
    with torch.no_grad():
        mpc.leaves("C")[0].add_(0.3)
    loss = make_loss(operator=qm.QPActorValueOperator(mpc))
    groups = mpc.parameter_groups({"cost": 0.0, "constraints": 0.0})
    penalty = qm.DeviationPenalty(mpc, c_1=0.1, c_2=0.1, c_3=0.1)
    update = first_order(mpc, loss, torch.optim.SGD(groups, lr=0.0), Penalties(penalty))
    C = mpc.C.detach().clone()
    update(make_batch(4), None)
    moves(mpc, C, mask)
    assert_close(mpc.C[mask].detach(), C[mask] - 0.1)


def test_a_tied_model_with_a_known_row():
    """x_1 integrates x_2 in every stage, so its row of A and B is known."""
    A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]
    learn = {"C": rows().logical_not(), "H": True}
    options = {"structure": "tied", "learn": learn, "solver": "daqp"}
    mpc = qm.QPMPC.from_model(A, B, HORIZON, stage_weight=[1.0] * 3, **options)
    optimizer = torch.optim.AdamW(mpc.parameters(), lr=0.01, weight_decay=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        mpc.value(random_states(8)).sum().backward()
        optimizer.step()
    learned = mpc.model()
    for matrix, start in zip(learned, (A, B), strict=True):
        start = torch.tensor(start).double()
        assert_close(matrix[0], start[0])
        assert not torch.equal(matrix[1].detach(), start[1])
    values = mpc.value(random_states(8))
    mpc.release()
    assert_close(mpc.value(random_states(8)), values)
    frozen = mpc.C[~learn["C"]].detach().clone()
    torch.optim.AdamW(mpc.parameters(), lr=0.1, weight_decay=1.0).step()
    assert torch.equal(mpc.C[~learn["C"]].detach(), frozen)


@pytest.mark.parametrize("part", ["H", "H_f", "q", "C", "b", "lb", "w"])
def test_no_optimiser_moves_frozen_entries(part):
    value = getattr(random_mpc(2, learn=(part,)), part).detach()
    mask = torch.arange(value.numel()).reshape(value.shape) % 2 == 0
    mpc = random_mpc(2, learn={part: mask.tolist()}, free=0.0)
    start = getattr(mpc, part).detach().clone()
    optimizer = torch.optim.SGD(mpc.parameters(), lr=0.1, weight_decay=0.5)
    mpc.value(random_states(16)).sum().backward()
    optimizer.step()
    assert torch.equal(getattr(mpc, part)[~mask].detach(), start[~mask])
    assert not torch.equal(getattr(mpc, part)[mask].detach(), start[mask])


@refused(
    ({"learn": {"C": rows()[:2]}}, r"learn\['C'\]: got torch.bool of shape \(2, 11\), expected"),
    ({"learn": {"H": False}}, r"learn\['H'\]: got torch.bool of shape \(\), expected True"),
    ({"learn": {"C": "rows"}}, r"learn\['C'\]: got 'rows', expected True, or a mask of bools"),
    ({"learn": {"D": True}}, "learn: got .*'D'.*, expected a collection of names among"),
    (
        {"learn": {"H": torch.eye(3).bool()}, "hessian": "block"},
        r"learn\['H'\]: got a mask of a dense H, expected True, or a mask with hessian",
    ),
    (
        {"learn": {"C": torch.arange(66).reshape(6, 11) > 30}, "structure": "tied"},
        r"learn\['C'\]: got a mask that differs between stages, expected one that is the same",
    ),
    (
        {"learn": {"lb": torch.arange(11) > 4}, "structure": "tied"},
        r"learn\['lb'\]: got a mask that differs between stages",
    ),
)
def test_masks_that_do_not_fit_are_named(options):
    random_mpc(0, horizon=HORIZON, free=0.0, **options)


# State dicts of other settings


OTHERS = {
    "n_d": {"n_d": 1},
    "gamma": {"gamma": 0.5},
    "discount_slack": {"discount_slack": True},
    "structure": {"structure": "tied"},
    "hessian": {"hessian": "block"},
    "step": {"step": "projection"},
    "horizon": {"horizon": 4},
    "learn": {"learn": ("H", "C")},
    "n_mixed": {"constraints": ([[1.0, 1.0, 0.0]], [-1.0], [1.0])},
    "n_terminal": {"terminal_constraints": ([[1.0, 1.0]], [-1.0], [1.0])},
    "hard rows": {"state_slack": [torch.inf, 100.0]},
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_state_dict_of_another_qpmpc_is_refused_by_name(name):
    mpc = random_mpc(0)
    before = mpc.value(random_states(4)).detach()
    other = random_mpc(0, **OTHERS[name])
    message = f"state_dict: got a state_dict with {name} = .*, expected this module's"
    with pytest.raises(qm.QPError, match=message):
        mpc.load_state_dict(other.state_dict())
    assert torch.equal(mpc.value(random_states(4)), before)


def test_a_state_dict_of_other_frozen_entries_is_refused():
    with pytest.raises(qm.QPError, match=r"state_dict with learn = .*'C': '33 of 66"):
        masked(entries()).load_state_dict(masked(rows()).state_dict())


def test_arguments_are_kept_by_value():
    A, mask = np.array([[1.0, 0.1], [0.0, 0.9]]), rows()
    options = {"learn": {"C": mask}, "stage_weight": [1.0, 1.0, 0.1]}
    mpc = qm.QPMPC.from_model(A, [[0.0], [0.1]], HORIZON, **options)
    start = mpc.C.detach().clone()
    A *= 2
    mask.logical_not_()
    options["learn"].clear()
    mpc.reset_parameters()
    assert torch.equal(mpc.C, start)
    assert torch.equal(pickle.loads(pickle.dumps(mpc)).C, start)


@refused(
    (None, "state_dict: got an _extra_state that cannot be read .*, expected one that QPMPC wrote"),
    (torch.zeros(3), "state_dict: got an _extra_state that cannot be read"),
    (torch.tensor([91, 93]), "state_dict: got an _extra_state that cannot be read"),
)
def test_an_identity_that_cannot_be_read_is_named(junk):
    mpc = random_mpc(0)
    mpc.load_state_dict(mpc.state_dict() | {"_extra_state": junk})


@pytest.mark.parametrize("convert", [lambda x: x.double(), lambda x: x.float() + 1e-3])
def test_a_converted_state_dict_is_loaded(convert):
    mpc = random_mpc(0)
    state = mpc.state_dict()
    state["_extra_state"] = convert(state["_extra_state"])
    mpc.load_state_dict(state)
    with pytest.raises(qm.QPError, match=r"state_dict: got a state_dict with gamma = 0\.9"):
        random_mpc(0, gamma=0.5).load_state_dict(state)


def test_the_state_of_another_qpmpcs_loss_is_refused():
    def loss(**options: Any) -> qm.QPQLearningLoss:
        return make_loss(operator=qm.QPActorValueOperator(random_mpc(0, **options)))

    state = loss().state_dict()
    loss().load_state_dict(state)
    for name in ("gamma", "hard rows", "discount_slack"):
        with pytest.raises(qm.QPError, match=f"state_dict with {name} = "):
            loss(**OTHERS[name]).load_state_dict(state)
    older = {name: x for name, x in state.items() if name != "_extra_state"}
    loss().load_state_dict(older)


def test_a_masked_C_is_not_tied():
    mpc = masked(rows())
    penalty = qm.DeviationPenalty(mpc)
    with pytest.raises(qm.QPError, match=r"pass mpc.leaves\('C'\)\[0\]"):
        penalty.proximal_step_(mpc.C)
    with pytest.raises(
        qm.QPError, match="part: got 'b', expected one of the learned parts: H, c, C"
    ):
        mpc.leaves("b")


COPIED = "GaussNewton: got a copy or a pickle, expected its state_dict. Make a GaussNewton"


@refused(*((copied, COPIED) for copied in (copy.copy, copy.deepcopy, pickle.dumps)))
def test_a_gauss_newton_is_not_copied_without_its_qpmpc(copied):
    copied(qm.GaussNewton(random_mpc(0)))


def test_a_gauss_newton_step_with_everything_frozen_moves_nothing():
    mpc = random_mpc(0)
    s, a, target = targets(mpc)
    mpc.requires_grad_(False)
    before = mpc.C.clone()
    qm.GaussNewton(mpc).step(s, a, target)
    assert torch.equal(mpc.C, before)
