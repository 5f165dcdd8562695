"""SAC with a QP as mean and two more as critics, on the paper's point mass or `--id ID`."""

import copy

import torch
from plants import options, start
from tensordict.nn import AddStateIndependentNormalScale as Scale
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

import torch_qpmpc as qm


def main(updates: int = 1500, seed: int = 1, id: str | None = None) -> tuple[float, float]:
    """Learn; return J before and after."""
    env, mpc, J, (low, high) = start(id, seed)
    before = J(mpc.policy)
    mean = qm.QPActorValueOperator(mpc, action_key="mean").get_policy_operator()
    middle, half = (low + high) / 2, (high - low) / 2
    squashed = TensorDictModule(lambda u: (0.99 * (u - middle) / half).atanh(), ["mean"], ["loc"])
    scale = TensorDictModule(Scale(mpc.n_u, scale_mapping="exp"), ["loc"], ["loc", "scale"])
    limits = {"distribution_kwargs": {"low": low, "high": high}, "return_log_prob": True}
    sequence = TensorDictSequential(mean, squashed, scale)
    actor = ProbabilisticActor(
        sequence, in_keys=["loc", "scale"], distribution_class=TanhNormal, **limits
    )
    critics = [qm.QPActorValueOperator(copy.deepcopy(mpc)) for _ in range(2)]
    with torch.no_grad():
        critics[1].module.C.mul_(1.01)  # they must not be the same
    loss = SACLoss(actor, critics, action_spec=env.action_spec, loss_function="l2")
    loss.make_value_estimator(gamma=mpc.gamma)
    target = SoftUpdate(loss, tau=0.01)
    groups = mpc.parameter_groups({"cost": 2e-3, "constraints": 2e-4})
    others = *loss.qvalue_network_params.parameters(), *scale.parameters(), loss.log_alpha
    groups += [{"params": others, "lr": 5e-3}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))

    frames = {"frames_per_batch": 16, "total_frames": 16 * updates}
    frames["auto_register_policy_transforms"] = False  # the policy needs none
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
    return before, J(mpc.policy)


if __name__ == "__main__":
    print("J before: {:.2f}, after: {:.2f}".format(*main(**options())))
