"""QPMPC under PyTorch's features: meta and fake tensors, dtypes, autocast, modes, copies."""

import copy
import pickle

import pytest
import torch
from torch import Tensor, nn
from torch.func import vmap
from torch.nn.utils import parametrize
from torch.testing import assert_close
from torch.utils.checkpoint import checkpoint

from tests.problems import MIXED, random_mpc, random_states, step
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.qp.solvers import BACKENDS

KINDS = {
    "diagonal": {},
    "block": {"hessian": "block"},
    "tied": {"structure": "tied", "learn": ("H", "C", "q", "b", "w")},
    "mixed": {"structure": "tied", "learn": ("C", "G"), "discount_slack": True, **MIXED},
    "preview": {"n_d": 2, "hessian": "block"},
    "tied preview": {"n_d": 1, "structure": "tied", "learn": ("H", "C", "q", "b", "w")},
}
kinds = pytest.mark.parametrize("kind", KINDS)
S, A = random_states(4), random_states(4, 1, size=0.4)


def known(mpc: QPMPC) -> Tensor:
    """Draw p ``(4, n_p)``: the states S, if no more is known."""
    return random_states(4, mpc.n_p)


def outcome(mpc: QPMPC, s: Tensor, a: Tensor) -> list[Tensor]:
    mpc.zero_grad()
    solution = mpc.solve(s)
    out = [mpc.value(s), mpc.action_value(s, a), mpc.policy(s), solution.sigma]
    (out[0].sum() + out[1].sum()).backward()
    return [x.detach() for x in out] + [p.grad for p in mpc.parameters() if p.grad is not None]


# Meta and fake tensors


@kinds
def test_meta_tensors_have_the_shapes_and_dtypes(kind):
    mpc = random_mpc(0, **KINDS[kind])
    s = known(mpc)
    real = outcome(mpc, s, A)
    meta = outcome(mpc.to("meta"), s.to("meta"), A.to("meta"))
    assert all(x.is_meta for x in meta)
    assert [(x.shape, x.dtype) for x in meta] == [(x.shape, x.dtype) for x in real]


@kinds
@pytest.mark.parametrize("how", ["to_empty", "assign", "reset"])
def test_a_module_comes_back_from_meta(kind, how):
    mpc = random_mpc(0, free=0.0, **KINDS[kind])
    s = known(mpc)
    state, expected = copy.deepcopy(mpc.state_dict()), mpc.value(s).detach()
    if how == "assign":
        mpc.to("meta").load_state_dict(state, assign=True)
    elif how == "to_empty":
        mpc.to("meta").to_empty(device="cpu").load_state_dict(state)
    else:
        mpc.to("meta").to_empty(device="cpu").reset_parameters()
    assert_close(mpc.value(s), expected, rtol=0, atol=0)


@pytest.mark.parametrize("solver", BACKENDS)
def test_the_default_device_is_not_the_solvers(solver):
    mpc, twin = random_mpc(0, solver=solver), random_mpc(0, solver=solver)
    with torch.device("meta"):
        found = outcome(mpc, S, A)
    assert_close(found, outcome(twin, S, A))


# Dtypes, autocast, modes


@kinds
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_autocast_changes_no_number(kind, dtype):
    mpc = random_mpc(0, **KINDS[kind]).to(dtype)
    s, a = known(mpc).to(dtype), A.to(dtype)
    expected = outcome(mpc, s, a)
    mpc.zero_grad()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = [mpc.value(s), mpc.action_value(s, a), mpc.policy(s), mpc.solve(s).sigma]
    (found[0].sum() + found[1].sum()).backward()
    gradients = [p.grad for p in mpc.parameters() if p.grad is not None]
    assert_close([*(x.detach() for x in found), *gradients], expected, rtol=0, atol=0)


@pytest.mark.parametrize("default", [torch.float64, torch.float16, torch.bfloat16])
def test_the_default_dtype_changes_no_number(default):
    expected = outcome(random_mpc(0, state_slack=0.3), S, A)
    try:
        torch.set_default_dtype(default)
        found = outcome(random_mpc(0, state_slack=0.3), S, A)
    finally:
        torch.set_default_dtype(torch.float32)
    assert_close(found, expected, rtol=0, atol=0)


@pytest.mark.parametrize("solver", BACKENDS)
def test_solutions_of_inference_mode_are_differentiable_afterwards(solver):
    mpc, twin = random_mpc(0, solver=solver), random_mpc(0, solver=solver)
    with torch.inference_mode():
        value = mpc.value(S)
    assert value.is_inference()
    assert_close(outcome(mpc, S, A), outcome(twin, S, A))


def test_a_module_of_inference_mode_acts_by_its_own_theta():
    s, start = 0.1 * S, random_mpc(0).policy(0.1 * S).detach()
    with torch.inference_mode():
        mpc = random_mpc(0)
        assert_close(mpc.policy(s[0]), start[0])
        mpc.q.data += 0.5
        expected = mpc.policy(s)[0]
        assert not torch.allclose(expected, start[0])
        for action in (mpc.policy(s[0]), torch.as_tensor(mpc.predict(s[0]))):
            assert_close(action, expected)


def test_no_gradient_is_recorded_where_none_is_needed():
    mpc = random_mpc(0)
    with torch.no_grad():
        assert not mpc.value(S).requires_grad
        assert not mpc.policy(S).requires_grad
    mpc.requires_grad_(False)
    assert not mpc.value(S).requires_grad
    assert not mpc.policy(S).requires_grad
    assert mpc.value(S.clone().requires_grad_()).requires_grad


@pytest.mark.parametrize("output", ["value", "policy"])
def test_checkpointing_gives_the_same_gradient(output):
    """PyTorch's checkpoints let a backward read what it saved only once."""
    mpc, s = random_mpc(0), S.clone().requires_grad_()
    function = getattr(mpc, output)
    expected = torch.autograd.grad(function(s).sum(), (s, mpc.C))
    found = torch.autograd.grad(checkpoint(function, s, use_reentrant=False).sum(), (s, mpc.C))
    assert_close(found, expected, rtol=0, atol=0)


def test_strided_expanded_and_empty_inputs():
    mpc, values = random_mpc(0), random_mpc(0).value(S)
    assert_close(mpc.value(S.mT.contiguous().mT), values)
    assert_close(mpc.value(S.flip(0)[::2]), values.flip(0)[::2])
    assert_close(mpc.value(S[:1].expand(5, 3, 2).transpose(0, 1)), values[:1].expand(3, 5))
    empty = torch.zeros(3, 0, 2).double().requires_grad_()
    assert vmap(mpc.value)(empty).shape == (3, 0)
    (mpc.value(empty).sum() + mpc.policy(empty).sum()).backward()
    assert empty.grad is not None
    assert all((part.grad == 0).all() for part in mpc.parameters() if part.grad is not None)


# Copies


def test_a_shallow_copy_shares_the_parameters():
    mpc = random_mpc(0)
    twin = copy.copy(mpc)
    assert [id(part) for part in twin.parameters()] == [id(part) for part in mpc.parameters()]
    step(twin, rate=0.1)
    assert_close(twin.value(S), mpc.value(S), rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["tied", "mixed", "tied preview"])
def test_a_release_leaves_the_copies_as_they_are(kind):
    mpc = random_mpc(0, **KINDS[kind])
    s = known(mpc)
    twin, before = copy.deepcopy(mpc), mpc.value(s).detach()
    mpc.release()
    assert_close(twin.value(s), before, rtol=0, atol=0)
    assert twin.structure == KINDS[kind]["structure"]
    again = random_mpc(1, **KINDS[kind])
    with pytest.raises(QPError, match="a state_dict with structure = 'free'"):
        again.load_state_dict(mpc.state_dict())
    again.release()
    again.load_state_dict(mpc.state_dict())
    assert_close(again.value(s), before)


class Doubled(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return 2 * x


def test_a_parametrization_of_ones_own():
    mpc, twin = random_mpc(0), random_mpc(0)
    parametrize.register_parametrization(mpc, "C", Doubled(), unsafe=True)
    with torch.no_grad():
        twin.C.mul_(2)
    assert_close(mpc.value(S), twin.value(S))
    assert_close(copy.deepcopy(mpc).value(S), twin.value(S))
    with pytest.raises(QPError, match="pickle: got a parametrization of C that is not QPMPC's own"):
        pickle.dumps(mpc)
    parametrize.remove_parametrizations(mpc, "C")
    assert_close(pickle.loads(pickle.dumps(mpc)).value(S), twin.value(S))
