"""PPO with a QP as mean, and its V as the state value, on the paper's point mass or `--id ID`."""

import copy

import torch
from plants import options, start
from tensordict.nn import AddStateIndependentNormalScale as Scale
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torch_qpmpc as qm


def main(updates: int = 30, seed: int = 1, id: str | None = None) -> tuple[float, float]:
    """Learn; return J before and after."""
    env, mpc, J, _ = start(id, seed)
    before, critic = J(mpc.policy), copy.deepcopy(mpc)

    mean = qm.QPActorValueOperator(mpc, action_key="mean").get_policy_operator()
    scale = TensorDictModule(Scale(mpc.n_u, scale_mapping="exp"), ["mean"], ["loc", "scale"])
    options = {"distribution_class": IndependentNormal, "return_log_prob": True}
    sequence = TensorDictSequential(mean, scale)
    actor = ProbabilisticActor(sequence, in_keys=["loc", "scale"], **options)
    value = qm.QPActorValueOperator(critic).get_value_operator()
    loss = ClipPPOLoss(actor, value, entropy_coeff=0.0, loss_critic_type="l2")
    advantage = GAE(gamma=mpc.gamma, lmbda=0.9, value_network=value, average_gae=True)
    groups = critic.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    groups += mpc.parameter_groups({"cost": 2e-2, "constraints": 2e-3})
    optimizer = torch.optim.Adam([*groups, {"params": scale.parameters(), "lr": 1e-2}])

    frames = {"frames_per_batch": 800, "total_frames": 800 * updates}
    frames["auto_register_policy_transforms"] = False  # the policy needs none
    collector = Collector(env, actor, **frames)
    for batch in collector:
        for _ in range(4):
            advantage(batch)
            for part in batch.reshape(-1)[torch.randperm(800)].split(200):
                losses = loss(part)
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                optimizer.step()
    collector.shutdown()
    return before, J(mpc.policy)


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main(**options())))
