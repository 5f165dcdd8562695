"""Learn a quadratic program as value function by Q-learning.

    python train.py                                     the paper's point mass: deviation, seed 1
    python train.py constraint=free noise=brownian      one of the paper's cases
    python train.py constraint=mpc                      its linear MPC scheme, tied
    python train.py task=gros_zanon solver=daqp         another plant, from one long episode
    python train.py -m constraint=fixed,free seed=1,2   a sweep
    python train.py -m +study=paper                     the paper's study; goes on where it stopped
    tensorboard --logdir runs                           watch it

configs/ holds every key. The run's folder gets config.yaml, metrics.csv, TensorBoard events,
checkpoint.pt, summary.png and summary.json.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from torchrl import torchrl_logger
from tqdm import tqdm

from torch_qpmpc import QPActorValueOperator, QPError, SolveLog
from torch_qpmpc.checkpoint import save_checkpoint
from torch_qpmpc.config import check_config
from torch_qpmpc.experiment import (
    decay,
    evaluate,
    make_collector,
    make_learner,
    report,
    stream_summary,
    table,
    theta_metrics,
)
from torch_qpmpc.plots import summary_figure
from torch_qpmpc.replay import ACTIVE_SET, make_replay
from torch_qpmpc.sweeps import finished_run
from torch_qpmpc.tasks import make_mpc, make_physics, make_true_mpc
from torch_qpmpc.tracking import RunFolder


def train(cfg: DictConfig, folder: str, quiet: bool = False) -> dict[str, Any]:
    """One run; returns what summary.json holds. ``quiet``: prints nothing."""
    check_config(cfg)
    torchrl_logger.setLevel("WARNING")
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)

    # The QP, between its two ends: the wrong model it starts from, and the true one.
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    loops = {
        "start": evaluate(cfg, mpc, physics),
        "true model": evaluate(cfg, make_true_mpc(cfg, physics), physics),
    }

    # Q-learning, by gradients or of the second order.
    operator = QPActorValueOperator(mpc, active_set_key=ACTIVE_SET if cfg.warm_start else None)
    learner = make_learner(cfg, operator)

    # Data: vectorised episodes under today's policy, and one replay for transitions and windows.
    collector = make_collector(cfg, physics, operator)
    replay = make_replay(
        cfg.replay_capacity,
        cfg.num_envs,
        cfg.batch_size,
        cfg.task.horizon,
        1 if learner.si is None else cfg.constraint.si.windows,
        seed=cfg.seed,
        active_rows=len(mpc.G) if cfg.warm_start else None,
    )
    batches = iter(collector)
    for batch in itertools.islice(batches, -(-cfg.warmup_steps // cfg.steps_per_update)):
        if cfg.replay:
            replay.extend(batch)

    qps, unsolved, train_seconds, costs, violation = SolveLog(), 0, 0.0, [], 0.0
    with contextlib.ExitStack() as stack:
        stack.callback(collector.shutdown)
        run = stack.enter_context(RunFolder(folder, cfg))
        run.log({"eval/J": loops["start"].J, "eval/J_true_model": loops["true model"].J}, 0)
        label = f"{cfg.constraint.name}, {cfg.noise.name}"
        progress = tqdm(range(1, cfg.updates + 1), desc=label, disable=quiet)
        for update in progress:
            began = time.perf_counter()
            with qps:
                batch = next(batches)
                if cfg.replay:
                    replay.extend(batch)
                collected = time.perf_counter()

                sample = replay.sample() if cfg.replay else batch.reshape(-1)
                windows = None if learner.si is None else replay.sample_tau()
                terms, losses = learner.learn(sample, windows)
                if cfg.replay:
                    replay.remember(sample)
                if learner.deviation is not None and cfg.penalty_step == "proximal":
                    # The penalty's weight falls with the rates, so that their ratio is kept.
                    share = decay(update - 1, cfg.updates, cfg.optimizer.final_fraction)
                    learner.deviation.proximal_step_(mpc.C, share)
                learner.schedule.step()
                if learner.target is not None:
                    learner.target.step()
            ended = time.perf_counter()
            train_seconds += ended - began
            costs.append(-batch["next", "reward"].mean().item())
            violation += physics.violation(batch["observation"]).sum().item()

            if update % cfg.log_interval == 0:
                metrics = {name: term.item() for name, term in terms.items()}
                metrics |= {f"train/{name}": losses[name].item() for name in LOGGED}
                metrics |= {"train/reward": -costs[-1], "train/violation": violation}
                metrics |= qps.metrics() | theta_metrics(mpc)
                if learner.deviation is not None:
                    metrics.setdefault("loss/deviation", learner.deviation(mpc.C).item())
                metrics |= {"time/collect": collected - began, "time/update": ended - collected}
                run.log(metrics, update)
                unsolved, qps = unsolved + qps.unsolved, SolveLog()
            if update % cfg.eval_interval == 0 or update == cfg.updates:
                loops["learned"] = evaluate(cfg, mpc, physics)
                summary = report(run, mpc, loops, update)
                progress.set_postfix(J=summary["J_final"], closed_gap=summary["closed_gap"])
                state = {"mpc": mpc.state_dict(), "optimizer": learner.optimizer.state_dict()}
                state |= {"structure": mpc.structure, "update": update}
                save_checkpoint(run.path / "checkpoint.pt", state)
                run.flush()
            if update == cfg.release:
                mpc.release()
                learner = make_learner(cfg, operator, done=update)
        summary |= {"seed": cfg.seed, "constraint": cfg.constraint.name, "noise": cfg.noise.name}
        summary |= {"solver": cfg.solver, "updates": cfg.updates, "train_seconds": train_seconds}
        summary |= stream_summary(costs, violation)
        summary["unsolved"] = unsolved + qps.unsolved
        run.finish(summary)
        if cfg.figures:
            figure = summary_figure(mpc, loops, *run.column("eval/J"))
            figure.savefig(run.path / "summary.png", dpi=110)
    if not quiet:
        print(f"\n{table(summary)}\n\n{run.path}")
    return summary


#: What the loss module tells of itself.
LOGGED = ("td_error", "pred_value", "target_value", "unsolved")


@hydra.main(version_base="1.3", config_path="configs", config_name="config")
def main(cfg: DictConfig) -> float:
    """Train; a sweep's optimiser maximises the closed gap that this returns."""
    folder, sweep = HydraConfig.get().runtime.output_dir, HydraConfig.get().mode is RunMode.MULTIRUN
    try:
        check_config(cfg)
        done = finished_run(folder, cfg) if sweep else None
    except QPError as error:
        if sweep:
            raise  # an exit would end the other runs, too
        raise SystemExit(str(error)) from None
    return (done or train(cfg, folder, quiet=sweep))["closed_gap"]


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit("\nstopped") from None
