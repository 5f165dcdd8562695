"""Trajectories of steps as TorchRL's collectors and rollouts return them."""

import sys
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_whole, ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.log import LARGEST, Trajectory

NEXT = ("next", "observation")
#: The next outputs, where the observations are estimates.
MEASURED = ("next", "measured")
REMEDY = "Pass logged steps as TorchRL's collectors and rollouts return them."
#: Flags of a step that ends its trajectory.
ENDS = (("next", "done"), ("next", "terminated"), ("next", "truncated"))
#: Keys of collectors and of `torchrl.collectors.utils.split_trajectories`.
IDS = (("collector", "traj_ids"), ("traj_ids",))
MASKS = (("collector", "mask"), ("mask",))


def is_steps(data: Any) -> bool:
    """Return True for TensorDicts, without importing TensorDict."""
    if (library := sys.modules.get("tensordict")) is None:
        return False
    parts = data if isinstance(data, list | tuple) else [data]
    return len(parts) > 0 and all(isinstance(part, library.TensorDictBase) for part in parts)


def of_steps(data: Any, n_x: int | None, n_d: int) -> list[Trajectory]:
    """Return the trajectories in logged steps, in order; see `as_log`."""
    check_whole("n_d", n_d, 0)
    if n_x is not None:
        check_whole("n_x", n_x, 1)
    trajectories = [one for part in logs(data) for one in _of_rows(part, n_x, n_d)]
    sizes = {(one.y.shape[1], one.u.shape[1]) for one in trajectories}
    if len(sizes) > 1:
        got = f"logs of (n_x, n_u) = {', '.join(map(str, sorted(sizes)))}"
        raise QPError.expected("trajectories", got, "logs of the same sizes", REMEDY)
    if not trajectories:
        raise QPError.expected("trajectories", "no steps", "logged steps", REMEDY)
    return trajectories


def _of_rows(data: Any, n_x: int | None, n_d: int) -> list[Trajectory]:
    """Return the trajectories in steps ``(T,)`` or ``(episodes, T)``."""
    if data.batch_dims not in (1, 2):
        got = f"shape {tuple(data.shape)}"
        raise QPError.expected("trajectories", got, "shape (T,) or (episodes, T)", REMEDY)
    steps = data if data.batch_dims == 2 else data.unsqueeze(0)
    valid = valid_steps(steps)
    y = _entry(steps, ("observation",), valid, n_x)
    u = _entry(steps, ("action",), valid)
    following = _entry(steps, NEXT, valid, n_x)
    if y.shape[-1] != following.shape[-1]:
        got = f"{following.shape[-1]} entries, but {y.shape[-1]} in observation"
        raise QPError.expected(_name(NEXT), got, "the same number in both")
    d = _entry(steps, ("preview",), valid, n_d, first=True) if n_d else u[..., :0]
    valid, ends = cuts(steps, n_x)
    trajectories = []
    for row in range(len(y)):
        start = 0
        for stop in (*(ends[row, :-1].nonzero().flatten() + 1).tolist(), y.shape[1]):
            if stop > start and valid[row, start:stop].all():
                outputs = torch.cat((y[row, start:stop], following[row, stop - 1 : stop]))
                trajectories.append(Trajectory(outputs, u[row, start:stop], d[row, start:stop]))
            start = stop
    return trajectories


def cuts(steps: Any, n_x: int | None = None) -> tuple[Tensor, Tensor]:
    """Return the steps that `as_log` keeps, and those that end a trajectory, ``(episodes, T)``."""
    y, following = (steps[key][..., -(n_x or 0) :].cpu() for key in ("observation", NEXT))
    valid, ends = valid_steps(steps), _flags(steps, ENDS, default=False)
    ends[:, :-1] |= (following[:, :-1] != y[:, 1:]).any(-1)
    for key in IDS:
        if (ids := steps.get(key, None)) is not None:
            ids = _narrow(key, ids, steps.shape)
            ends[:, :-1] |= ids[:, 1:] != ids[:, :-1]
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


def _entry(
    steps: Any, key: tuple[str, ...], valid: Tensor, width: int | None = None, first: bool = False
) -> Tensor:
    """Return the first or last ``width`` entries under ``key`` in float64, ``(episodes, T, n)``."""
    name, value = _name(key), steps.get(key, None)
    if value is None:
        present = ", ".join(_name(x) for x in steps.keys(True, True)) or "nothing"
        raise QPError.expected("trajectories", f"only {present}", f"an entry {name}", REMEDY)
    real = isinstance(value, Tensor) and not value.is_complex()
    if not real or value.ndim != steps.ndim + 1 or value.shape[-1] < (width or 1):
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        wanted = f"a real tensor {(*steps.shape, 'n')} with n >= {width or 1}"
        raise QPError.expected(name, got, wanted, REMEDY)
    value = ungraded(name, value).detach().to("cpu", torch.float64)
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


def _narrow(key: tuple[str, ...], value: Any, batch: torch.Size) -> Tensor:
    """Return one flag or id for each step; there are several for several agents, say."""
    if not isinstance(value, Tensor) or value.numel() != batch.numel():
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        expected = f"shape {tuple(batch)} or {(*batch, 1)}"
        raise QPError.expected(_name(key), got, expected, "Pass one for each step.")
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
