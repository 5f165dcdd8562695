"""Replay of transitions (TD loss) and of windows tau (SI penalty, eq:sdp3) from one storage.

The storage is two-dimensional, time by environment. A collector's ``[num_envs, T]`` batch adds T
rows, so that neighbouring rows of a column are neighbouring steps of one environment, however small
T is. (Flattened, the environments interleave, and no window fits into T < N steps.) A window ends
where the column's trajectory id changes, and at the ring's seam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyTensorStorage,
    RandomSampler,
    ReplayBuffer,
    SliceSampler,
)

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.program import UNKNOWN

#: Where a transition's active sets are: that of Q(s, a), and that of V(s+).
ACTIVE_SET = "active_set"
ACTIVE_SETS = (ACTIVE_SET, ("next", ACTIVE_SET))


def windows_to_tau(windows: TensorDictBase) -> Tensor:
    """tau = [s_j, a_j, s_{j+1}, ..., s_{j+N}] of eq:sdp3, in the order of z.

    Args:
        windows: ``(M, N)`` consecutive transitions along the last dimension, with
            ``observation`` ``(M, N, n_x)``, ``action`` and ``("next", "observation")``.

    Returns:
        ``(M, N (n_x + n_u) + n_x)``.
    """
    check_kind("windows", windows, TensorDictBase)
    for key in ("observation", "action", ("next", "observation")):
        if windows.get(key, None) is None or windows.batch_dims < 1:
            got = (
                f"shape {tuple(windows.shape)} with {', '.join(map(str, windows.keys(True, True)))}"
            )
            want = "consecutive transitions (M, N) with observation, action, (next, observation)"
            raise QPError.expected("windows", got, want)
    pairs = torch.cat([windows["observation"], windows["action"]], dim=-1)
    return torch.cat([pairs.flatten(-2), windows["next", "observation"][..., -1, :]], dim=-1)


@dataclass(frozen=True, eq=False)
class Replay:
    """Two TorchRL buffers over one storage, and the one generator that both sample with.

    Attributes:
        transitions: written by :meth:`extend`; samples single transitions uniformly.
        windows: read-only; samples a trajectory of at least N steps, then a start in it, both
            uniformly. It leaves the stored done flags as they are.
        generator: see :func:`make_replay`.
        window: N.
        num_envs: columns of the storage.
        active_rows: n_g, if the active sets of a transition's QPs are kept with it, else None.
    """

    transitions: ReplayBuffer
    windows: ReplayBuffer
    generator: torch.Generator
    window: int
    num_envs: int
    active_rows: int | None = None

    def __len__(self) -> int:
        return len(self.transitions)

    def extend(self, batch: TensorDictBase) -> None:
        """Store a collector's batch ``(num_envs, T)``; the oldest rows make room.

        Raises:
            QPError: ``batch`` is no TensorDict, or has another shape.
        """
        check_kind("batch", batch, TensorDictBase, "Pass the collector's batch as it comes.")
        if batch.batch_dims != 2:
            got, remedy = f"shape {tuple(batch.shape)}", "Pass the collector's batch as it comes."
            raise QPError.expected("batch", got, "(num_envs, T)", remedy)
        if batch.shape[0] != self.num_envs:
            got, want = (
                f"shape {tuple(batch.shape)}",
                f"(num_envs, T) with num_envs = {self.num_envs}",
            )
            raise QPError.expected("batch", got, want, "Is it (T, num_envs)? Transpose it.")
        if self.active_rows is not None:
            batch = batch.copy()
            for key in ACTIVE_SETS:
                unknown = torch.full((*batch.shape, self.active_rows), UNKNOWN, dtype=torch.int8)
                batch.set(key, unknown)
        self.transitions.extend(batch)

    def sample(self) -> TensorDictBase:
        """``(batch_size,)`` transitions, with their ``"index"`` ``(batch_size, 2)``."""
        if not len(self):
            raise QPError.expected("replay", "nothing stored", "transitions", "extend() it first.")
        sample, info = self.transitions.sample(return_info=True)
        return sample.set("index", torch.stack(info["index"], dim=-1))

    def remember(self, sample: TensorDictBase) -> None:
        """Keep the active sets that the loss found for a sample, for the next time it is drawn."""
        if self.active_rows is None:
            return
        for key in ("index", *ACTIVE_SETS):
            if sample.get(key, None) is None:
                remedy = "Pass what sample() returned, after the loss."
                raise QPError.expected("sample", f"no entry {key}", "one", remedy)
        stored: Any = self.transitions.storage[:]
        index = sample.get("index").unbind(-1)
        for key in ACTIVE_SETS:
            stored.get(key)[index] = sample.get(key)

    def has_windows(self) -> bool:
        """Whether any stored trajectory has the N steps of a window."""
        return self.windows.can_sample()

    def sample_tau(self) -> Tensor:
        """``(num_windows, N (n_x + n_u) + n_x)`` windows; see :func:`windows_to_tau`.

        Raises:
            QPError: no stored trajectory has N steps yet.
        """
        try:
            sample = self.windows.sample()
        except RuntimeError as error:
            # Asked afterwards only: looking for windows costs as much as sampling them.
            if self.has_windows():
                raise
            got = f"{len(self)} transitions without such a trajectory"
            remedy = "Collect more before sampling; has_windows() tells when."
            expected = f"{self.window} consecutive transitions"
            raise QPError.expected("replay", got, expected, remedy) from error
        return windows_to_tau(sample.reshape(-1, self.window))

    def state_dict(self) -> dict[str, Any]:
        """Stored data (not copied: save it at once), write position and generator."""
        return {
            "storage": self.transitions.storage.state_dict(),
            "writer": self.transitions.writer.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`, into a replay made with the same arguments."""
        missing = {"storage", "writer", "generator"} - set(state)
        if missing:
            got = f"no {', '.join(sorted(missing))}"
            raise QPError.expected("state", got, "what state_dict() returned")
        storage, writer = self.transitions.storage, self.transitions.writer
        storage.load_state_dict(state["storage"])
        writer.load_state_dict(state["writer"])
        self.generator.set_state(state["generator"].cpu())
        if len(self) == storage.max_size:
            # TorchRL saves the writer's position but not the storage's own record of it, which
            # keeps windows from crossing the ring's seam. Writing the newest row again restores it.
            newest = (state["writer"]["_cursor"] - 1) % storage.shape[0]
            storage.set(newest, storage.get(newest))


def make_replay(
    capacity: int,
    num_envs: int,
    batch_size: int,
    window: int,
    num_windows: int,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
    active_rows: int | None = None,
) -> Replay:
    """The replay of a training run; filled by :meth:`Replay.extend`.

    Args:
        capacity: transitions kept, over all environments; a multiple of ``num_envs``.
        num_envs: batch size of the collector's environment.
        batch_size: transitions a sample.
        window: N, transitions a window.
        num_windows: M, windows a sample.
        seed: of the replay's own generator. All sampling uses that one, never torch's global one.
        device: of the stored data and of the generator.
        active_rows: n_g, to keep the active sets of Q(s, a) and V(s+) with each transition, n_g
            bytes each, under `ACTIVE_SETS`; see :meth:`Replay.remember`.

    Raises:
        QPError: ``capacity`` is no multiple of ``num_envs``, or has fewer than ``window`` rows.
    """
    sizes = {"num_envs": num_envs, "batch_size": batch_size, "window": window}
    for name, size in (sizes | {"num_windows": num_windows}).items():
        check_whole(name, size, 1)
    check_whole("capacity", capacity, 0)
    check_whole("seed", seed, 0)
    if active_rows is not None:
        check_whole("active_rows", active_rows, 0)
    if capacity % num_envs or capacity // num_envs < window:
        expected = f"a multiple of num_envs = {num_envs}, at least window * num_envs"
        remedy = f"{window * num_envs} is the least."
        raise QPError.expected("capacity", capacity, expected, remedy)
    generator = torch.Generator(device=device).manual_seed(seed)
    storage = LazyTensorStorage(capacity, ndim=2, device=device)
    # ReplayBuffer, not TensorDictReplayBuffer: that one fails on batches with T = 1.
    transitions = ReplayBuffer(
        storage=storage, sampler=RandomSampler(), batch_size=batch_size, generator=generator
    )
    windows = ReplayBuffer(
        storage=storage,
        sampler=SliceSampler(
            slice_len=window,
            traj_key=("collector", "traj_ids"),
            truncated_key=None,  # otherwise each window's last step comes back as truncated
            init_key=None,
            strict_length=True,
        ),
        writer=ImmutableDatasetWriter(),
        batch_size=num_windows * window,
        generator=generator,
    )
    return Replay(transitions, windows, generator, window, num_envs, active_rows)
