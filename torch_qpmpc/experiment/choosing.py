"""The choice of a start: linear and nonlinear MPC of a log, beside zero action on the plant."""

from contextlib import suppress
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.evaluation import cost_text
from torch_qpmpc.experiment.rivals import ZERO_ACTION, zero_action
from torch_qpmpc.experiment.tasks import AnyPlant, make_mpc
from torch_qpmpc.experiment.tasks.identified import Start, identified_start, nonlinear_start
from torch_qpmpc.learning.gate import PairedTest
from torch_qpmpc.learning.operators import warm_policy

#: The seeds of the episodes begin this far above the run's seed, away from an evaluation's.
APART = 10**6
#: The probability that a start which is no better than zero action is chosen; and the most episodes
#: of each, in ``task.start_episodes``, or their number: the test needs about 30 at least.
ALPHA, MOST, LEAST = 0.05, 8, 64
#: The names of the candidates.
LINEAR, REGULATOR, NONLINEAR = "linear MPC", "linear MPC, regulator's end", "nonlinear MPC"
#: The table in a run's folder.
STARTS = "starts.csv"
NOTHING = (
    "No candidate is shown to beat zero action, so learning starts from it. Where one costs less "
    "here, allow more episodes (task.start_episodes). Else pass a log about the states where the "
    "controller is to work (start.file), one of short episodes if the plant is unstable "
    "(task.episode_steps=20), or the plant's own cost (task.stage_weight)."
)


class Choice(NamedTuple):
    """The names of the chosen start and of its scheme, with zero action the best linear one's.

    The ``table`` has the candidates by name, best first, one of them ``chosen``: J, its ``error``,
    the counts. The ``transitions`` are at most the steps of the ``episodes``.
    """

    name: str
    scheme: str
    table: pd.DataFrame

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json."""
        total: Any = self.table["transitions"].sum()
        return {"start": self.name, "start_transitions": int(total)}

    def __str__(self) -> str:
        words: Any = dict.fromkeys(("J", "error"), cost_text)
        rows = self.table.to_string(columns=["episodes", *words], formatters=words)
        count = f"{self.summary['start_transitions']:,} transitions beside the log's"
        lines = [rows, f"Chosen by at most {count}: {self.name}"]
        return "\n".join(lines + [NOTHING] * (self.name == ZERO_ACTION))


def candidates(cfg: Config, physics: AnyPlant, log: Any) -> dict[str, Start]:
    """Return the starts of a log by name: linear MPC, with each cost of x_N, and nonlinear MPC.

    Beside the regulator's on an estimate with hidden states, the stage's is on the outputs.
    """
    start = identified_start(cfg, physics, log)
    outputs = identified_start(cfg, physics, log, order=0) if start.order else start
    named = {LINEAR: start}
    if start.cost is not None and cfg.task.hessian != "diagonal":
        with suppress(QPError):  # the model and the cost have no regulator
            regulated = start._replace(riccati=True)
            make_mpc(cfg, physics.observed(start.observer), regulated)
            named |= {REGULATOR: regulated, LINEAR: outputs}
    if (nonlinear := nonlinear_start(cfg, physics, outputs)) is not None:
        named[NONLINEAR] = nonlinear
    return named


def choose(cfg: Config, physics: AnyPlant, log: Any, quiet: bool = True) -> Start:
    """Return the best of the `candidates`, or zero action, by closed loops on the plant.

    All have the same episodes. The best one then has more of them, beside zero action, until the
    gate's test decides: it is chosen if it costs less.
    """
    named = candidates(cfg, physics, log)
    with tqdm(desc="starts", leave=False, disable=quiet or None) as bar:
        choice = _compared(cfg, physics, named, bar)
    action = zero_action(physics)(physics.lb_a[None])[0] if choice.name == ZERO_ACTION else None
    return named[choice.scheme]._replace(action=action, choice=choice)


def _compared(cfg: Config, physics: AnyPlant, named: dict[str, Start], bar: Any) -> Choice:
    """Compare the candidates with each other, and the best one with zero action."""
    costs: dict[str, Tensor] = {}
    few, steps = cfg.task.start_episodes, 0

    def run(name: str) -> None:
        """Add ``few`` episodes to the costs."""
        nonlocal steps
        bar.set_postfix_str(name)
        start, done = named.get(name), costs.get(name, torch.zeros(0, dtype=torch.float64))
        plant = physics if start is None else physics.observed(start.observer)
        policy = zero_action(plant) if start is None else warm_policy(make_mpc(cfg, plant, start))
        loop = evaluate(cfg, policy, plant, APART + cfg.seed + len(done), starts=few).costs
        costs[name] = torch.cat((done, loop.sum(0).nan_to_num(torch.inf, torch.inf)))
        steps = len(loop)
        bar.update()

    def J(name: str) -> float:
        return costs[name].mean().item()

    for name in (*named, ZERO_ACTION):
        run(name)
    best, better = min(named, key=J), False
    while J(best) < J(ZERO_ACTION):
        zero = costs[ZERO_ACTION]
        gain = torch.where(zero.isfinite(), costs[best] - zero, -torch.inf)
        test = PairedTest(2 * ALPHA)
        test.add(gain)
        # The episodes of a plant without chance are equal; one alone does not show it.
        equal = len(gain) > 1 and gain.max() - gain.min() <= 1e-9 * gain.abs().mean()
        better = test.decision == "better" or bool(equal)
        if better or test.decision == "worse" or len(gain) >= max(MOST * few, LEAST):
            break
        run(best)
        run(ZERO_ACTION)
    chosen = best if better else ZERO_ACTION
    error = {k: (x.var(correction=0) / (len(x) - 1)).sqrt().item() for k, x in costs.items()}
    rows = [
        (len(x), J(name), error[name], steps * len(x), name == chosen) for name, x in costs.items()
    ]
    table = pd.DataFrame(rows, [*costs], ["episodes", "J", "error", "transitions", "chosen"])
    table = table.sort_values(["episodes", "J"], ascending=[False, True], kind="stable")
    linear = next(name for name in table.index if name in (LINEAR, REGULATOR))
    return Choice(chosen, best if better else linear, table)
