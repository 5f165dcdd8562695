"""TD3 with a QP as actor and two more as critics, on the paper's point mass or `--id ID`."""

import copy

import torch
from plants import options, start
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import SoftUpdate, TD3Loss

import torch_qpmpc as qm


def main(updates: int = 1500, seed: int = 1, id: str | None = None) -> tuple[float, float]:
    """Learn; return J before and after."""
    env, mpc, J, (low, high) = start(id, seed)
    before = J(mpc.policy)

    actor = qm.QPActorValueOperator(mpc).get_policy_operator()
    critics = [qm.QPActorValueOperator(copy.deepcopy(mpc)) for _ in range(2)]
    with torch.no_grad():
        critics[1].module.C.mul_(1.01)  # they must not be the same
    loss = TD3Loss(actor, critics, bounds=(low, high), loss_function="l2")
    loss.make_value_estimator(gamma=mpc.gamma)
    target = SoftUpdate(loss, tau=0.01)
    groups = mpc.parameter_groups({"cost": 2e-3, "constraints": 2e-4})
    groups += [{"params": [*loss.qvalue_network_params.parameters()], "lr": 5e-3}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))

    size = 0.15 * (high - low).mean().item()
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=size, sigma_end=size)
    frames = {"frames_per_batch": 16, "total_frames": 16 * updates}
    frames["auto_register_policy_transforms"] = False  # the policy needs none
    collector = Collector(env, TensorDictSequential(actor, noise), **frames)
    replay = ReplayBuffer(storage=LazyTensorStorage(16_000), batch_size=64)
    for update, batch in enumerate(collector):
        replay.extend(batch.reshape(-1))
        losses = loss(replay.sample())
        optimizer.zero_grad()
        (losses["loss_qvalue"] + update % 2 * losses["loss_actor"]).backward()
        optimizer.step()
        target.step()
    collector.shutdown()
    return before, J(mpc.policy)


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main(**options())))
