"""Logged trajectories as plain arrays: reading them from a TensorDict, and cutting them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.errors import QPError

NEXT = ("next", "observation")
REMEDY = "Pass logged steps as TorchRL's collectors and rollouts return them."
#: Flags of a step that ends its trajectory.
ENDS = (("next", "done"), ("next", "terminated"), ("next", "truncated"))
#: Keys of collectors and of `torchrl.collectors.utils.split_trajectories`.
IDS = (("collector", "traj_ids"), ("traj_ids",))
MASKS = (("collector", "mask"), ("mask",))
#: Times and step counts, whose increments are constant without a gap.
TIMES = (("time",), ("step_count",))
#: The largest magnitude, whose squares are finite.
LARGEST = 1e100


class Trajectory(NamedTuple):
    """Consecutive steps in float64: y ``(T + 1, n_x)``, u ``(T, n_u)`` and d ``(T, n_d)``."""

    y: Tensor
    u: Tensor
    d: Tensor

    @property
    def steps(self) -> int:
        """The number of steps, T."""
        return len(self.u)

    def between(self, start: int, stop: int) -> Trajectory:
        """Return the steps start, .., stop - 1."""
        return Trajectory(self.y[start : stop + 1], self.u[start:stop], self.d[start:stop])


def read_trajectories(data: Any, n_x: int | None = None, n_d: int = 0) -> list[Trajectory]:
    """Return the trajectories in logged steps, in order.

    A trajectory ends at a done flag, where the id of the trajectory changes, and where the next
    observation is not the one of the following step, as in steps sampled at random. A step within a
    trajectory during which ``time`` or ``step_count`` jumps is left out.

    Args:
        data: steps ``(T,)`` or ``(episodes, T)``, or a lazy stack or list of ``(T,)`` of different
            lengths, with ``observation``, ``action``,
            ``("next", "observation")`` and, for ``n_d > 0``, ``preview``, whose first entries are
            d_k. Done flags, trajectory ids and masks of padded steps are respected.
        n_x: the number of outputs, the last entries of ``observation``; None for all of them.
        n_d: entries of d_k.

    Raises:
        QPError: an entry is missing, has another shape, or is not finite.
    """
    from tensordict import TensorDictBase

    if isinstance(data, list | tuple) or (isinstance(data, TensorDictBase) and -1 in data.shape):
        return _read_each(logs(data), n_x, n_d)
    check_kind("trajectories", data, TensorDictBase, REMEDY)
    if data.batch_dims not in (1, 2):
        got = f"shape {tuple(data.shape)}"
        raise QPError.expected("trajectories", got, "shape (T,) or (episodes, T)", REMEDY)
    check_whole("n_d", n_d, 0)
    if n_x is not None:
        check_whole("n_x", n_x, 1)
    steps = data if data.batch_dims == 2 else data.unsqueeze(0)
    valid = valid_steps(steps)
    y = _entry(steps, ("observation",), valid, n_x)
    u = _entry(steps, ("action",), valid)
    following = _entry(steps, NEXT, valid, n_x)
    if y.shape[-1] != following.shape[-1]:
        got = f"{following.shape[-1]} entries, but {y.shape[-1]} in observation"
        raise QPError.expected(_name(NEXT), got, "the same number in both")
    d = u.new_zeros(*u.shape[:-1], 0)
    if n_d:
        d = _entry(steps, ("preview",), valid, n_d, first=True)
    valid, ends = _cuts(steps, valid, (following[:, :-1] != y[:, 1:]).any(-1))
    trajectories = []
    for row in range(len(y)):
        start = 0
        for stop in (*(ends[row, :-1].nonzero().flatten() + 1).tolist(), y.shape[1]):
            if valid[row, start:stop].all():
                outputs = torch.cat((y[row, start:stop], following[row, stop - 1 : stop]))
                trajectories.append(Trajectory(outputs, u[row, start:stop], d[row, start:stop]))
            start = stop
    if not trajectories:
        raise QPError.expected("trajectories", "no steps", "logged steps", REMEDY)
    return trajectories


def kept_steps(steps: Any) -> Tensor:
    """Return True for the steps that `read_trajectories` keeps, in the log's shape."""
    rows = steps if steps.batch_dims == 2 else steps.unsqueeze(0)
    jumps = (rows[NEXT][:, :-1] != rows["observation"][:, 1:]).flatten(2).any(-1)
    return _cuts(rows, valid_steps(rows), jumps)[0].reshape(steps.shape)


def _cuts(steps: Any, valid: Tensor, jumps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the steps that are kept, and those that end a trajectory, ``(episodes, T)``.

    Args:
        steps: the logged steps.
        valid: True for those that are not padding.
        jumps: True where the next observation is not that of the following step,
            ``(episodes, T - 1)``.
    """
    ends = _flags(steps, ENDS, default=False)
    ends[:, :-1] |= jumps
    for key in IDS:
        if (ids := steps.get(key, None)) is not None:
            ids = _narrow(key, ids, steps.shape)
            ends[:, :-1] |= ids[:, 1:] != ids[:, :-1]
    for key in TIMES:
        if (times := steps.get(key, None)) is not None:
            valid = valid & ~_gaps(_narrow(key, times, steps.shape), ends)
    ends |= ~valid
    ends[:, :-1] |= ~valid[:, 1:]
    return valid, ends


def logs(data: Any) -> list[Any]:
    """Return the logs in a list, or in a lazy stack of logs of different lengths; else one."""
    if isinstance(data, list | tuple):
        return list(data)
    return list(data.unbind(0)) if -1 in getattr(data, "shape", ()) else [data]


def valid_steps(steps: Any) -> Tensor:
    """Return True for the steps that are not padding, in the log's shape."""
    return _flags(steps, MASKS, default=True)


def _read_each(parts: Sequence[Any], n_x: int | None, n_d: int) -> list[Trajectory]:
    """Return the trajectories of several logs."""
    trajectories = [log for part in parts for log in read_trajectories(part, n_x, n_d)]
    sizes = {(log.y.shape[1], log.u.shape[1]) for log in trajectories}
    if len(sizes) != 1:
        got = f"logs of (n_x, n_u) = {', '.join(map(str, sorted(sizes)))}" if sizes else "no logs"
        raise QPError.expected("trajectories", got, "logs of the same sizes", REMEDY)
    return trajectories


def _gaps(times: Tensor, ends: Tensor) -> Tensor:
    """Mark the steps ``(episodes, T)`` before an end during which the time jumps."""
    eps = torch.finfo(times.dtype if times.is_floating_point() else torch.float64).eps
    times, inside = times.double(), ~ends[:, :-1]
    change = times.diff(dim=1)
    gaps = torch.zeros_like(ends)
    if inside.any():
        step = change[inside].median()
        rounding = 4 * eps * times.abs()[:, 1:]
        gaps[:, :-1] = inside & ~((change - step).abs() <= 0.5 * step.abs() + rounding)
    return gaps


def folds(trajectories: Sequence[Trajectory], count: int) -> list[list[Trajectory]]:
    """Cut all steps into ``count`` consecutive parts of nearly equal length, for cross-validation.

    A trajectory that lies in several parts is cut.
    """
    total = sum(trajectory.steps for trajectory in trajectories)
    bounds = [total * i // count for i in range(count + 1)]
    parts: list[list[Trajectory]] = [[] for _ in range(count)]
    begin = 0
    for trajectory in trajectories:
        for part, first, last in zip(parts, bounds[:-1], bounds[1:], strict=True):
            start, stop = max(first - begin, 0), min(last - begin, trajectory.steps)
            if start < stop:
                part.append(trajectory.between(start, stop))
        begin += trajectory.steps
    return parts


def _entry(
    steps: Any, key: tuple[str, ...], valid: Tensor, width: int | None = None, first: bool = False
) -> Tensor:
    """Return the first or last ``width`` entries under ``key`` in float64, ``(episodes, T, n)``."""
    name, value = _name(key), steps.get(key, None)
    if value is None:
        present = ", ".join(_name(x) for x in steps.keys(True, True)) or "nothing"
        raise QPError.expected("trajectories", f"only {present}", f"an entry {name}", REMEDY)
    batch = tuple(steps.shape)
    wanted = f"a real tensor {(*batch, 'n')}"
    if width is not None:
        wanted += f" with n >= {width}"
    if not isinstance(value, Tensor) or value.is_complex() or value.ndim != len(batch) + 1:
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise QPError.expected(name, got, wanted, REMEDY)
    if value.shape[-1] < (width or 1):
        raise QPError.expected(name, f"shape {tuple(value.shape)}", wanted)
    _check_values(name, value)
    value = value.detach().to("cpu", torch.float64)
    if width is not None:
        value = value[..., :width] if first else value[..., value.shape[-1] - width :]
    bad = (~value.isfinite() & valid.unsqueeze(-1)).nonzero()
    if len(bad):
        *step, entry = bad[0].tolist()
        got = f"{value[tuple(bad[0])].item()} at step {tuple(step)}, entry {entry}"
        remedy = "Cut the steps that were not measured, and mark the last ones before as done."
        raise QPError.expected(name, got, "finite numbers", remedy)
    large = value.masked_fill(~valid.unsqueeze(-1), 0.0).abs().amax() if value.numel() else 0.0
    if large > LARGEST:
        remedy = "Squares of larger numbers overflow: choose larger units."
        raise QPError.expected(name, f"{large:.3g}", f"numbers up to {LARGEST:g}", remedy)
    return value


def _check_values(name: str, value: Tensor) -> None:
    """Raise `QPError` for a meta tensor."""
    if value.is_meta:
        remedy = "Pass the log itself, not its shapes."
        raise QPError.expected(name, "a meta tensor", "a tensor with values", remedy)


def _narrow(key: tuple[str, ...], value: Any, batch: torch.Size) -> Tensor:
    """Return one flag, id or time for each step; several are those of several agents, say."""
    if not isinstance(value, Tensor) or value.numel() != batch.numel():
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        expected = f"shape {tuple(batch)} or {(*batch, 1)}"
        raise QPError.expected(_name(key), got, expected, "Pass one for each step.")
    _check_values(_name(key), value)
    return value.reshape(batch).cpu()


def _flags(steps: Any, keys: tuple[tuple[str, ...], ...], default: bool) -> Tensor:
    """Return flags ``(episodes, T)``: all of the masks, or any of the ends of trajectories."""
    flags = torch.full(steps.shape, default)
    for key in keys:
        if (value := steps.get(key, None)) is not None:
            value = _narrow(key, value, steps.shape).bool()
            flags = flags & value if default else flags | value
    return flags


def _name(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)
