"""``start=data``: the log that C and b are identified from, collected by exploration or loaded."""

import io
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.choosing import STARTS, choose
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.logs import estimated, without_blow_ups
from torch_qpmpc.experiment.tasks import AnyPlant
from torch_qpmpc.experiment.tasks.identified import Start, identified_start
from torch_qpmpc.files import load_file, read_tensors, reading, save_file, write_whole
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.learning.replay import Replay

#: The log in a run's folder.
LOG = "log.pt"
#: The model of a run's observer in its folder.
OBSERVER = "observer.pt"
#: The entries of a log; the preview is optional.
NEXT = ("observation", "reward", "done", "terminated", "truncated")
ENTRIES = ("observation", "preview", "action", *(("next", name) for name in NEXT))
WANTED = "a log.pt that train.py start=data wrote"
FORMAT = "For one of your own see 'From logged data' in the guides."


class Exploration(nn.Module):
    """Random actions that stay constant for a random number of steps.

    At each step, each entry of each episode's action keeps its level or, with probability
    1 / ``hold``, gets a new one, uniform within the bounds ``(n_u,)``.
    """

    def __init__(self, low: Tensor, high: Tensor, hold: float, seed: int) -> None:
        super().__init__()
        if not (low.isfinite() & high.isfinite()).all():
            got = f"actions from {low.tolist()} to {high.tolist()}"
            remedy = "Collect a log with actions of your own, and pass it as start.file."
            raise QPError.expected("start", got, "finite bounds to explore between", remedy)
        self.low, self.high, self.hold = low, high, hold
        self.generator = torch.Generator().manual_seed(seed)
        self.action: Tensor | None = None

    def forward(self, observation: Tensor) -> Tensor:
        """Return the next action ``(*batch, n_u)`` for any observation ``(*batch, n)``."""
        shape = (*observation.shape[:-1], len(self.low))
        level, change = torch.rand((2, *shape), generator=self.generator, dtype=torch.float64)
        level = self.low + level * (self.high - self.low)
        if self.action is not None:
            level = torch.where(change < 1 / self.hold, level, self.action)
        self.action = level
        return level.to(observation.dtype)


def make_start(
    cfg: Config, physics: AnyPlant, folder: str | Path, quiet: bool = True
) -> Start | None:
    """Identify the start of a run from a log of the plant; None with ``start=model``.

    Closed loops may choose it; the run's folder keeps the log, the observer and their table.
    """
    path = Path(folder) / LOG
    path.with_name(OBSERVER).unlink(missing_ok=True)  # of a run that ended before its config.yaml
    if cfg.start.name != "data":
        return None
    if cfg.start.file is not None:
        log = stored_log(cfg.start.file, "start.file", FORMAT)
    else:
        log = collect_log(cfg, physics)
    if not cfg.task.start_episodes:
        start = identified_start(cfg, physics, log)
    else:
        start = choose(cfg, physics, log, quiet)
    buffer = io.BytesIO()
    torch.save(log.to_dict(), buffer)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, buffer.getbuffer())
    if start.observer is not None:
        content = {name: torch.as_tensor(x) for name, x in start.observer._asdict().items()}
        save_file(path.with_name(OBSERVER), "observer", content)
    if start.choice is not None:
        rows = start.choice.table.to_csv(index_label="start")
        write_whole(path.with_name(STARTS), rows.encode())
    if not quiet:
        print(start)
    return start


@torch.no_grad()
def collect_log(cfg: Config, physics: AnyPlant) -> TensorDict:
    """Collect ``cfg.start.transitions`` of `Exploration` in the run's environments."""
    options = cfg.start
    assert options.name == "data"
    env = physics.vectorised(cfg.num_envs, cfg.task.episode_steps, seed=cfg.seed)
    explore = Exploration(physics.lb_a, physics.ub_a, options.hold, cfg.seed)
    module = TensorDictModule(explore, ["observation"], ["action"])
    steps = -(-options.transitions // cfg.num_envs)
    log = env.rollout(steps, module, break_when_any_done=False).contiguous()
    env.close()
    return log.select(*ENTRIES, strict=False)


def transitions(cfg: Config, folder: str | Path, replay: Replay) -> list[TensorDictBase]:
    """Return the logged steps of a run: those that it starts from, and those in its replay."""
    steps, _ = without_blow_ups(replay.steps().select(*ENTRIES, strict=False))
    if cfg.start.name != "data":
        return [steps]
    log, _ = without_blow_ups(stored_log(Path(folder) / LOG))
    observer = read_observer(folder)
    return [log if observer is None else estimated(log, observer), steps]


def read_observer(folder: str | Path) -> Innovations | None:
    """Read the model of a run's observer; None if the run has none."""
    path = Path(folder) / OBSERVER
    if not path.exists():
        return None
    content = load_file(path, "observer", "train.py")
    with reading(path, "the observer that a run wrote"):
        return Innovations(*(content[name].numpy() for name in Innovations._fields))


def stored_log(path: str | Path, name: str = LOG, remedy: str = "") -> TensorDict:
    """Read a log of `collect_log`, a nested dict of tensors, which errors call ``name``."""
    wrong = partial(QPError.expected, name, expected=WANTED, remedy=remedy)
    try:
        stored = read_tensors(Path(path))
    except Exception as error:  # damaged files raise errors of any type
        raise wrong(f"{path}, which cannot be read ({type(error).__name__})") from error
    try:
        log = TensorDict(stored, batch_size=stored["action"].shape[:-1])
        _ = log["observation"], log["next", "observation"]
    except Exception as error:  # files of something else raise errors of any type, too
        raise wrong(f"{path} ({error})") from error
    return log
