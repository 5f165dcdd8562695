"""A run's metrics and figures: per update, per evaluation, and in the summary."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import pandas as pd
from numba.core.event import install_timer
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.analysis.report import structure_metrics
from torch_qpmpc.analysis.structure import distance_by_band
from torch_qpmpc.experiment.algorithms import Learner
from torch_qpmpc.experiment.evaluation import Evaluation, cost_text
from torch_qpmpc.experiment.gating import COMPARED, RunGate
from torch_qpmpc.experiment.plots import learned_episode_figure, summary_figure
from torch_qpmpc.experiment.rivals import scalar_name
from torch_qpmpc.experiment.run_folder import RunFolder
from torch_qpmpc.learning.updates import Scalars
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.pipeline.solve import SolveLog


@dataclass
class Tally:
    """Running totals over the updates of a run."""

    update: int = 0  # number of the last update
    costs: list[float] = field(default_factory=list)  # mean stage cost of each update
    #: Counts of solves since the last row of metrics.
    qps: SolveLog = field(default_factory=SolveLog)
    #: Numbers of unsolved QPs before that, and of updates that moved theta.
    unsolved: int = 0
    accepted: int = 0
    seconds: float = 0.0  # training time without the compilation of kernels

    def state_dict(self) -> dict[str, Any]:
        """Return the tally as plain numbers, for a checkpoint."""
        return asdict(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a `state_dict`."""
        vars(self).update(state, qps=SolveLog(**state["qps"]))

    @contextmanager
    def timed(self) -> Iterator[list[float]]:
        """Count an update's QPs, and list its times: the begin, those that are added, the end."""
        times, compiled = [time.perf_counter()], list[float]()
        with self.qps, install_timer("numba:compile", compiled.append):
            yield times
        times.append(time.perf_counter())
        self.seconds += times[-1] - times[0] - sum(compiled)

    def add(self, batch: TensorDictBase, terms: Mapping[str, Tensor]) -> None:
        """Add an update with its collected batch and the terms of its loss."""
        self.update += 1
        self.accepted += bool(terms["train/accepted"])
        self.costs.append(-batch["next", "reward"].nanmean().item())

    def metrics(self) -> dict[str, float]:
        """Return the scalars of a row; QPs are counted since the previous row."""
        row = {"train/reward": -self.costs[-1], **self.qps.metrics()}
        self.unsolved, self.qps = self.unsolved + self.qps.unsolved, SolveLog()
        return row

    def summary(self) -> dict[str, float]:
        """Return the totals: time, unsolved QPs, and the mean cost during training."""
        last = self.costs[-max(1, len(self.costs) // 10) :]
        return {
            "train_seconds": self.seconds,
            "train_cost": sum(self.costs) / len(self.costs),
            "train_cost_last_tenth": sum(last) / len(last),
            "unsolved": self.unsolved + self.qps.unsolved,
            "accepted_updates": self.accepted,
        }


#: Entries of the loss's output that are logged in addition to its terms.
LOGGED = ("td_error", "pred_value", "target_value", "unsolved", "invalid_reward")
#: Largest number of entries in a part of theta that is logged entry by entry.
FEW = 16


def update_metrics(
    terms: Mapping[str, Tensor],
    losses: Scalars,
    tally: Tally,
    times: Sequence[float],
    mpc: QPMPC,
    learner: Learner,
) -> dict[str, float]:
    """Return the scalars of an update; the QPs are counted since the last row."""
    metrics = {name: term.item() for name, term in terms.items()}
    metrics |= {
        f"train/{name}": x.double().mean().item() for name, x in losses.items() if name in LOGGED
    }
    metrics |= tally.metrics() | theta_metrics(mpc)
    if learner.penalties.deviation is not None:
        metrics["loss/deviation"] = learner.penalties.deviation(mpc.C).item()
    began, collected, ended = times
    return metrics | {"time/collect": collected - began, "time/update": ended - collected}


def run_summary(evaluation: Evaluation, tally: Tally, gate: RunGate) -> dict[str, Any]:
    """Return the content of summary.json, which is about the policy that is kept."""
    cfg, mpc = evaluation.cfg, gate.mpc
    summary = evaluation.summary() | gate.summary()
    summary |= {"seed": cfg.seed, "constraint": cfg.constraint.name, "noise": cfg.noise.name}
    summary |= {"task": cfg.task.name, "solver": cfg.solver}
    summary |= {"ablation": cfg.ablation, "step": cfg.step}
    summary |= {"updates": cfg.updates, **tally.summary()}
    physics = evaluation.physics
    if raised := getattr(physics, "raised", None):
        summary |= {"raised": len(raised), "first_raised": raised[0]}
    summary |= {"missing": dict(evaluation.missing)} if evaluation.missing else {}
    summary |= evaluation.entries
    return summary | {"canonical_distance": structure_metrics(mpc)["distance_to_mpc"]}


def report(run: RunFolder, mpc: QPMPC, evaluation: Evaluation, update: int) -> dict[str, Any]:
    """Log an evaluation: J and, after the first update, the structure of C; return its summary."""
    summary = evaluation.summary()
    scalars = {f"eval/{name}": summary[name] for name in ("J_true_model", "closed_gap")}
    scalars |= {f"eval/{name}": summary[f"{name}_best"] for name in ("J", "J_discounted")}
    scalars |= {f"eval/J_{scalar_name(name)}": J for name, J in evaluation.rivals.items()}
    if update:
        distances = distance_by_band(mpc) | structure_metrics(mpc)
        scalars |= {f"structure/{name}": distance for name, distance in distances.items()}
    run.log(scalars, update)
    return summary


def draw_outcome(run: RunFolder, mpc: QPMPC, evaluation: Evaluation) -> None:
    """Draw summary.png and episode.png."""
    with evaluation.optional("summary.png"):
        summary = summary_figure(mpc, evaluation, *run.column("eval/J"))
        summary.savefig(run.path / "summary.png", dpi=110)
    if evaluation.loops["learned"].known.isfinite().all():
        with evaluation.optional("episode.png"):
            learned_episode_figure(mpc, evaluation).savefig(run.path / "episode.png", dpi=110)


def theta_metrics(mpc: QPMPC) -> dict[str, float]:
    """Return the entries of theta's small parts by name."""
    few = {name: part for name, part in mpc.readable().items() if part.numel() <= FEW}
    return {
        f"theta/{name}_{i}" if part.ndim else f"theta/{name}": value
        for name, part in few.items()
        for i, value in enumerate(part.flatten().tolist())
    }


def table(summary: Mapping[str, Any]) -> str:
    """Format the outcome for the terminal."""
    rows = {}
    for name, tag in (("J", "J"), ("J discounted", "J_discounted")):
        start, final, true = (summary[f"{tag}_{end}"] for end in ("start", "best", "true_model"))
        gap = summary[f"closed_gap{tag.removeprefix('J')}"]
        why = "no true model" if math.isnan(true) else "no gap"
        share = why if math.isnan(gap) else f"{gap:.3f}"
        rows[name] = [*map(cost_text, (start, final, true)), share]
    head = ["start", "learned", "true model", "closed gap"]
    lines = [pd.DataFrame.from_dict(rows, orient="index", columns=head).to_string(col_space=10)]
    episodes, steps = summary["episodes"], summary["episode_steps"]
    lines.append(f"Mean cost of {episodes:,} episodes of at most {steps:,} steps")
    if rivals := summary["rivals"]:
        costs = pd.Series(rivals).map(cost_text)
        lines += ["", "J of the rivals", costs.to_string(header=False)]
    if summary.get("rejected") and not summary["accepted"]:
        kept = f"none of {summary['rejected']} candidates was shown to cost less"
        kept += f", the last one of which costs {cost_text(summary['J_final'])}"
        compared = next(f"{summary[x]:,} {x}" for x in COMPARED if x in summary)
        lines += ["", f"The gate kept the start: {kept}, by at most {compared} transitions."]
    if missing := summary.get("missing"):
        lines += ["", *(f"The run has no {name}: {why}" for name, why in missing.items())]
    if raised := summary.get("raised"):
        lines += ["", f"The plant ended {raised} episodes by exceptions: {summary['first_raised']}"]
    return "\n".join(lines)
