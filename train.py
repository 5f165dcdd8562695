"""Learn a quadratic program as value function by Q-learning.

    python train.py                                     the paper's point mass, seed 1
    python train.py task=gros_zanon solver=daqp         another plant, in one long episode
    python train.py -m constraint=fixed,free seed=1,2   a sweep
    python train.py task=gymnasium task.id=Pendulum-v1 start=data   from a log, without a model
    python train.py hydra.run.dir=FOLDER                repeat it to go on with a stopped run
    tensorboard --logdir runs                           watch the runs

configs/ holds every key. The run's folder gets config.yaml, metrics.csv, TensorBoard events,
checkpoint.pt, summary.png, episode.png and summary.json.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import math
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from torchrl import torchrl_logger
from tqdm import tqdm

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.algorithms import (
    make_collector,
    make_learner,
    make_operator,
    make_run_replay,
    warm_up_batches,
)
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.evaluation import Evaluation, check_rewards, cost_text
from torch_qpmpc.experiment.gating import RunGate
from torch_qpmpc.experiment.launch import check_overrides, launched, settled
from torch_qpmpc.experiment.metrics import (
    Tally,
    draw_outcome,
    report,
    run_summary,
    table,
    update_metrics,
)
from torch_qpmpc.experiment.run_folder import BEST, CHECKPOINT, RunFolder, not_null
from torch_qpmpc.experiment.run_state import RunState
from torch_qpmpc.experiment.start import make_start, read_observer, transitions
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.code import named_task, run_code
from torch_qpmpc.files import save_file
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.state import KIND

# Absolute, so that a user's script can call main.
CONFIGS = str(Path(__file__).with_name("configs"))


def train(
    cfg: Config, folder: str, state: dict[str, Any] | None = None, quiet: bool = False
) -> dict[str, Any]:
    """Train from the beginning, or from the ``state`` of a checkpoint.

    It writes a checkpoint at each evaluation. A ``quiet`` run, as in a sweep, prints nothing.

    Returns:
        The content of summary.json.
    """
    torchrl_logger.setLevel("WARNING")
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)

    # The QP, and J of all that it is compared with.
    physics, start = make_physics(cfg), None
    if state is None:
        start = make_start(cfg, physics, folder, quiet)
        physics = physics.observed(None if start is None else start.observer)
        first = make_mpc(cfg, physics, start)
        evaluation = Evaluation.before(cfg, physics, first, quiet)
        evaluation.entries.update({} if start is None else start.summary)
        mpc = first
        if start is not None and start.action is not None and cfg.gate:
            # The gate keeps the held action; without one, what is learned is, from the action on.
            mpc = make_mpc(cfg, physics, start._replace(action=None))
    else:
        physics = physics.observed(read_observer(folder))
        evaluation = Evaluation(cfg, physics)
        first = mpc = QPMPC.of(**state["arguments"])

    # The learner: Q-learning of first or second order.
    operator = make_operator(mpc)
    learner = make_learner(cfg, operator)
    replay = make_run_replay(cfg, mpc)
    gate = RunGate(cfg, learner, physics)
    if mpc is not first:
        gate.mpc.load_state_dict(first.state_dict())

    # The data: vectorised episodes under the current policy, which the replay stores.
    collector = make_collector(cfg, physics, gate.acting)
    stream = iter(collector)
    warm_up, tally = warm_up_batches(cfg), Tally()
    parts = RunState(cfg, mpc, learner, gate, collector, replay, evaluation, tally)

    with contextlib.ExitStack() as stack:
        stack.callback(collector.shutdown)
        after = None if state is None else state["update"]
        run = stack.enter_context(RunFolder(folder, cfg, after))

        # Warm up, or resume.
        if state is None:
            report(run, gate.mpc, evaluation, 0)
            for batch in itertools.islice(stream, warm_up):
                learner.loss_module.observe(batch)
                replay.extend(batch)
            if start is not None and start.cost is not None and warm_up:
                # Its constant is from the log: what random actions cost.
                run.log({"train/centred": learner.centre(replay)}, 0)
                if mpc is first:
                    gate.mpc.load_state_dict(mpc.state_dict())
        else:
            parts.restore(state)
            if state["collector"] is None and tally.update < cfg.updates and not quiet:
                print("Starting new episodes: the state of the environments is not saved.")
        changed, judged = False, {}  # what is kept, since its last evaluation; the last verdict
        shown: dict[str, str] = {}  # beside the bar
        label = f"{cfg.constraint.name}, {cfg.noise.name}"
        # A log file gets a line in ten seconds.
        rest = {"mininterval": 0.1 if sys.stderr.isatty() else 10, "disable": quiet}
        bar = tqdm(desc=label, initial=tally.update, total=cfg.updates, **rest)
        progress = stack.enter_context(bar)
        for update in range(tally.update + 1, cfg.updates + 1):
            with tally.timed() as times:
                batch = next(stream)
                learner.loss_module.observe(batch)
                replay.extend(batch)
                times.append(time.perf_counter())

                sample = replay.sample() if cfg.replay else batch.reshape(-1)
                penalised = learner.penalties.si is not None and replay.windows.can_sample()
                windows = replay.sample_tau() if penalised else None
                terms, losses = learner.learn(sample, windows)
                if cfg.replay:
                    replay.remember(sample)
                learner.scheduler.step()
            tally.add(batch, terms)
            shown["accepted"] = f"{tally.accepted}/{update}"
            progress.set_postfix(shown, refresh=False)
            progress.update()

            if update % cfg.log_interval == 0:
                run.log(update_metrics(terms, losses, tally, times, mpc, learner), update)
            judged = gate.judge(update)
            run.log(judged, update)
            changed |= not cfg.gate or bool(judged.get("gate/accepted"))
            last = update == cfg.updates
            if last or update % cfg.eval_interval == 0:
                if changed:
                    evaluation.evaluate(warm_policy(gate.mpc))
                    changed = False
                if last:
                    evaluation.identify(partial(transitions, cfg, folder, replay))
                gap = report(run, gate.mpc, evaluation, update)
                shown["J"], closed = cost_text(gap["J_best"]), gap["closed_gap"]
                shown |= {"closed_gap": f"{closed:.3f}"} if math.isfinite(closed) else {}
                progress.set_postfix(shown)
                run.flush()
                save_file(run.path / CHECKPOINT, KIND, parts.snapshot())
                gate.mpc.save(run.path / BEST)

        gate.mpc.save(run.path / BEST)
        if cfg.figures:
            draw_outcome(run, gate.mpc, evaluation)
        if cfg.gate and not judged.get("gate/accepted"):
            evaluation.evaluate(warm_policy(mpc), "candidate")
        summary = run_summary(evaluation, tally, gate)
        run.finish(summary)
    if not quiet:
        print(f"\n{table(summary)}\n\n{run.path}")
        check_rewards(evaluation.loops["learned"], physics)
    return summary


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="config")
def _run(cfg: DictConfig) -> float:
    """Train, and return the closed gap, which an optimising sweeper can maximise."""
    with launched() as (folder, sweep):
        config = run_code(cfg)
        state, summary = settled(config, folder, sweep)
        if summary is None:
            summary = train(config, folder, state, quiet=sweep)
        elif not sweep:
            print(f"\n{table(not_null(summary))}\n\n{folder}, which has finished before")
    return summary["closed_gap"]


def main() -> None:
    """Run the command line."""
    try:
        sys.argv[1:] = named_task(sys.argv[1:])
        check_overrides(sys.argv[1:], CONFIGS)
    except QPError as error:
        raise SystemExit(str(error)) from None
    _run()


if __name__ == "__main__":
    gc.freeze()  # at the end, a search of all that was imported would take seconds
    try:
        main()
    except KeyboardInterrupt:
        print("\nStopped: a sweep goes on with hydra.sweep.dir=FOLDER", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT) from None
