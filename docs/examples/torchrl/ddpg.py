"""DDPG with a QP as actor and another as critic, on the paper's point mass or `--id ID`."""

import copy

import torch
from plants import options, start
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate

import torch_qpmpc as qm


def main(updates: int = 1500, seed: int = 1, id: str | None = None) -> tuple[float, float]:
    """Learn; return J before and after."""
    env, mpc, J, (low, high) = start(id, seed)
    before, critic = J(mpc.policy), copy.deepcopy(mpc)

    actor = qm.QPActorValueOperator(mpc).get_policy_operator()
    loss = DDPGLoss(actor, qm.QPActorValueOperator(critic), delay_actor=True, delay_value=True)
    loss.make_value_estimator(gamma=mpc.gamma)
    target = SoftUpdate(loss, tau=0.01)
    groups = critic.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    groups += mpc.parameter_groups({"cost": 2e-3, "constraints": 2e-4})
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))

    size = 0.15 * (high - low).mean().item()
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=size, sigma_end=size)
    frames = {"frames_per_batch": 16, "total_frames": 16 * updates}
    frames["auto_register_policy_transforms"] = False  # the policy needs none
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
    return before, J(mpc.policy)


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main(**options())))
