"""Call a module with other parameters; its own come back, also after an error.

tensordict's ``with params.to_module(module)`` leaves ``params`` in the module if an exception
passes it: the module then has no parameters, and its state_dict lacks them without a word.
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
        # The context is left without an exception, as only then it takes ``params`` out again.
        try:
            module(tensordict)
        except Exception as error:
            failure = error
    if failure is not None:
        raise failure


@contextmanager
def restored(loss_module: LossModule) -> Iterator[None]:
    """Give the networks of a loss of TorchRL's their own tensors back if an exception is raised.

    Example:
        >>> import torch_qpmpc as qm
        >>> loss = qm.QPQLearningLoss(qm.QPActorValueOperator(qm.QPMPC(2, 1, 3)))
        >>> with restored(loss):
        ...     pass  # loss(batch), of DDPGLoss, TD3Loss, ..
    """
    # They are kept outside the loss module's registry.
    networks = [x for x in vars(loss_module).values() if isinstance(x, nn.Module)]
    parts = {id(part): part for network in networks for part in network.modules()}.values()
    before = [(part, part._parameters.copy(), part._buffers.copy()) for part in parts]
    try:
        yield
    except Exception:
        for part, parameters, buffers in before:
            for name in (*parameters, *buffers):
                part.__dict__.pop(name, None)  # where a swap puts what is no parameter
            part._parameters, part._buffers = parameters, buffers
        raise
