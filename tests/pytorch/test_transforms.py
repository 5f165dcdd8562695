"""`torch.func`: every feature of the QP under vmap, and its derivatives in both modes."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, stack_module_state, vmap
from torch.testing import assert_close

from tests.problems import known_qp, normal, random_mpc, random_states
from tests.qp.test_derivatives import OPERANDS, PARTS, part_of
from tests.refused import refused
from torch_qpmpc import QPMPC

Features = dict[str, Callable[[QPMPC, dict[str, Tensor], Tensor, Tensor], Tensor]]


def call(mpc: QPMPC, theta: dict[str, Tensor], *inputs: Tensor) -> Tensor:
    return functional_call(mpc, theta, inputs)


def policy(mpc: QPMPC, theta: dict[str, Tensor], s: Tensor) -> Tensor:
    with TensorDict(theta).unflatten_keys(".").to_module(mpc):
        return mpc.policy(s)


def dV_ds(mpc: QPMPC, theta: dict[str, Tensor], s: Tensor) -> Tensor:
    return grad(lambda s: call(mpc, theta, s))(s)


def q_loss(mpc: QPMPC, theta: dict[str, Tensor], s: Tensor, a: Tensor) -> Tensor:
    """Return the squared TD error of a transition from (s, a) to -s."""
    target = 1.0 + 0.9 * call(mpc, {name: part.detach() for name, part in theta.items()}, -s)
    return (call(mpc, theta, s, a) - target).square()


#: Functions of one sample, to be batched over theta and samples.
FEATURES: Features = {
    "value": lambda mpc, theta, s, a: call(mpc, theta, s),
    "action value": lambda mpc, theta, s, a: call(mpc, theta, s, a),
    "policy": lambda mpc, theta, s, a: policy(mpc, theta, s),
    "loss": q_loss,
    "loss in theta": lambda mpc, theta, s, a: grad(lambda C: q_loss(mpc, theta | {"C": C}, s, a))(
        theta["C"]
    ),
    "dV/ds": lambda mpc, theta, s, a: dV_ds(mpc, theta, s),
    "dV/ds in theta": lambda mpc, theta, s, a: jacrev(lambda C: dV_ds(mpc, theta | {"C": C}, s))(
        theta["C"]
    ),
    "Hessian in s": lambda mpc, theta, s, a: jacrev(lambda s: dV_ds(mpc, theta, s))(s),
    "policy in s": lambda mpc, theta, s, a: jacrev(lambda s: policy(mpc, theta, s))(s),
}


def ensemble(**options: Any) -> tuple[list[QPMPC], dict[str, Tensor]]:
    mpcs = [random_mpc(seed, **options) for seed in range(3)]
    states = [{name: part.detach() for name, part in mpc.named_parameters()} for mpc in mpcs]
    return mpcs, {name: torch.stack([state[name] for state in states]) for name in states[0]}


@pytest.mark.parametrize("known", [{}, {"n_d": 1}], ids=["state", "preview"])
@pytest.mark.parametrize("name", FEATURES)
def test_vmap_over_theta_and_samples_equals_loops(name, known):
    """Both nestings are batched over theta, over samples, and over both."""
    feature, (mpcs, stacked) = FEATURES[name], ensemble(**known)
    mpc = mpcs[0]
    s, a = random_states(4, mpc.n_p), random_states(4, 1, size=0.4)

    def of_one(theta: dict[str, Tensor], s: Tensor, a: Tensor) -> Tensor:
        return feature(mpc, theta, s, a)

    loops = []
    for k in range(3):
        theta = {part: values[k] for part, values in stacked.items()}
        loops.append(torch.stack([of_one(theta, s[i], a[i]) for i in range(4)]))
    expected = torch.stack(loops)
    over_samples, over_theta = vmap(of_one, (None, 0, 0)), vmap(of_one, (0, None, None))
    assert_close(vmap(over_samples, (0, None, None))(stacked, s, a), expected)
    assert_close(vmap(over_theta, (None, 0, 0), out_dims=1)(stacked, s, a), expected)
    assert expected.abs().max() > 1e-3


def test_stacked_modules_are_those_of_an_ensemble():
    """`stack_module_state` needs modules of one class, as deep copies are."""
    mpcs, s = [random_mpc(0)], random_states(4)
    for seed in (1, 2):
        mpcs.append(copy.deepcopy(mpcs[0]))
        mpcs[-1].load_state_dict(random_mpc(seed).state_dict())
    parameters, buffers = stack_module_state(mpcs)
    skeleton = copy.deepcopy(mpcs[0]).to("meta")

    def of_one(parameters: dict[str, Tensor], buffers: dict[str, Tensor], s: Tensor) -> Tensor:
        return functional_call(skeleton, (parameters, buffers), (s,))

    values = vmap(vmap(of_one, (None, None, 0)), (0, 0, None))(parameters, buffers, s)
    assert_close(values, torch.stack([mpc.value(s) for mpc in mpcs]))
    values.sum().backward()
    for k, mpc in enumerate(mpcs):
        mpc.value(s).sum().backward()
        for name, part in mpc.named_parameters():
            assert_close(parameters[name].grad[k], part.grad)


# Forward mode


@pytest.mark.parametrize("name", OPERANDS)
@pytest.mark.parametrize("part", PARTS)
def test_forward_mode_equals_reverse_mode(part, name):
    kinds = ("inside", "at_lower", "at_upper", "below", "above")
    known = known_qp(1, batch=(3,), soft=kinds, hard=("inside", "at_lower"))
    operands, index = [*known.qp.tensors(), known.fixed], OPERANDS.index(name)
    tangent = normal(*operands[index].shape, seed=index)

    def of_one(operand: Tensor) -> Tensor:
        return part_of([*operands[:index], operand, *operands[index + 1 :]], part)

    out, pushed, *_ = jvp(of_one, (operands[index],), (tangent,))
    weight = normal(*out.shape, seed=4)
    leaf = operands[index].clone().requires_grad_()
    (pulled,) = torch.autograd.grad((of_one(leaf) * weight).sum(), leaf, allow_unused=True)
    pulled = torch.zeros_like(leaf) if pulled is None else pulled
    pulled = torch.where(pulled.isfinite(), pulled, 0)
    assert_close((pushed * weight).sum(), (pulled * tangent).sum(), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("recording", [True, False])
def test_forward_mode_is_not_for_no_grad_to_switch_off(recording):
    mpc, s = random_mpc(1), random_states(4)
    expected = vmap(jacrev(mpc.value))(s).sum(-1)
    with torch.set_grad_enabled(recording), forward_ad.dual_level():
        dual = mpc.value(forward_ad.make_dual(s, torch.ones_like(s)))
        assert_close(forward_ad.unpack_dual(dual).tangent, expected)
    with torch.set_grad_enabled(recording):
        assert_close(vmap(jacfwd(mpc.value))(s), vmap(jacrev(mpc.value))(s))
        assert_close(vmap(jacfwd(mpc.policy))(s), vmap(jacrev(mpc.policy))(s))


def test_an_unsolved_element_has_no_tangent():
    mpc, s = random_mpc(0, on_failure="mask"), random_states(3)
    s[1] = torch.nan
    value, tangent, *_ = jvp(mpc.value, (s,), (torch.ones_like(s),))
    assert value.isinf().tolist() == [False, True, False]
    assert (tangent != 0).tolist() == [True, False, True]
    assert jvp(mpc.policy, (s,), (torch.ones_like(s),))[1].isfinite().all()


@pytest.mark.parametrize(
    "twice",
    [hessian, lambda f: jacrev(jacfwd(f)), lambda f: jacrev(jacrev(f))],
    ids=["jacfwd of jacrev", "jacrev of jacfwd", "jacrev of jacrev"],
)
def test_the_hessian_agrees_with_differences(twice):
    mpc, s = random_mpc(1), random_states(4)
    gradient, step = vmap(grad(mpc.value)), 1e-5
    found = vmap(twice(mpc.value))(s)
    for i, axis in enumerate(torch.eye(2).double()):
        central = (gradient(s + step * axis) - gradient(s - step * axis)) / (2 * step)
        assert_close(found[..., i], central, rtol=1e-5, atol=1e-6)


@refused(
    (lambda mpc: hessian(mpc.policy), "derivative: got the second of the solution"),
    (lambda mpc: jacrev(jacrev(mpc.policy)), "derivative: got the second of the solution"),
    (lambda mpc: hessian(grad(mpc.value)), ".*or the third of the value, expected at most"),
    (lambda mpc: jacfwd(jacfwd(mpc.value)), ".*got jvp in jvp, .* Use hessian, or jacrev inside"),
)
def test_derivatives_that_there_are_not_are_refused(function):
    mpc = random_mpc(1)
    function(mpc)(random_states(1)[0])


def test_a_functional_call_never_reuses_another_thetas_preparation():
    mpc, s = random_mpc(0), random_states(4)
    theta = {name: part.detach().clone() for name, part in mpc.named_parameters()}
    for k in range(6):
        theta["C"][:, 0].add_(0.01)  # in place, unseen by the module
        fresh = random_mpc(0)
        fresh.load_state_dict(mpc.state_dict() | theta)
        assert_close(functional_call(mpc, theta, (s,)), fresh.value(s), rtol=0, atol=0)
        stacked = {name: torch.stack([part, part]) for name, part in theta.items()}
        both = vmap(lambda theta: functional_call(mpc, theta, (s,)))(stacked)
        assert_close(both[k % 2], fresh.value(s))


def test_a_value_kept_from_inside_a_transform_has_its_gradient():
    mpc, states = random_mpc(), random_states(3).requires_grad_()
    theta = {name: p.detach().clone().requires_grad_() for name, p in mpc.named_parameters()}
    kept: list = []

    def loss(theta: dict[str, Tensor], s: Tensor) -> Tensor:
        kept[:] = theta, s
        return functional_call(mpc, theta, (s,)).sum()

    grad(loss, argnums=(0, 1))(theta, states)
    inner_theta, inner_states = kept
    functional_call(mpc, inner_theta, (inner_states,)).sum().backward()
    expected = grad(loss, argnums=(0, 1))(theta, states)
    assert_close({name: x.grad for name, x in theta.items()}, expected[0])
    assert_close(states.grad, expected[1])
