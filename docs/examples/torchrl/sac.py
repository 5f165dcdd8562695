"""SAC with a QP as mean and two more as critics, on the paper's point mass."""

import copy

import torch
from tensordict.nn import AddStateIndependentNormalScale as Scale
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

import torch_qpmpc as qm
from torch_qpmpc.envs.closed_loop import closed_loop

PLANT = qm.envs.PointMass()


def main(updates: int = 1500, seed: int = 1) -> tuple[float, float]:
    """Learn; return J before and after."""
    torch.manual_seed(seed)
    A, B, weight = PLANT.corrupted(seed)  # a wrong model and a random cost
    weight = torch.cat((weight, torch.tensor([0.1, 0.1])))
    options = {"action_bounds": (PLANT.lb_a, PLANT.ub_a), "gamma": 0.9, "learn": ("H", "c", "C")}
    mpc = qm.QPMPC.from_model(A, B, 10, stage_weight=weight, solver="daqp", **options)
    before = closed_loop(mpc.policy, PLANT).J
    mean = qm.QPActorValueOperator(mpc, action_key="mean").get_policy_operator()
    inverse = TensorDictModule(lambda mean: (0.99 * mean).atanh(), ["mean"], ["loc"])
    scale = TensorDictModule(Scale(2, scale_mapping="exp"), ["loc"], ["loc", "scale"])
    options = {"distribution_class": TanhNormal, "return_log_prob": True}
    sequence = TensorDictSequential(mean, inverse, scale)
    actor = ProbabilisticActor(sequence, in_keys=["loc", "scale"], **options)
    critics = [qm.QPActorValueOperator(copy.deepcopy(mpc)) for _ in range(2)]
    with torch.no_grad():
        critics[1].module.C.mul_(1.01)  # they must not be the same
    env = PLANT.vectorised(16, 50, seed=seed)
    loss = SACLoss(actor, critics, action_spec=env.action_spec, loss_function="l2")
    loss.make_value_estimator(gamma=0.9)
    target = SoftUpdate(loss, tau=0.01)
    groups = mpc.parameter_groups({"cost": 2e-3, "constraints": 2e-4})
    others = *loss.qvalue_network_params.parameters(), *scale.parameters(), loss.log_alpha
    groups += [{"params": others, "lr": 5e-3}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))

    frames = {"frames_per_batch": 16, "total_frames": 16 * updates}
    collector = Collector(env, actor, **frames)
    replay = ReplayBuffer(storage=LazyTensorStorage(16_000), batch_size=64)
    for batch in collector:
        replay.extend(batch.reshape(-1))
        losses = loss(replay.sample())
        optimizer.zero_grad()
        sum(losses[f"loss_{name}"] for name in ("qvalue", "actor", "alpha")).backward()
        optimizer.step()
        target.step()
    collector.shutdown()
    return before, closed_loop(mpc.policy, PLANT).J


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main()))
