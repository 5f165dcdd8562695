"""The order of z and of the rows of G, their ties, and the discounted cost (eq:qpH).

Known entries come first in z, then the plan:

    z = [d_0, .., d_N, x_0,  u_0, x_1, u_1, .., x_N]
         preview and state   plan

Without a preview it is the paper's z. G has one row for each entry of [x_0, u_0, .., x_N], then D
on (d_k, x_k, u_k) for each stage, then D^f on (d_N, x_N) (eq:v1c4).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError

SIZES = ("n_x", "n_u", "horizon", "n_d")
COUNTS = ("n_mixed", "n_terminal")


@dataclass(frozen=True)
class Layout:
    """The sizes of z and of G.

    Attributes:
        n_x: number of states.
        n_u: number of actions.
        horizon: N, at least 1.
        n_d: entries of a stage's preview d_k.
        n_mixed, n_terminal: rows of D and of D^f, which a `Scheme` counts.
        blocks: numbers of stages that share one action, with the sum N; none if each has its own.

    Raises:
        QPError: a size is not a whole number, or too small.

    Example:
        >>> import torch_qpmpc as qm
        >>> layout = qm.Layout(n_x=2, n_u=1, horizon=5, n_d=1)
        >>> layout.n_p, layout.n_z
        (8, 23)
    """

    n_x: int
    n_u: int
    horizon: int
    n_d: int = 0
    n_mixed: int = 0
    n_terminal: int = 0
    blocks: Sequence[int] = ()

    def __post_init__(self) -> None:
        for name in (*SIZES, *COUNTS):
            check_whole(name, size := getattr(self, name), 0 if name in ("n_d", *COUNTS) else 1)
            object.__setattr__(self, name, int(size))
        object.__setattr__(self, "blocks", read_blocks(self.blocks, self.horizon))

    @cached_property
    def n(self) -> int:
        """Entries of a stage of the plan, n_x + n_u."""
        return self.n_x + self.n_u

    @cached_property
    def n_preview(self) -> int:
        """Entries of all previews, (N + 1) n_d."""
        return (self.horizon + 1) * self.n_d

    @cached_property
    def n_p(self) -> int:
        """Entries of z that V fixes: all up to x_0."""
        return self.n_preview + self.n_x

    @cached_property
    def n_z(self) -> int:
        """Entries of z, known and planned."""
        return self.n_p + self.horizon * self.n

    def stages(self, x: Tensor, u: Tensor) -> Tensor:
        """Arrange x ``(N + 1, n_x)`` and u ``(N + 1, n_u)`` as [x_0, u_0, .., x_N], without u_N."""
        x, u = (part.expand(self.horizon + 1, -1) for part in (x, u))
        return torch.cat((x, u), dim=-1).flatten()[: self.n_z - self.n_preview]

    def rows(self, x: Tensor, u: Tensor, D: Tensor, D_f: Tensor) -> Tensor:
        """Arrange values of the rows of G ``(n_g,)``.

        They are those of x ``(N + 1, n_x)``, u ``(N + 1, n_u)``, D ``(N, n_mixed)`` and D^f as
        ``D_f`` ``(n_terminal,)``; a leading 1 is for all stages.
        """
        return torch.cat((self.stages(x, u), D.expand(self.horizon, -1).flatten(), D_f))

    def discounts(self, gamma: float) -> tuple[Tensor, Tensor]:
        """Return ``gamma``^k for the entries of z ``(n_z,)`` and for the rows of G ``(n_g,)``."""
        powers = gamma ** torch.arange(self.horizon + 1, dtype=torch.float64).unsqueeze(-1)
        d, x, u = (powers.expand(-1, size) for size in (self.n_d, self.n_x, self.n_u))
        D, D_f = (powers.expand(-1, size) for size in (self.n_mixed, self.n_terminal))
        return torch.cat((d.flatten(), self.stages(x, u))), self.rows(x, u, D[:-1], D_f[-1])

    def ties(self, part: str) -> Tensor:
        """Return the index of the value of each entry of a tied ``part``, q, b, lb, ub or w.

        x_N has values of its own in q and w, as w^f in eq:v1c0, and d_N in q.
        """
        n_x, n = self.n_x, self.n
        x, u = torch.arange(n_x), torch.arange(n_x, n)
        own = torch.stack((*[x] * self.horizon, n + x))
        if part == "b":
            return x.repeat(self.horizon)
        if part == "q":
            d, first = torch.arange(self.n_d), n + n_x
            d = torch.cat(((first + d).repeat(self.horizon), first + self.n_d + d))
            return torch.cat((d, self.stages(own, u)))
        if part == "w":
            x, n = own, n + n_x
        D, D_f = (torch.arange(i) for i in (self.n_mixed, self.n_terminal))
        return self.rows(x, u, n + D, n + self.n_mixed + D_f)

    def signals(self) -> Tensor:
        """Return the index in [x; u; d] of the signal in each entry of z, ``(n_z,)``."""
        stages = torch.arange(self.n).repeat(self.horizon + 1)
        d = torch.arange(self.n, self.n + self.n_d).repeat(self.horizon + 1)
        return torch.cat((d, stages[: self.n_z - self.n_preview]))

    def predicted(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states ``(*batch, N + 1, n_x)`` and actions ``(*batch, N, n_u)`` of ``z``."""
        plan, terminal = z[..., self.n_preview : -self.n_x], z[..., None, -self.n_x :]
        stages = plan.unflatten(-1, (self.horizon, self.n))
        return torch.cat((stages[..., : self.n_x], terminal), -2), stages[..., self.n_x :]

    def from_stage(self, blocks: Tensor) -> Tensor:
        """Return rows ``(N i, n_z)`` with ``blocks`` ``(N, i, n_d + n)`` at d_k, x_k and u_k."""
        d, plan = (torch.block_diag(*x) for x in blocks.split((self.n_d, self.n), dim=-1))
        d = F.pad(d, (0, self.n_preview - d.shape[-1]))
        return torch.cat((d, F.pad(plan, (0, self.n_x))), dim=-1)

    def from_terminal(self, block: Tensor) -> Tensor:
        """Return rows ``(i, n_z)`` with ``block`` ``(i, n_d + n_x)`` at d_N and x_N."""
        d, x = block.split((self.n_d, self.n_x), dim=-1)
        d = F.pad(d, (self.n_preview - self.n_d, self.n_z - self.n_preview - self.n_x))
        return torch.cat((d, x), dim=-1)

    def stage_blocks(self, rows: Tensor) -> Tensor:
        """Return the entries of rows ``(N i, n_z)`` at d_k, x_k, u_k, ``(N, i, n_d + n)``."""
        k = torch.arange(self.horizon, device=rows.device)[:, None, None]
        d, plan = (n * k + torch.arange(n, device=rows.device) for n in (self.n_d, self.n))
        columns = torch.cat((d, self.n_preview + plan), dim=-1)
        blocks = rows.unflatten(0, (self.horizon, len(rows) // self.horizon))
        return blocks.gather(-1, columns.expand(-1, blocks.shape[1], -1))

    def terminal_block(self, rows: Tensor) -> Tensor:
        """Return the entries of rows ``(i, n_z)`` at d_N and x_N, ``(i, n_d + n_x)``."""
        d = rows[:, self.n_preview - self.n_d : self.n_preview]
        return torch.cat((d, rows[:, self.n_z - self.n_x :]), dim=-1)

    @property
    def repeating(self) -> Tensor:
        """True for the stages that repeat the action of the stage before, ``(N,)``."""
        repeating = torch.full((self.horizon,), bool(self.blocks))
        repeating[torch.tensor((0, *self.blocks[:-1])).cumsum(0)] = False
        return repeating

    def repetitions(self) -> Tensor:
        """Return the rows of u_k - u_{k-1} for the stages that repeat, ``(h n_u, n_z)``."""
        unit = torch.eye(self.n_z, dtype=torch.float64)
        actions = unit[self.n_preview : -self.n_x].unflatten(0, (-1, self.n))[:, self.n_x :]
        return (actions[1:] - actions[:-1])[self.repeating[1:]].flatten(0, 1)

    def repeated(self, of_actions: Tensor) -> Tensor:
        """Return True at the rows of G that bound the actions of repeated stages, ``(n_g,)``.

        ``of_actions`` ``(n_mixed,)`` is True for the rows of D that bound actions alone.
        """
        repeating, none = self.repeating.unsqueeze(-1), torch.zeros(1, self.n_x, dtype=torch.bool)
        u = F.pad(repeating, (0, 0, 0, 1)).expand(-1, self.n_u)
        D_f = none.new_zeros(self.n_terminal)
        return self.rows(none, u, repeating & of_actions, D_f)


def read_blocks(blocks: Sequence[int], horizon: int) -> tuple[int, ...]:
    """Return ``blocks`` as integers; raise `QPError` if they do not add up to the horizon."""
    want = f"whole numbers >= 1 with the horizon {horizon} as their sum"
    try:
        sizes = [int(size) for size in blocks]
    except (TypeError, ValueError, OverflowError) as error:
        raise QPError.expected("blocks", repr(blocks), want) from error
    if sizes and (min(sizes) < 1 or sum(sizes) != horizon or sizes != [*blocks]):
        remedy = "The last one may hold its actions to the end."
        raise QPError.expected("blocks", repr(blocks), want, remedy)
    return (*sizes,)


def banded_matrix(A: Tensor, B: Tensor, horizon: int, E: Tensor | None = None) -> Tensor:
    """Return C_0 ``(N n_x, n_z)`` of the model ``x_{k+1} = A x_k + B u_k + E d_k``.

    A ``(n_x, n_x)``, B ``(n_x, n_u)`` and, with a preview, E ``(n_x, n_d)`` have a leading N if
    they vary over the ``horizon``. Row block k has (d_k, x_k, u_k, x_{k+1}), the band.
    """
    E = A.new_zeros(*A.shape[:-1], 0) if E is None else E
    n_x = A.shape[-2] if A.ndim > 1 else len(A)
    n_u, n_d = max(B.shape[-1], 1), E.shape[-1]
    shapes = {"A": (A, (n_x, n_x)), "B": (B, (n_x, n_u)), "E": (E, (n_x, n_d))}
    for name, (matrix, shape) in shapes.items():
        if tuple(matrix.shape) not in (shape, (horizon, *shape)):
            got = f"shape {tuple(matrix.shape)}"
            raise QPError.expected(name, got, f"shape {shape} or {(horizon, *shape)}")
    following = torch.diag_embed(-A.new_ones(horizon, n_x))
    band = torch.cat((*(x.expand(horizon, n_x, -1) for x in (A, B)), following), dim=-1)
    # Padded to n more columns than C has and read without these, each row block moves by n.
    n, n_z = n_x + n_u, horizon * (n_x + n_u) + n_x
    padded = F.pad(band.movedim(1, 0), (0, n_z + n - band.shape[-1])).flatten(1)
    C = padded[:, : horizon * n_z].unflatten(-1, (horizon, n_z)).movedim(0, 1).flatten(0, 1)
    if not n_d:
        return C
    preview = F.pad(torch.block_diag(*E.expand(horizon, n_x, n_d)), (0, n_d))
    return torch.cat((preview, C), dim=-1)


def band_distance(layout: Layout) -> Tensor:
    """Return the signed distance from the band in stages, ``(N n_x, n_z)``, > 0 above it."""
    n_x, n, horizon = layout.n_x, layout.n, layout.horizon
    row = torch.arange(horizon).repeat_interleave(n_x).unsqueeze(1)
    column = torch.arange(horizon * n + n_x)
    stage = column // n
    is_state = column % n < n_x
    # x_{k+1} is on the band of row block k, u_{k+1} the first block above it.
    above = (stage - row - is_state.long()).clamp(min=0)
    below = (row - stage).clamp(min=0)
    preview = torch.arange(horizon + 1).repeat_interleave(layout.n_d) - row
    return torch.cat((preview, above - below), dim=-1)
