"""``task=store``: a `Store` as a task, registered as by a user's script."""

from tests.store import Store, scheme
from torch_qpmpc.experiment.tasks import Task, register

register(
    Task(
        "store",
        lambda cfg: Store(horizon=cfg.task.horizon),
        lambda cfg, plant: scheme(plant, cfg.task.gamma),
        lambda cfg, plant: scheme(plant, cfg.task.gamma),
        defaults={
            "task": {
                "horizon": 3,
                "hessian": "block",
                "terminal_weight": "identity",
                "learn_cost": ["H", "q", "c"],
            }
        },
    )
)
