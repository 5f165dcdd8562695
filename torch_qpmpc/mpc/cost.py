"""The cost of a scheme (eq:qpH): the weights of the stages and of x_N, and q and c."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.checks import check_choice
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.riccati import RICCATI, terminal_riccati
from torch_qpmpc.mpc.validation import check_weight, owned

HESSIANS = ("diagonal", "block")
#: What to do without a stage weight.
REMEDY = (
    "Pass the plant's own W (in train.py task.stage_weight) of the cost 1/2 [x; u]' W [x; u], such "
    "as stage_weight=[1.0, 1.0, 0.1] for two states and an action."
)


@dataclass(frozen=True, eq=False)
class Cost:
    """The cost of a scheme, *half* of ``[x_k; u_k]' H_k [x_k; u_k]`` in each stage (eq:qpH).

    For a plant's cost ``s'Ws``, pass 2 W.

    Args:
        stage_weight: H_k, ``(n_x + n_u,)`` if diagonal, else ``(n_x + n_u, n_x + n_u)``, with an
            optional leading N for one weight per stage. With a preview and a dense H it may be one
            of [d_k; x_k; u_k], whose block of (x_k, u_k) alone must be positive semidefinite: a
            price p times u_k is an entry 1 in both of their cross blocks.
        terminal_weight: H_f, ``(n_x,)`` or ``(n_x, n_x)``, or of [d_N; x_N]. ``"riccati"``: the
            cost to go of the linear quadratic regulator of A, B and the stage weight, about the x
            of least stage cost for d_N; not for a diagonal hessian. This is the default if it
            exists, for one dense stage weight and no q; else the stage's own weight is.
        hessian: ``"diagonal"`` or ``"block"``, one dense block a stage.
        q, c: the linear cost ``(n_z,)`` and the constant, without discounts; zero by default.

    Raises:
        QPError: an entry is not finite, or ``hessian`` or ``terminal_weight`` is unknown.

    Example:
        >>> import torch_qpmpc as qm
        >>> cost = qm.Cost(stage_weight=[1.0, 1.0, 0.1], hessian="block", terminal_weight="riccati")
    """

    stage_weight: Any = None
    terminal_weight: Any = None
    hessian: str = "diagonal"
    q: Any = None
    c: Any = None

    def __post_init__(self) -> None:
        check_choice("hessian", self.hessian, HESSIANS)
        object.__setattr__(self, "hessian", str(self.hessian))
        names = ["stage_weight", "q", "c"]
        if not isinstance(self.terminal_weight, str):
            names.append("terminal_weight")
        elif self.terminal_weight != RICCATI or self.hessian == "diagonal":
            got = f"{self.terminal_weight!r} with hessian={self.hessian!r}"
            want = f"a tensor, or {RICCATI!r} with hessian='block'"
            raise QPError.expected("terminal_weight", got, want)
        for name in names:
            object.__setattr__(self, name, owned(name, getattr(self, name)))

    def hessians(self, layout: Layout, A: Tensor, B: Tensor, gamma: float) -> dict[str, Tensor]:
        """Return H and H_f of the sizes ``layout`` in the shapes for ``hessian``.

        A terminal weight of the regulator is that of ``A``, ``B`` and ``gamma``.

        Raises:
            QPError: there is no stage weight, a shape does not match the sizes, or a weight is not
                positive semidefinite.
        """
        stage, terminal = self.stage_weight, self.terminal_weight
        if stage is None:
            raise QPError.expected("stage_weight", "none", "a weight of [x; u]", REMEDY)
        if isinstance(terminal, str):
            terminal = terminal_riccati(A, B, stage, gamma, layout)
        elif terminal is None:
            terminal = self._default_weight(layout, A, B, gamma)
        return _blocks(stage, terminal, self.hessian, layout)

    def _default_weight(self, layout: Layout, A: Tensor, B: Tensor, gamma: float) -> Tensor:
        """Return the Riccati weight about the target if it exists, else the last stage's weight.

        A linear cost has a target of its own, which only the stage's weight respects.
        """
        W, n_x, n_d = self.stage_weight, layout.n_x, layout.n_d
        shapes = ((layout.n,), (layout.n,) * 2, (n_d + layout.n,) * 2)
        if self.hessian == "diagonal" or tuple(W.shape) not in shapes:
            W = W[-1] if W.ndim > 1 else W
        elif self.q is None:
            with suppress(QPError):  # the stage's weight is always one
                P = terminal_riccati(A, B, W, gamma, layout)
                check_weight("terminal_weight", P, diagonal=False, n_d=len(P) - n_x)
                return P
        if W.ndim == 2:
            size = len(W) - layout.n_u
            return W[:size, :size]
        return W[:n_x] if W.ndim else W


def _blocks(stage: Tensor, terminal: Tensor, hessian: str, layout: Layout) -> dict[str, Tensor]:
    """Return H and H_f; a dense weight of (x_k, u_k) alone has zeros for the preview."""
    n_x, n, n_d, horizon = layout.n_x, layout.n, layout.n_d, layout.horizon
    diagonal = hessian == "diagonal"
    # A square matrix is one dense block, even where the horizon happens to be its size.
    diagonals = ((n,), (horizon, n)) if horizon != n else ((n,),)
    if not diagonal and tuple(stage.shape) in diagonals:
        stage = torch.diag_embed(stage)
    if not diagonal and tuple(terminal.shape) == (n_x,):
        terminal = torch.diag(terminal)
    if not diagonal and n_d:
        widened = (n_d, 0, n_d, 0)
        stage = F.pad(stage, widened) if stage.shape[-2:] == (n, n) else stage
        terminal = F.pad(terminal, widened) if terminal.shape == (n_x, n_x) else terminal
    event = (n,) if diagonal else (n_d + n,) * 2
    terminal_event = (n_x,) if diagonal else (n_d + n_x,) * 2
    per_stage = (horizon, *event)
    if tuple(stage.shape) not in (event, per_stage):
        got = f"shape {tuple(stage.shape)}"
        dense = diagonal and stage.shape[-2:] in ((n, n), (n_d + n,) * 2)
        remedy = "A matrix needs hessian='block'." if dense else ""
        raise QPError.expected("stage_weight", got, f"shape {event} or {per_stage}", remedy)
    if tuple(terminal.shape) != terminal_event:
        got = f"shape {tuple(terminal.shape)}"
        raise QPError.expected("terminal_weight", got, f"shape {terminal_event}")
    check_weight("stage_weight", stage, diagonal, n_d)
    check_weight("terminal_weight", terminal, diagonal, n_d)
    return {"H": stage, "H_f": terminal}
