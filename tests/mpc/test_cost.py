"""The QP's cost of theta (eq:qpH): one kernel for it and its gradient, equal to torch's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev, jvp
from torch.nn.utils import parametrize
from torch.testing import assert_close
from torch.utils.flop_counter import FlopCounterMode

from tests.problems import MIXED, normal, random_mpc
from torch_qpmpc import QPMPC
from torch_qpmpc.mpc import cost as cost_module
from torch_qpmpc.mpc import parameters as parts
from torch_qpmpc.mpc.cost import DiagonalCost

COST = ("H", "H_f", "q", "w")
OPTIONS = {
    "free": {},
    "tied": {"structure": "tied"},
    "discounted slacks": {"discount_slack": True, **MIXED},
    "H": {"learn": ("H", "c", "C")},
    "w": {"learn": ("w",)},
    "projected": {"step": "projection"},
    "weights of each stage": {"stage_weight": normal(3, 3).abs()},
    "block": {"hessian": "block"},
}


def example(name: str) -> QPMPC:
    return random_mpc(4, **{"learn": (*COST, "C"), "gamma": 0.7, **OPTIONS[name]})


def cost(mpc: QPMPC) -> tuple[Tensor, Tensor, Tensor]:
    qp = mpc.quadratic_program()
    return qp.H, qp.q, qp.w


def is_by_kernel(*of_qp: Tensor) -> bool:
    return any(x.grad_fn is not None and "DiagonalCost" in x.grad_fn.name() for x in of_qp)


@pytest.fixture
def by_torch(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From the call on, the cost is made by torch's operations."""
    return lambda: monkeypatch.setattr(cost_module, "_suit_the_kernel", lambda *_: False)


class Of(nn.Module):
    """A function of a QPMPC for `functional_call`."""

    def __init__(self, mpc: QPMPC, function: Callable[[QPMPC], Any]) -> None:
        super().__init__()
        self.mpc, self.function = mpc, function

    def forward(self) -> Any:
        return self.function(self.mpc)


def weighted(mpc: QPMPC, *names: str) -> Tensor:
    """A number in which every entry of H, q or w has a weight of its own; inf aside."""
    found = dict(zip(("H", "q", "w"), cost(mpc), strict=True))
    asked = (x[x.isfinite()] for name, x in found.items() if name in names)
    return torch.stack([normal(len(x), seed=len(x)) @ x for x in asked]).sum()


def whole(mpc: QPMPC) -> Tensor:
    return weighted(mpc, "H", "q", "w")


@pytest.mark.parametrize("differentiated", [True, False])
@pytest.mark.parametrize("name", OPTIONS)
def test_the_kernel_makes_what_torch_makes(by_torch, name, differentiated):
    mpc = example(name)
    with torch.set_grad_enabled(differentiated):
        ours = cost(mpc)
        by_torch()
        others = cost(mpc)
    expected = differentiated and name not in ("weights of each stage", "block")
    assert is_by_kernel(*ours) == expected
    assert not is_by_kernel(*others)
    for one, other in zip(ours, others, strict=True):
        assert_close(one, other, rtol=1e-14, atol=0.0)
        assert one.requires_grad == other.requires_grad


@pytest.mark.parametrize("of", [("H", "q", "w"), ("H",), ("q",), ("w",)])
@pytest.mark.parametrize("name", OPTIONS)
def test_its_gradient_is_that_of_torch(by_torch, name, of):
    mpc = example(name)

    def gradients() -> tuple[Tensor | None, ...]:
        total = weighted(mpc, *of)
        if not total.requires_grad:
            return ()
        return torch.autograd.grad(total, [*mpc.parameters()], allow_unused=True)

    ours = gradients()
    by_torch()
    others = gradients()
    assert len(ours) == len(others)
    for one, other in zip(ours, others, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert_close(one, other, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("name", ["free", "tied", "H", "projected"])
def test_it_and_its_gradient_pass_finite_differences(name):
    mpc = example(name)
    names, start = zip(*mpc.named_parameters(), strict=True)

    def program(*theta: Tensor) -> Tensor:
        return functional_call(
            Of(mpc, whole), dict(zip((f"mpc.{x}" for x in names), theta, strict=True))
        )

    assert is_by_kernel(*cost(mpc))
    leaves = [x.detach().clone().requires_grad_() for x in start]
    assert torch.autograd.gradcheck(program, leaves)
    assert torch.autograd.gradgradcheck(program, leaves)


def test_gradients_may_be_batched():
    mpc = example("free")
    H, leaves = cost(mpc)[0], [*parts.leaves(mpc, "H"), *parts.leaves(mpc, "H_f")]
    incoming = normal(5, *H.shape)
    batched = torch.autograd.grad(H, leaves, incoming, is_grads_batched=True, retain_graph=True)
    for i in range(5):
        alone = torch.autograd.grad(H, leaves, incoming[i], retain_graph=True)
        assert_close([x[i] for x in batched], [*alone])


@pytest.mark.parametrize("create_graph", [True, False])
@pytest.mark.parametrize("changed", ["parametrizations.H.original", "discount"])
def test_what_the_gradient_depends_on_and_has_changed_since_is_noticed(changed, create_graph):
    mpc = example("free")
    total = weighted(mpc, "H")
    with torch.no_grad():
        dict([*mpc.named_parameters(), *mpc.named_buffers()])[changed].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.grad(
            total, [*mpc.parameters()], create_graph=create_graph, allow_unused=True
        )


@pytest.mark.parametrize("create_graph", [True, False])
def test_what_the_gradient_does_not_depend_on_may_change(create_graph):
    mpc = random_mpc(4, learn=("H", "q"))
    leaves = [*mpc.parameters()]
    expected = torch.autograd.grad(whole(mpc), leaves)
    total = whole(mpc)
    with torch.no_grad():
        for part in (mpc.q, mpc.H_f, mpc.w):
            part.add_(1.0)
    assert_close(torch.autograd.grad(total, leaves, create_graph=create_graph), expected)


def gradients_of(mpc: QPMPC, theta: Callable[[], dict[str, Tensor]], leaf: Tensor) -> list[Tensor]:
    """In a leaf of theta: alone, differentiable, batched, seen by a mode; a row of the Hessian."""
    total = functional_call(Of(mpc, whole), {f"mpc.{name}": x for name, x in theta().items()})
    (plain,) = torch.autograd.grad(total, leaf, retain_graph=True)
    (kept,) = torch.autograd.grad(total, leaf, create_graph=True)
    rows = torch.autograd.grad(kept[0], leaf, retain_graph=True, allow_unused=True)
    (batched,) = torch.autograd.grad(
        total, leaf, torch.ones(2).double(), is_grads_batched=True, retain_graph=True
    )
    with FlopCounterMode(display=False):
        (seen,) = torch.autograd.grad(total, leaf)
    return [plain, kept.detach(), batched, seen, *(x for x in rows if x is not None)]


@pytest.mark.parametrize("case", ["depending on each other", "the same", "hooked"])
def test_factors_have_the_graph_and_the_hooks_that_they_have(by_torch, case):
    """What differentiates in them again must not go through these twice."""
    mpc = random_mpc(4, action_slack=50.0, learn=("C",) if case != "hooked" else ("H", "C"))
    leaf = normal(mpc.n_z).requires_grad_()
    if case == "depending on each other":

        def theta() -> dict[str, Tensor]:
            H = leaf[:3] * leaf[:3]
            return {"H": H, "H_f": H[:2] * H[1:]}
    elif case == "the same":

        def theta() -> dict[str, Tensor]:
            return dict.fromkeys(("q", "w"), leaf * leaf)
    else:
        leaf = parts.leaves(mpc, "H")[0]
        leaf.register_hook(lambda gradient: 2 * gradient)
        theta = dict
    ours = gradients_of(mpc, theta, leaf)
    by_torch()
    assert_close(ours, gradients_of(mpc, theta, leaf))


def test_a_discount_may_be_learned():
    mpc = example("H")
    gamma = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    mpc.discount = gamma ** torch.arange(mpc.n_z).double()
    assert torch.autograd.grad(weighted(mpc, "H", "q"), gamma)[0] != 0


def test_a_module_without_its_buffers_yet_says_what_to_do():
    mpc = example("free")
    mpc.stages.fill_(99)
    with pytest.raises(IndexError, match="load a state_dict, or call reset_parameters"):
        mpc.quadratic_program()
    mpc = example("free")
    total = weighted(mpc, "H")
    mpc.stages.data.fill_(-1)  # of which autograd knows nothing
    with pytest.raises(IndexError, match="load a state_dict, or call reset_parameters"):
        total.backward()


def test_a_part_that_is_cached_is_what_the_cost_is_made_of():
    mpc = example("free")
    with parametrize.cached():
        (gradient,) = torch.autograd.grad(cost(mpc)[0].diagonal().sum(), mpc.H)
    assert (gradient > 1).all()


@pytest.mark.parametrize("hooked", ["parametrizations.H", "parametrizations.H.0"])
def test_a_hook_on_a_parametrization_is_heard(hooked):
    mpc = example("free")
    mpc.get_submodule(hooked).register_forward_hook(lambda *of_call: 10 * of_call[-1])
    assert_close(cost(mpc)[0].diagonal()[:3], mpc.H)
    assert is_by_kernel(*cost(mpc))


def test_a_parametrization_is_asked_once():
    class Counted(nn.Module):
        calls = 0

        def forward(self, weight: Tensor) -> Tensor:
            self.calls += 1
            return weight

    mpc, counted = example("free").float(), Counted()
    parametrize.register_parametrization(mpc, "H", counted)
    counted.calls = 0
    cost(mpc)
    assert counted.calls == 1


def test_transforms_and_forward_mode_see_torch_alone(by_torch):
    mpc = example("free")
    leaves = {"mpc." + name: x.detach() for name, x in mpc.named_parameters()}

    def program(theta: dict[str, Tensor]) -> Tensor:
        return functional_call(Of(mpc, whole), theta)

    ones = {name: torch.ones_like(x) for name, x in leaves.items()}
    found = jacrev(program)(leaves), jvp(program, (leaves,), (ones,))
    by_torch()
    assert_close(found, (jacrev(program)(leaves), jvp(program, (leaves,), (ones,))))


def test_another_parametrization_of_a_part_is_heard():
    class Doubled(nn.Module):
        def forward(self, weight: Tensor) -> Tensor:
            return 2 * weight

    mpc = example("free")
    before = cost(mpc)
    for part in ("H", "H_f", "q"):
        parametrize.register_parametrization(mpc, part, Doubled())
    after = cost(mpc)
    assert is_by_kernel(*after)
    assert_close(after, (2 * before[0], 2 * before[1], before[2]))


def test_single_precision_is_left_to_torch():
    mpc = example("free").float()
    H, q, w = cost(mpc)
    assert H.dtype == q.dtype == w.dtype == torch.float32
    assert not is_by_kernel(H, q, w)


@pytest.mark.parametrize("name", ["q", "parametrizations.H.original"])
def test_other_shapes_are_left_to_torch(name):
    """Several q make a batch of QPs; an H of another size does not fit."""
    mpc = example("free")
    parameter = mpc.get_parameter(name).detach()
    if name == "q":
        _, alone, _ = cost(mpc)
        several = torch.stack((parameter, 2 * parameter))
        _, q, _ = functional_call(Of(mpc, cost), {"mpc.q": several})
        assert_close(q, torch.stack((alone, 2 * alone)))
    else:
        with pytest.raises(IndexError, match="index out of range"):
            functional_call(Of(mpc, cost), {f"mpc.{name}": parameter[:-1]})


def test_what_is_not_learned_has_no_gradient_asked_for():
    mpc = random_mpc(4, learn=("H", "C"))
    H, q, w = cost(mpc)
    assert (H.requires_grad, q.requires_grad, w.requires_grad) == (True, False, False)
    assert H.grad_fn is not None
    assert H.grad_fn.name() == DiagonalCost.__name__ + "Backward"
