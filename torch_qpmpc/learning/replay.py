"""Replay of transitions (TD loss) and of windows tau (SI penalty, eq:sdp3) from one storage.

The storage is two-dimensional, time by environment. A collector's ``[num_envs, T]`` batch adds T
rows, so that neighbouring rows of a column are neighbouring steps of one environment. No window
crosses a change of its column's trajectory id, or the ring buffer's seam.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyTensorStorage,
    RandomSampler,
    ReplayBuffer,
    SliceSampler,
)

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.subspace import EXACT
from torch_qpmpc.qp.program import UNKNOWN

#: The keys of a transition's active sets: of Q(s, a), and of V(s+).
ACTIVE_SET = "active_set"
ACTIVE_SETS = (ACTIVE_SET, ("next", ACTIVE_SET))


def windows_to_tau(windows: TensorDictBase, preview_key: NestedKey | None = None) -> Tensor:
    """Return tau = [p_j, a_j, s_{j+1}, .., s_{j+N}] of eq:sdp3, ``(M, n_p + N (n_x + n_u))``.

    ``windows`` are ``(M, N)`` consecutive transitions along the last dimension. With a
    ``preview_key``, p is the preview and the observation.
    """
    p = [windows[x][..., 0, :] for x in (preview_key, "observation") if x is not None]
    pairs = torch.cat([windows["action"], windows["next", "observation"]], dim=-1)
    return torch.cat([*p, pairs.flatten(-2)], dim=-1)


def walk(steps: TensorDictBase, preview_key: NestedKey | None = None) -> float:
    """Return the size of the noise relative to its steps if it is a random walk, else zero.

    Least squares fit a linear model of the next states, and one of their changes, to consecutive
    steps ``(count, T)``. Changes of white noise have twice its variance; those of a walk are white.
    So the noise is a walk if the model of changes leaves less than half of the variance, in the
    geometric mean over the states. A variance below `EXACT` times a state's counts as zero.
    """
    keys = (preview_key, "observation", "action")
    x = torch.cat([steps[key].double() for key in keys if key is not None], -1)
    s, y = steps["observation"].double(), steps["next", "observation"].double()
    follows = (y[:, :-1] == s[:, 1:]).all(-1)  # neither an end nor the ring's seam is between
    changes = x.diff(dim=1)[follows], y.diff(dim=1)[follows]
    x, y = x[:, 1:][follows], y[:, 1:][follows]
    if len(y) < 2 * (x.shape[-1] + 1):
        return 0.0
    x, y = x - x.mean(0), y - y.mean(0)
    least = (EXACT * y.square().mean(0)).clamp(min=torch.finfo(torch.float64).tiny)

    def variances(x: Tensor, y: Tensor) -> Tensor:
        x = torch.nan_to_num(x / x.square().mean(0).sqrt())  # constant signals explain nothing
        rest = y - x @ torch.linalg.lstsq(x, y, driver="gelsd").solution
        return rest.square().mean(0).maximum(least)

    ratio = (variances(x, y) / variances(*changes)).log().mean().exp().item()
    return ratio**0.5 if ratio > 2 else 0.0


class Replay:
    """Two TorchRL buffers with one storage and one random generator.

    Args:
        capacity: number of stored transitions over all environments; a multiple of ``num_envs``.
        num_envs: number of columns, the batch size of the collector's environment.
        batch_size: transitions per sample.
        window: N, transitions per window.
        num_windows: M, windows per sample.
        seed: seed of the replay's generator, which all sampling uses instead of torch's global one.
        active_rows: n_g, to store the active sets of Q(s, a) and V(s+) with each transition, n_g
            bytes each, under `ACTIVE_SETS`; see `remember`.
        preview_key: see `windows_to_tau`.

    Attributes:
        transitions: the buffer that `extend` writes; samples single rows uniformly.
        windows: the read-only buffer that samples a trajectory of at least N steps, then a start in
            it, both uniformly, without changing the stored done flags.

    Raises:
        QPError: ``capacity`` is no multiple of ``num_envs``, or holds fewer than ``window`` rows.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        batch_size: int,
        window: int,
        num_windows: int,
        *,
        seed: int = 0,
        active_rows: int | None = None,
        preview_key: NestedKey | None = None,
    ) -> None:
        if capacity % num_envs or capacity // num_envs < window:
            expected = f"a multiple of num_envs = {num_envs}, at least window * num_envs"
            remedy = f"The smallest is {window * num_envs}."
            raise QPError.expected("capacity", capacity, expected, remedy)
        self.window, self.num_envs, self.active_rows = window, num_envs, active_rows
        self.preview_key = preview_key
        self.generator = torch.Generator().manual_seed(seed)
        storage = LazyTensorStorage(capacity, ndim=2, device="cpu")
        options: dict[str, Any] = {"storage": storage, "generator": self.generator}
        # ReplayBuffer, not TensorDictReplayBuffer: that one fails on batches with T = 1.
        self.transitions = ReplayBuffer(sampler=RandomSampler(), batch_size=batch_size, **options)

        def windows(steps: int) -> ReplayBuffer:
            sampler = SliceSampler(
                slice_len=steps,
                traj_key=("collector", "traj_ids"),
                truncated_key=None,  # a key would mark each window's last step as truncated
                init_key=None,
                strict_length=True,
            )
            own = {"sampler": sampler, "writer": ImmutableDatasetWriter()}
            return ReplayBuffer(batch_size=num_windows * steps, **{**options, **own})

        self.windows, self._longer = windows(window), windows(window + 1)

    def __len__(self) -> int:
        return len(self.transitions)

    def extend(self, batch: TensorDictBase) -> None:
        """Store a collector's batch ``(num_envs, T)``; a full storage drops its oldest rows."""
        if self.active_rows is not None:
            batch = batch.copy()
            for key in ACTIVE_SETS:
                unknown = torch.full((*batch.shape, self.active_rows), UNKNOWN, dtype=torch.int8)
                batch.set(key, unknown)
        self.transitions.extend(batch)

    def sample(self) -> TensorDictBase:
        """Sample transitions, each with its row and column as ``"index"`` ``(batch_size, 2)``."""
        sample, info = self.transitions.sample(return_info=True)
        return sample.set("index", torch.stack(info["index"], -1))

    def remember(self, sample: TensorDictBase) -> None:
        """Store the active sets that the loss wrote into a sample, for its next draw."""
        if self.active_rows is None:
            return
        stored: Any = self.transitions.storage[:]
        place = sample["index"].unbind(-1)
        for key in ACTIVE_SETS:
            stored.get(key)[place] = sample[key]

    def end_episodes(self) -> None:
        """Make the stored trajectory ids differ from a new collector's, which are >= 0."""
        if len(self):
            stored: Any = self.transitions.storage[:]
            ids = stored.get(("collector", "traj_ids"))
            ids -= ids.max() + 1

    def steps(self) -> TensorDictBase:
        """Return all stored transitions in the order of the storage, ``(num_envs, T)``."""
        stored: Any = self.transitions.storage[:]
        return stored.transpose(0, 1)

    def sample_tau(self) -> Tensor:
        """Sample windows ``(num_windows, n_p + N (n_x + n_u))``; see `windows_to_tau`.

        If the noise is a `walk`, they are pairs of neighbours, ``(num_windows, 2, ..)``, in a unit
        in which the differences of their errors, its steps, are of the noise's own size.
        """
        key = self.preview_key
        size = walk(self.steps(), key) if self._longer.can_sample() else 0.0
        if not size:
            return windows_to_tau(self.windows.sample().reshape(-1, self.window), key)
        longer = self._longer.sample().reshape(-1, self.window + 1)
        pairs = (longer[:, :-1], longer[:, 1:])
        return size * torch.stack([windows_to_tau(x, key) for x in pairs], 1)

    def state_dict(self) -> dict[str, Any]:
        """Return the stored data (not copied: save them at once), write position and generator."""
        return {
            "storage": self.transitions.storage.state_dict(),
            "writer": self.transitions.writer.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict` into a replay made with the same arguments."""
        storage, writer = self.transitions.storage, self.transitions.writer
        storage.load_state_dict(state["storage"])
        writer.load_state_dict(state["writer"])
        self.generator.set_state(state["generator"])
        if len(self) == storage.max_size:
            # TorchRL saves the writer's position but not the storage's copy of it, which keeps
            # windows from crossing the ring's seam. Writing the newest row again restores the copy.
            newest = (state["writer"]["_cursor"] - 1) % storage.shape[0]
            storage.set(newest, storage.get(newest))
