"""Learn a quadratic program as value function by Q-learning.

    python train.py                                     the paper's point mass: deviation, seed 1
    python train.py constraint=free noise=brownian      one of the paper's cases
    python train.py constraint=mpc                      its linear MPC scheme, tied
    python train.py task=gros_zanon solver=daqp         another plant, from one long episode
    python train.py -m constraint=fixed,free seed=1,2   a sweep
    python train.py resume=runs/point_mass/..           go on with a run that was stopped
    python train.py -m +study=paper                     the paper's study; goes on where it stopped
    tensorboard --logdir runs                           watch it

configs/ holds every key. The run's folder gets config.yaml, metrics.csv, TensorBoard events,
checkpoint.pt, summary.png and summary.json.
"""

from __future__ import annotations

import contextlib
import itertools
import signal
import sys
import threading
import time
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from numba.core.event import install_timer
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger
from tqdm import tqdm

from torch_qpmpc import QPActorValueOperator, QPError, SolveLog
from torch_qpmpc.experiment.algorithms import (
    act,
    evaluate,
    gap_summary,
    make_learner,
    report,
    structure_summary,
    table,
    theta_metrics,
)
from torch_qpmpc.experiment.checkpoint import CHECKPOINT, drop_previous, save_checkpoint
from torch_qpmpc.experiment.collection import batches, make_collector, num_columns
from torch_qpmpc.experiment.config import check_config
from torch_qpmpc.experiment.interrupt import Interrupt
from torch_qpmpc.experiment.lock import ELSEWHERE, ELSEWHERE_IN_SWEEP, locked
from torch_qpmpc.experiment.plots import summary_figure
from torch_qpmpc.experiment.run_folder import RunFolder, unwritable
from torch_qpmpc.experiment.run_state import (
    Tally,
    check_fresh,
    check_own_folder,
    folder_of,
    restore,
    resumed,
    snapshot,
)
from torch_qpmpc.experiment.sweeps import finished_run, stopped_run
from torch_qpmpc.experiment.tasks import make_mpc, make_physics, make_true_mpc, true_model
from torch_qpmpc.learning.replay import ACTIVE_SET, make_replay


def train(
    cfg: DictConfig, folder: str, state: dict[str, Any] | None = None, quiet: bool = False
) -> dict[str, Any]:
    """One run, from its beginning or from a checkpoint's ``state``.

    ``quiet``, as one run of a sweep is, it prints nothing, and leaves signals to the launcher.

    Returns:
        What summary.json holds.
    """
    check_config(cfg)
    interrupt = Interrupt()
    with contextlib.nullcontext() if quiet else interrupt:
        return _train(cfg, folder, state, quiet, interrupt)


def _train(
    cfg: DictConfig, folder: str, state: dict[str, Any] | None, quiet: bool, interrupt: Interrupt
) -> dict[str, Any]:
    torchrl_logger.setLevel("WARNING")
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)

    # The QP, between its two ends: the wrong model it starts from, and the true one.
    physics = make_physics(cfg)
    mpc = make_mpc(cfg, physics)
    start = evaluate(cfg, mpc.policy, physics)
    loops = {"start": start, "learned": start}
    if (true_mpc := make_true_mpc(cfg, physics)) is not None:
        loops["true model"] = evaluate(cfg, true_mpc.policy, physics)

    # Q-learning, by gradients or of the second order, or a policy gradient.
    operator = QPActorValueOperator(mpc, active_set_key=ACTIVE_SET if cfg.warm_start else None)
    released = state is not None and state["structure"] != mpc.structure
    if released:
        mpc.release()
    learner = make_learner(cfg, operator, physics, done=cfg.release if released else 0)
    learned_mpc = mpc if cfg.algo.name == "qlearning" or cfg.algo.actor == "qp" else None

    # Data: vectorised episodes under today's policy, and one replay for transitions and windows.
    collector = make_collector(cfg, physics, learner.actor)
    replay = make_replay(
        cfg.replay_capacity,
        num_columns(cfg),
        cfg.batch_size,
        cfg.task.horizon,
        1 if learner.si is None else cfg.constraint.si.windows,
        seed=cfg.seed,
        active_rows=len(mpc.G) if cfg.warm_start else None,
    )
    stream = batches(collector)

    with contextlib.ExitStack() as stack:
        stack.callback(collector.shutdown)
        run = stack.enter_context(
            RunFolder(folder, cfg, None if state is None else state["update"])
        )
        go_on = f"python train.py resume={run.path}"
        if state is not None:
            tally = restore(state, mpc, learner, collector, replay)
            if state["collector"] is None and tally.update < cfg.updates and not quiet:
                print("New episodes: the environments' own state cannot be saved.")
            loops["learned"] = evaluate(cfg, partial(act, learner.actor), physics)
        else:
            tally = Tally()
            report(run, learned_mpc, loops, 0)
            for batch in itertools.islice(stream, -(-cfg.warmup_steps // cfg.steps_per_update)):
                if cfg.replay:
                    replay.extend(batch)
                interrupt.grant(f"Stopped before the first update: {go_on}")
        interrupt.grant(f"Stopped after update {tally.update}: {go_on}")

        progress = tqdm(
            range(tally.update + 1, cfg.updates + 1),
            desc=f"{cfg.constraint.name}, {cfg.noise.name}",
            initial=tally.update,
            total=cfg.updates,
            disable=quiet,
        )
        for update in progress:
            began = time.perf_counter()
            with tally.qps, install_timer("numba:compile", tally.leave_out):
                batch = next(stream)
                if cfg.replay:
                    replay.extend(batch)
                collected = time.perf_counter()

                sample = replay.sample() if cfg.replay else batch.reshape(-1)
                windows = None if learner.si is None else replay.sample_tau()
                terms, losses = learner.learn(sample, windows)
                if cfg.replay:
                    replay.remember(sample)
                learner.schedule.step()
                if learner.target is not None:
                    learner.target.step()
            ended = time.perf_counter()
            tally.update = update
            tally.seconds += ended - began
            tally.costs.append(-batch["next", "reward"].mean().item())
            tally.violation += physics.violation(batch["observation"]).sum().item()

            if update % cfg.log_interval == 0:
                metrics = {name: term.item() for name, term in terms.items()}
                told = {name: x for name, x in losses.items() if name in LOGGED}
                metrics |= {f"train/{name}": x.double().mean().item() for name, x in told.items()}
                metrics |= {"train/reward": -tally.costs[-1], "train/violation": tally.violation}
                metrics |= tally.qps.metrics() | theta_metrics(mpc)
                if learner.deviation is not None:
                    metrics.setdefault("loss/deviation", learner.deviation(mpc.C).item())
                metrics |= {"time/collect": collected - began, "time/update": ended - collected}
                run.log(metrics, update)
                tally.unsolved, tally.qps = tally.unsolved + tally.qps.unsolved, SolveLog()
            if update == cfg.release:
                mpc.release()
                learner = make_learner(cfg, operator, physics, done=update)
            last = update == cfg.updates
            if update % cfg.eval_interval == 0 or last:
                loops["learned"] = evaluate(cfg, partial(act, learner.actor), physics)
                summary = report(run, learned_mpc, loops, update)
                progress.set_postfix(J=summary["J_final"], closed_gap=summary["closed_gap"])
            if update % cfg.eval_interval == 0 or last or interrupt.signum is not None:
                run.flush()
                state = snapshot(cfg, mpc, learner, collector, replay, tally)
                save_checkpoint(run.path / CHECKPOINT, state)
            if not last:
                interrupt.grant(f"Stopped after update {update}: {go_on}")

        summary = gap_summary(loops)
        summary |= {"seed": cfg.seed, "constraint": cfg.constraint.name, "noise": cfg.noise.name}
        summary |= {"task": cfg.task.name, "algo": cfg.algo.name, "solver": cfg.solver}
        summary |= {"ablation": cfg.ablation, "step": cfg.step, "penalty_step": cfg.penalty_step}
        summary |= {"updates": cfg.updates, **tally.summary()}
        if learned_mpc is not None:
            summary |= structure_summary(mpc, true_model(physics))
        if cfg.figures and learned_mpc is not None:
            figure = summary_figure(mpc, loops, *run.column("eval/J"))
            figure.savefig(run.path / "summary.png", dpi=110)
        run.finish(summary)
        drop_previous(run.path / CHECKPOINT)
    if not quiet:
        print(f"\n{table(summary)}\n\n{run.path}")
    return summary


def without_writers(given: threading.ExceptHookArgs) -> None:
    """An error in a thread; that of TensorBoard's files is raised in the run, too."""
    if not isinstance(given.exc_value, OSError):
        threading.__excepthook__(given)


def train_in(
    folder: str, cfg: DictConfig, overrides: Collection[str], sweep: bool
) -> dict[str, Any]:
    """Start a run in ``folder``, go on with the one there, or skip a sweep's finished one.

    Returns:
        What summary.json holds.
    """
    resume, state = cfg.resume, None
    if resume is not None:
        cfg, state = resumed(resume, overrides)
    check_config(cfg)
    if sweep:
        if (done := finished_run(folder, cfg)) is not None:
            return done
        state = stopped_run(folder, cfg)
    elif resume is None:
        check_fresh(folder)
    else:
        check_own_folder(resume, folder)
    return train(cfg, folder, state, quiet=sweep)


# A run that goes on stays in its folder.
OmegaConf.register_new_resolver("folder_of", folder_of, replace=True)
#: What the loss module tells of itself.
LOGGED = ("td_error", "pred_value", "target_value", "unsolved", "invalid_reward")


# Absolute, so that a script with a task of its own can call main.
CONFIGS = str(Path(__file__).with_name("configs"))


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="config")
def main(cfg: DictConfig) -> float:
    """Train; a sweep's optimiser maximises the closed gap that this returns."""
    threading.excepthook = without_writers
    ours = HydraConfig.get()
    folder, sweep = ours.runtime.output_dir, ours.mode is RunMode.MULTIRUN
    try:
        with locked(folder, ELSEWHERE_IN_SWEEP if sweep else ELSEWHERE):
            return train_in(folder, cfg, list(ours.overrides.task), sweep)["closed_gap"]
    except QPError as error:
        if sweep:
            raise  # an exit would end the other runs, too
        raise SystemExit(str(error)) from None
    except OSError as error:
        if sweep or isinstance(error, ConnectionError):
            raise  # what a process of another one's lost is no file
        raise SystemExit(str(unwritable(folder, error))) from None


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT) from None
