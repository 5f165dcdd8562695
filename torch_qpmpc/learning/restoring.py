"""Calls of a module with other parameters that restore its own, even after an error.

After an exception, tensordict's ``with params.to_module(module)`` leaves ``params`` in the module,
which then has no parameters of its own: its state_dict silently lacks them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.objectives import LossModule


def call_with(
    params: TensorDictBase, module: TensorDictModuleBase, tensordict: TensorDictBase
) -> None:
    """Call ``module`` on ``tensordict``, in place, with ``params`` instead of its own tensors."""
    failure = None
    with params.to_module(module, preserve_module_state=False):
        # The context removes ``params`` only if no exception passes through it.
        try:
            module(tensordict)
        except Exception as error:
            failure = error
    if failure is not None:
        raise failure


@contextmanager
def restored(loss_module: LossModule) -> Iterator[None]:
    """Restore the networks' own tensors in a TorchRL loss if an exception is raised.

    Example:
        >>> import torch_qpmpc as qm
        >>> loss = qm.QPQLearningLoss(qm.QPActorValueOperator(qm.QPMPC(2, 1, 3)))
        >>> with restored(loss):
        ...     pass  # loss(batch), or that of DDPGLoss, TD3Loss, ..
    """
    # The loss module does not register its networks as submodules.
    networks = [x for x in vars(loss_module).values() if isinstance(x, nn.Module)]
    parts = {id(part): part for network in networks for part in network.modules()}.values()
    before = [(part, part._parameters.copy(), part._buffers.copy()) for part in parts]
    try:
        yield
    except Exception:
        for part, parameters, buffers in before:
            for name in (*parameters, *buffers):
                part.__dict__.pop(name, None)  # a swap puts plain tensors there
            part._parameters, part._buffers = parameters, buffers
        raise
