"""The model of a scheme: x_{k+1} = A x_k + B u_k + E d_k + offset."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.validation import owned


@dataclass(frozen=True, eq=False)
class Model:
    """The model x+ = A x + B u + E d + offset that the constraints ``C z = b`` start from.

    A discrete system of scipy or python-control whose states are measured has such matrices:
    ``Model(system.A, system.B)``.

    Args:
        A: ``(n_x, n_x)``, or one per stage, ``(N, n_x, n_x)``.
        B: ``(n_x, n_u)``, or one per stage.
        E: the factor of the preview d_k, ``(n_x, n_d)``, or one per stage; zero by default.
        offset: ``(n_x,)``; zero by default.
        C, b: ``(N n_x, n_z)`` and ``(N n_x,)``, such as a multi-step predictor's, in place of the
            model's.

    Raises:
        QPError: an entry is not finite, or the shapes do not match each other.

    Example:
        >>> import torch_qpmpc as qm
        >>> model = qm.Model(A=[[1.0, 0.1], [0.0, 0.9]], B=[[0.0], [0.1]])
        >>> model.layout(horizon=5).n_z
        17
    """

    A: Any = None
    B: Any = None
    E: Any = None
    offset: Any = None
    C: Any = None
    b: Any = None

    def __post_init__(self) -> None:
        for name in ("A", "B", "E", "offset", "C", "b"):
            object.__setattr__(self, name, owned(name, getattr(self, name)))
        if self.A is None or self.B is None:
            return
        A, B = tuple(self.A.shape), tuple(self.B.shape)
        if len(A) < 2 or len(B) < 2 or not A[-2] == A[-1] == B[-2]:
            got, want = f"shapes {A} and {B}", "(n_x, n_x) and (n_x, n_u)"
            raise QPError.expected("A, B", got, want)

    def layout(self, horizon: int) -> Layout:
        """Return the sizes that A, B and E have with ``horizon`` stages.

        Raises:
            QPError: A or B is None, or a size is zero.
        """
        if self.A is None or self.B is None:
            name = "A" if self.A is None else "B"
            raise QPError.expected(name, "None", "a matrix of x+ = A x + B u")
        n_d = 0 if self.E is None else self.E.shape[-1]
        return Layout(self.B.shape[-2], self.B.shape[-1], horizon, n_d)

    def matrices(self, layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and E of the sizes ``layout``.

        Raises:
            QPError: A or B is None, or a shape does not match the sizes.
        """
        n_x, n_u, n_d = layout.n_x, layout.n_u, layout.n_d
        A, B, E = self.A, self.B, self.E
        if A is None or B is None:
            want = f"the model x+ = A x + B u, matrices ({n_x}, {n_x}) and ({n_x}, {n_u})"
            remedy = "QPMPC.from_data and identify fit one to a log."
            raise QPError.expected("A, B", "None", want, remedy)
        E = A.new_zeros(n_x, n_d) if E is None else E
        if A.shape[-1:] != (n_x,) or B.shape[-1:] != (n_u,):
            got = f"shapes {tuple(A.shape)} and {tuple(B.shape)}"
            raise QPError.expected("A, B", got, f"({n_x}, {n_x}) and ({n_x}, {n_u})")
        if E.shape[-2:] != (n_x, n_d):
            remedy = "It multiplies the preview d_k, of n_d entries."
            raise QPError.expected("E", f"shape {tuple(E.shape)}", f"({n_x}, {n_d})", remedy)
        return A, B, E

    def offsets(self, layout: Layout) -> Tensor:
        """Return b ``(N n_x,)`` of the offset for the sizes ``layout``.

        Raises:
            QPError: the offset's shape does not match the sizes.
        """
        n_x = layout.n_x
        offset = torch.zeros(n_x, dtype=torch.float64) if self.offset is None else self.offset
        if tuple(offset.shape) != (n_x,):
            raise QPError.expected("offset", f"shape {tuple(offset.shape)}", f"shape ({n_x},)")
        return -offset.repeat(layout.horizon)
