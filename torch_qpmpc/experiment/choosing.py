"""The choice of a start: two logs of the plant, and closed loops with the models of both."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Self

import pandas as pd
import torch
from scipy.special import stdtrit
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.experiment.logs import below
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks import AnyPlant, find_task, make_mpc
from torch_qpmpc.experiment.tasks.identified import Start, identified_start
from torch_qpmpc.files import damaged, write_whole
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.blended import identify_blended

#: Episodes of each start in the first round.
FEW = 4
#: The seeds of the episodes begin this far above the run's seed, away from an evaluation's.
APART = 10**6
#: The probability with which the chosen start costs less than zero action.
CONFIDENCE = 0.95
#: Blended models are among the starts if they leave less than this share of the held-out variance
#: that one model leaves unexplained.
BLENDED_SHARE = 0.8
#: The names of the candidates.
ESTIMATE, OUTPUTS, BLENDED = "MPC of the estimate", "MPC of the outputs", "blended models"
#: The end of the names of starts that are identified from the first log alone.
FIRST = ", first log"
#: The table in a run's folder.
STARTS = "starts.csv"
NOTHING = (
    "No start is shown to cost less than zero action, which is the start. Perhaps no scheme "
    "of these logs controls the plant: pass a log about the states where the controller is to work "
    "(start.file), one of short episodes if the plant is unstable (task.episode_steps=20), the "
    "plant's own cost (task.stage_weight), or a theta from a network: 'Scheduled and nonlinear "
    "plants' in the guides."
)


class Choice(NamedTuple):
    """The starts by name, best first, one of them ``chosen``: J, its standard ``error``, the count.

    The ``transitions`` are at most the steps of the ``episodes``.
    """

    table: pd.DataFrame

    @property
    def name(self) -> str:
        """The name of the chosen start."""
        chosen: Any = self.table["chosen"]
        return chosen[chosen].index.item()

    @property
    def scheme(self) -> str:
        """The name of the best start that is not zero action, with which learning begins."""
        return next(name for name in self.table.index if name != ZERO_ACTION)

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json."""
        total: Any = self.table["transitions"].sum()
        return {"start": self.name, "start_transitions": int(total)}

    def __str__(self) -> str:
        words: Any = dict.fromkeys(("J", "error"), cost_text)
        rows = self.table.to_string(columns=["episodes", *words], formatters=words)
        count = f"{self.summary['start_transitions']:,} transitions beside the logs'"
        lines = [rows, f"Chosen by at most {count}: {self.name}"]
        return "\n".join(lines + [NOTHING] * (self.name == ZERO_ACTION))

    def of(self, start: Start, physics: AnyPlant) -> Start:
        """Return the start of `scheme`, which holds zero action if that is chosen."""
        action = zero_action(physics)(physics.lb_a[None])[0]
        return start._replace(action=action if self.name == ZERO_ACTION else None, choice=self)

    def write(self, folder: Path) -> None:
        """Write the table into a run's folder."""
        write_whole(folder / STARTS, self.table.to_csv(index_label="start").encode())

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the table of a run; raise `QPError` if it is missing or damaged."""
        try:
            exact = dict.fromkeys(("J", "error"), float)  # pandas before 3.1 rounds
            choice = cls(pd.read_csv(folder / STARTS, index_col="start", converters=exact))
            _ = choice.name, choice.scheme
        except Exception as error:  # damaged files raise errors of any type
            want = "the table of starts that a run wrote"
            raise damaged(folder / STARTS, error, want, "Start a new run.") from error
        return choice


def candidates(cfg: Config, physics: AnyPlant, log: Any) -> dict[str, Start]:
    """Return at most three starts of a log by name.

    They are MPC of the estimate and of the outputs, each with the regulator's cost of x_N, and, at
    twice the horizon, models of the outputs that are blended where the plant is nonlinear.
    """
    estimate, N = identified_start(cfg, physics, log), cfg.task.horizon
    outputs = estimate if not estimate.order else identified_start(cfg, physics, log, order=0)
    named = ({ESTIMATE: estimate} if estimate.order else {}) | {OUTPUTS: outputs}
    for name, start in named.items() if cfg.task.hessian != "diagonal" else ():
        with contextlib.suppress(QPError):  # the model and the cost have no regulator
            regulated = start._replace(riccati=start.cost is not None)
            make_mpc(cfg, start.plant(physics), regulated)
            named[name] = regulated
    if not outputs.layout.n_d and cfg.constraint.si is None:
        blended = identify_blended(outputs.log, 2 * N)
        unexplained = {count: 1 - R2 for count, R2 in blended.R2.items()}
        if min(unexplained.values()) < BLENDED_SHARE * unexplained[1]:
            named[BLENDED] = outputs._replace(horizon=2 * N, blended=blended)
    return named


def choose(
    cfg: Config,
    physics: AnyPlant,
    log: Any,
    explored: Callable[[Start], TensorDictBase],
    quiet: bool = True,
) -> tuple[Start, TensorDictBase]:
    """Choose a start by closed loops on the plant; return it and the logs, one below the other.

    The `candidates` of the log have the same 4 episodes; ``explored`` collects a second log with
    the best one, and the candidates of both logs have these episodes, too. Then the best two have
    ``task.start_episodes`` in all, as zero action has. The best one is chosen if it costs less than
    zero action by a one-sided paired t-test of 95 %; if not, zero action is.
    """
    costs: dict[str, Tensor] = {}
    few, steps = min(FEW, cfg.task.start_episodes), 0

    def run(names: Iterable[str], count: int) -> None:
        nonlocal steps
        for name in names:
            done = costs.get(name, torch.zeros(0, dtype=torch.float64))
            if len(done) == count:
                continue
            plant = named[name].plant(physics)
            if name == ZERO_ACTION:
                policy = zero_action(plant)
            else:
                policy = warm_policy(make_mpc(cfg, plant, named[name]))
            options = {"steps": cfg.task.eval_steps, "gamma": cfg.task.gamma}
            options |= {"starts": count - len(done), "seed": APART + cfg.seed + len(done)}
            loop = find_task(cfg.task).closed_loop(policy, plant, **options).costs
            costs[name] = torch.cat((done, loop.sum(0).nan_to_num(torch.inf, torch.inf)))
            steps = len(loop)
            bar.update()

    def J(name: str) -> float:
        return costs[name].mean().item()

    def error(x: Tensor) -> float:
        return (x.std() / math.sqrt(len(x))).item()

    with tqdm(desc="starts", leave=False, disable=quiet or None) as bar:
        named = {f"{name}{FIRST}": start for name, start in candidates(cfg, physics, log).items()}
        run(named, few)
        log = below(log, explored(named[min(named, key=J)]))
        second = candidates(cfg, physics, log)
        named |= second
        run(second, few)
        finalists = sorted(named, key=J)[:2]
        named[ZERO_ACTION] = named[finalists[0]]
        run((*finalists, ZERO_ACTION), cfg.task.start_episodes)
    best = min(finalists, key=J)
    gain = costs[best] - costs[ZERO_ACTION]
    bound = gain.mean() + float(stdtrit(len(gain) - 1, CONFIDENCE)) * error(gain)
    chosen = best if gain.mean() == -math.inf or bound < 0 else ZERO_ACTION
    rows = [(len(x), J(name), error(x), steps * len(x)) for name, x in costs.items()]
    table = pd.DataFrame(rows, [*costs], ["episodes", "J", "error", "transitions"])
    table["chosen"] = table.index == chosen
    choice = Choice(table.sort_values(["episodes", "J"], ascending=[False, True], kind="stable"))
    return choice.of(named[best], physics), log


def chosen_before(cfg: Config, physics: AnyPlant, log: TensorDictBase, folder: Path) -> Start:
    """Return the start that the run in ``folder`` has chosen from its logs."""
    choice = Choice.read(folder)
    first = choice.scheme.endswith(FIRST)
    named = candidates(cfg, physics, log[: -cfg.num_envs] if first else log)
    if (start := named.get(choice.scheme.removesuffix(FIRST))) is None:
        raise QPError.expected(STARTS, f"{choice.scheme!r}", f"one of {', '.join(named)}")
    return choice.of(start, physics)
