"""Reads of torch's internals that no other test sees: these fail when torch changes them."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.func import grad, jvp, vmap

from torch_qpmpc.qp import tracing

X = torch.ones(3, dtype=torch.float64)


class Seen:
    """Records what a read says at the place where an instance is called; returns its argument."""

    def __init__(self, read: Any) -> None:
        self.read, self.values = read, []

    def __call__(self, x: Tensor) -> Tensor:
        self.values.append(self.read(x))
        return x.sum()


def hidden() -> Seen:
    return Seen(lambda x: not tracing.has_values())


class Subclass(Tensor):
    pass


def test_plain_tensors_are_not_hidden():
    assert tracing.has_values(X, nn.Parameter(X), X.clone().requires_grad_())
    assert tracing.is_eager((X,))
    assert tracing.transforms() == ()


def test_a_dispatch_mode_and_a_tensor_class_hide():
    with FakeTensorMode() as mode:
        assert not tracing.has_values()
    assert tracing.has_values()
    assert not tracing.has_values(X, X.as_subclass(Subclass))
    assert not tracing.has_values(mode.from_tensor(X))
    assert not tracing.has_values(X, X.to("meta"))


def test_a_jit_trace_hides():
    seen = hidden()
    torch.jit.trace(seen.__call__, X, check_trace=False)
    assert seen.values == [True]


class Doubled(torch.autograd.Function):
    seen: Seen

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return 2 * x

    @staticmethod
    def backward(ctx: Any, incoming: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        Doubled.seen(incoming)
        return 2 * incoming


@pytest.mark.parametrize("batched", [False, True])
def test_a_batch_of_gradients_hides(batched):
    Doubled.seen = hidden()
    x = X.clone().requires_grad_()
    incoming = torch.eye(3).double() if batched else X
    torch.autograd.grad(Doubled.apply(x), x, incoming, is_grads_batched=batched)
    assert Doubled.seen.values == [batched]


def test_a_function_mode_is_not_eager():
    with torch.device("cpu"):
        assert not tracing.is_eager((X,))
    assert tracing.is_eager((X,))


def test_transforms_from_the_outermost():
    seen = Seen(lambda x: tracing.transforms())
    vmap(grad(seen))(X[:, None])
    jvp(grad(seen), (X,), (X,))
    assert seen.values == [("Vmap", "Grad"), ("Jvp", "Grad")]
