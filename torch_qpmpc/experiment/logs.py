"""Operations on a log of TorchRL: cut where it blows up, and filtered."""

import torch
from tensordict import TensorDictBase

from torch_qpmpc.envs import KalmanFilter
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.steps import MEASURED, NEXT, cuts, valid_steps

#: The largest size of an observation, relative to the largest in the first transitions.
GROWTH = 1e6


def without_blow_ups(log: TensorDictBase) -> tuple[TensorDictBase, int]:
    """Mask each episode of a log ``(T,)`` or ``(episodes, T)`` from its first diverging step on.

    An episode blows up where an observation or a reward is not finite, or an observation is larger
    than 1e6 times the largest of the log's first transitions. Return the log, with an entry
    ``mask`` if steps are masked, and the number of these episodes.
    """
    rows = log if log.batch_dims == 2 else log.unsqueeze(0)
    size = torch.maximum(*(rows[key].double().abs().amax(-1) for key in ("observation", NEXT)))
    limit = GROWTH * size[:, 0].nan_to_num(0.0, 0.0).amax()
    bad = ~(size <= limit) if limit > 0 else ~size.isfinite()
    if (reward := rows.get(("next", "reward"), None)) is not None:
        bad |= ~reward.reshape(bad.shape).isfinite()
    if not (bad & valid_steps(rows)).any():
        return log, 0
    done = rows.get(("next", "done"), torch.zeros_like(bad)).reshape(bad.shape)
    new = torch.nn.functional.pad(done, (1, 0))[:, :-1]
    first = torch.where(new, torch.arange(bad.shape[1]), 0).cummax(1).values
    count = bad.cumsum(1)
    count = count - (count - bad.long()).gather(1, first)  # bad steps of this episode so far
    masked = log.clone(recurse=False)
    masked["mask"] = (valid_steps(rows) & (count == 0)).reshape(log.shape)
    return masked, int((bad & (count == 1)).sum())


def estimated(log: TensorDictBase, observer: Innovations) -> TensorDictBase:
    """Return a log, ``(T,)`` or ``(episodes, T)``, with estimates in the place of its outputs.

    They begin anew where a trajectory of `as_log` does. The next outputs are in `MEASURED`.
    """
    rows = log if log.batch_dims == 2 else log.unsqueeze(0)
    y, following, u = (rows[key].double() for key in ("observation", NEXT, "action"))
    n_d = observer.E.shape[-1]
    d = rows["preview"][..., :n_d].double() if n_d else u[..., :0]
    (_, ends), model, pairs = cuts(rows), KalmanFilter(observer), []
    first, step = model.first(y), torch.zeros(len(y), dtype=torch.int64)
    x = first[:, 0]
    for k in range(y.shape[1]):
        after = model.following(x, u[:, k], d[:, k], following[:, k], step + 1)
        pairs.append((x, after))
        x = torch.where(ends[:, k, None], first[:, (k + 1) % y.shape[1]], after)
        step = torch.where(ends[:, k], 0, step + 1)
    now, after = (torch.stack(part, 1).reshape(*log.shape, -1) for part in zip(*pairs, strict=True))
    own = {"observation": now, NEXT: after, MEASURED: log[NEXT]}
    return log.clone(recurse=False).update(own)
