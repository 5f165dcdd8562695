"""PPO with a QP as mean, and its V as the state value, on the paper's point mass."""

import copy

import torch
from tensordict.nn import AddStateIndependentNormalScale as Scale
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torch_qpmpc as qm
from torch_qpmpc.envs.closed_loop import closed_loop

PLANT = qm.envs.PointMass()


def main(batches: int = 30, seed: int = 1) -> tuple[float, float]:
    """Learn; return J before and after."""
    torch.manual_seed(seed)
    A, B, weight = PLANT.corrupted(seed)  # a wrong model and a random cost
    weight = torch.cat((weight, torch.tensor([0.1, 0.1])))
    options = {"action_bounds": (PLANT.lb_a, PLANT.ub_a), "gamma": 0.9, "learn": ("H", "c", "C")}
    mpc = qm.QPMPC.from_model(A, B, 10, stage_weight=weight, solver="daqp", **options)
    before, critic = closed_loop(mpc.policy, PLANT).J, copy.deepcopy(mpc)

    mean = qm.QPActorValueOperator(mpc, action_key="mean").get_policy_operator()
    scale = TensorDictModule(Scale(2, scale_mapping="exp"), ["mean"], ["loc", "scale"])
    options = {"distribution_class": IndependentNormal, "return_log_prob": True}
    sequence = TensorDictSequential(mean, scale)
    actor = ProbabilisticActor(sequence, in_keys=["loc", "scale"], **options)
    value = qm.QPActorValueOperator(critic).get_value_operator()
    loss = ClipPPOLoss(actor, value, entropy_coeff=0.0, loss_critic_type="l2")
    advantage = GAE(gamma=0.9, lmbda=0.9, value_network=value, average_gae=True)
    groups = critic.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    groups += mpc.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    optimizer = torch.optim.Adam([*groups, {"params": scale.parameters(), "lr": 1e-2}])

    env = PLANT.vectorised(16, 50, seed=seed)
    collector = Collector(env, actor, frames_per_batch=800, total_frames=800 * batches)
    for batch in collector:
        for _ in range(4):
            advantage(batch)
            for part in batch.reshape(-1)[torch.randperm(800)].split(200):
                losses = loss(part)
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                optimizer.step()
    collector.shutdown()
    return before, closed_loop(mpc.policy, PLANT).J


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main()))
