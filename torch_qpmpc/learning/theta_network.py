"""A network that moves theta with the observation: gain scheduling of the QP."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import nn
from torchrl.modules import MLP

from torch_qpmpc.checks import POSITIVE, check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.operators import PREVIEW, entry
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parameters import check_names


class ThetaNetwork(TensorDictModuleBase):
    """A network from p to residuals of theta, an upstream module for ``theta_keys``.

    Each residual is ``size * tanh(..)``. The last layer starts at zero, so the first QP is
    ``mpc``'s own.

    Args:
        mpc: the QPMPC; only the shapes of its coordinates are used.
        sizes: the bounds of the residuals by their names in `QPMPC.coordinates`, such as
            ``{"q": 1.0, "b": 0.1}``. Residuals of vectors (q, c, b, lb, ub) are cheap. Those of
            matrices (H, H_f, C, G) need one factorisation per QP: ten times as long or longer.
        width: units in each of the two hidden layers.

    Attributes:
        theta_keys: the key of each residual, an argument of `QPActorValueOperator`.

    Raises:
        QPError: an argument is invalid.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 5, stage_weight=[1.0, 0.1])
        >>> theta = qm.ThetaNetwork(mpc, {"q": 1.0, "b": 0.1})
        >>> operator = qm.QPActorValueOperator(mpc, theta_keys=theta.theta_keys)
        >>> loss = qm.QPQLearningLoss(TensorDictSequential(theta, operator))
        >>> policy = operator.get_policy_operator()
        >>> actor = TensorDictSequential(theta, policy, selected_out_keys=["action"])
        >>> actor(TensorDict(observation=torch.ones(3, 1), batch_size=3))["action"].shape
        torch.Size([3, 1])
    """

    def __init__(self, mpc: QPMPC, sizes: Mapping[str, float], *, width: int = 64) -> None:
        super().__init__()
        check_kind("mpc", mpc, QPMPC)
        check_kind("sizes", sizes, Mapping, "Map names to bounds: {'q': 1.0}.")
        check_whole("width", width, 1)
        known = mpc.coordinates()
        check_names("sizes", sizes, mpc)
        if not sizes:
            raise QPError.expected("sizes", "{}", f"bounds of some of {', '.join(known)}")
        for name, size in sizes.items():
            check_number(f"sizes[{name!r}]", size, *POSITIVE)
        self.sizes = {name: float(size) for name, size in sizes.items()}
        self.shapes = {name: known[name].shape for name in sizes}
        self.theta_keys: dict[str, NestedKey] = {name: ("theta", name) for name in sizes}
        self.in_keys = [*[PREVIEW] * (mpc.n_d > 0), "observation"]  # pyright: ignore[reportAttributeAccessIssue]
        self.out_keys = list(self.theta_keys.values())  # pyright: ignore[reportAttributeAccessIssue]
        n_out, device = sum(shape.numel() for shape in self.shapes.values()), mpc.C_0.device
        cells, options = [width, width], {"activation_class": nn.Tanh, "device": device}
        self.net = MLP(mpc.n_p, n_out, num_cells=cells, **options)
        last: Any = self.net[-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the residuals to ``theta_keys`` of ``tensordict``, and return it.

        Raises:
            QPError: an input is missing, or their entries are not n_p.
        """
        first: Any = self.net[0]
        parts = [entry(tensordict, key) for key in self.in_keys]
        inputs = torch.cat([part.to(first.bias.dtype) for part in parts], -1)
        check_tensor("p", inputs, first.in_features)
        counts = [shape.numel() for shape in self.shapes.values()]
        flat = self.net(inputs).tanh().split(counts, -1)
        for (name, shape), entries in zip(self.shapes.items(), flat, strict=True):
            residual = (self.sizes[name] * entries).reshape(*entries.shape[:-1], *shape)
            tensordict.set(self.theta_keys[name], residual)
        return tensordict
