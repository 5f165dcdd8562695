"""DDPG with a QP as actor and another as critic, on the paper's point mass."""

import copy

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate

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
    before, critic = closed_loop(mpc.policy, PLANT).J, copy.deepcopy(mpc)

    actor = qm.QPActorValueOperator(mpc).get_policy_operator()
    loss = DDPGLoss(actor, qm.QPActorValueOperator(critic), delay_actor=True, delay_value=True)
    loss.make_value_estimator(gamma=0.9)
    target = SoftUpdate(loss, tau=0.01)
    groups = critic.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    groups += mpc.parameter_groups({"cost": 2e-3, "constraints": 2e-4})
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))

    env = PLANT.vectorised(16, 50, seed=seed)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.3, sigma_end=0.3)
    frames = {"frames_per_batch": 16, "total_frames": 16 * updates}
    collector = Collector(env, TensorDictSequential(actor, noise), **frames)
    replay = ReplayBuffer(storage=LazyTensorStorage(16_000), batch_size=64)
    for batch in collector:
        replay.extend(batch.reshape(-1))
        losses = loss(replay.sample())
        optimizer.zero_grad()
        (losses["loss_value"] + losses["loss_actor"]).backward()
        optimizer.step()
        target.step()
    collector.shutdown()
    return before, closed_loop(mpc.policy, PLANT).J


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main()))
