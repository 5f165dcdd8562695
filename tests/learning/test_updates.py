import copy
from typing import Any

import cvxpy as cp
import pytest
import torch
from torch.optim.lr_scheduler import LambdaLR
from torch.testing import assert_close

import torch_qpmpc as qm
from tests import store
from tests.problems import normal, random_mpc
from tests.transitions import make_loss, transitions
from torch_qpmpc.learning.penalties import Penalties
from torch_qpmpc.learning.replay import ACTIVE_SET, windows_to_tau
from torch_qpmpc.learning.updates import first_order, rate_of_C, second_order


def loss_of(mpc, key: str | None = None, **options) -> qm.QPQLearningLoss:
    return make_loss(operator=qm.QPActorValueOperator(mpc, active_set_key=key), **options)


def test_the_first_order_descends_the_sum_of_its_terms():
    mpc = random_mpc(3)
    twin, loss = copy.deepcopy(mpc), loss_of(mpc)
    si, windows = qm.SystemIdentificationPenalty(1e-2), normal(5, mpc.n_z)
    optimizer = torch.optim.SGD(mpc.parameters(), lr=1e-3)
    update = first_order(mpc, loss, optimizer, Penalties(si=si))
    terms, scalars = update(transitions(), windows)
    assert terms.pop("train/accepted") == 1
    assert set(terms) == {"loss/value", "loss/si"}
    assert scalars["unsolved"] == 0
    total = loss_of(twin)(transitions())["loss_value"] + si(twin.C, windows, twin.b.detach())
    total.backward()
    assert_close(sum(terms.values()), total)
    for moved, still in zip(mpc.parameters(), twin.parameters(), strict=True):
        assert still.grad is not None
        assert_close(moved.detach(), still.detach() - 1e-3 * still.grad)


@pytest.mark.parametrize("with_si", [False, True])
@pytest.mark.parametrize(
    ("options", "step"),
    [
        ({}, {}),
        ({"td_error_clip": 0.5}, {"clip": 0.5}),
        ({"weighted": True}, {"weighted": True}),
        ({"use_prioritized_weights": True}, {"weights": torch.arange(20).double()}),
    ],
)
def test_the_second_order_steps_towards_the_loss_modules_targets(with_si, options, step):
    mpc = random_mpc(3)
    twin, loss = copy.deepcopy(mpc), loss_of(mpc, **options)
    si, windows = qm.SystemIdentificationPenalty(1e-2), normal(5, mpc.n_z)
    before, batch = mpc.C.detach().clone(), transitions(20)
    optimizer = qm.GaussNewton(mpc, damping=10.0)
    update = second_order(mpc, loss, optimizer, Penalties(si=si if with_si else None))
    if "weights" in step:
        batch["priority_weight"] = step["weights"]
    terms, scalars = update(batch, windows if with_si else None)
    expected = loss_of(twin, td_error_clip=options.get("td_error_clip"))(transitions(20))
    assert_close(terms["loss/value"], expected["loss_value"].detach())
    assert ("loss/si" in terms) == with_si
    for name in ("td_error", "pred_value", "target_value", "unsolved"):
        assert_close(scalars[name], expected[name])
    with torch.no_grad():
        target = loss_of(twin).target(transitions(20))
        s, a = batch["observation"], batch["action"]
        penalty = si.curvature(windows) if with_si else None
        qm.GaussNewton(twin, damping=10.0).step(s, a, -target, penalty=penalty, **step)
    assert_close(mpc.state_dict(), twin.state_dict(), rtol=1e-9, atol=1e-12)
    assert (mpc.C - before).abs().max() > 1e-4


@pytest.mark.parametrize("second", [False, True])
def test_a_preview_and_an_observation_move_theta_as_one_observation_does(second):
    """Also with windows of the SI penalty, in the order of z."""
    batch = store.collect(4, 8)
    tau = windows_to_tau(batch[:, :3], "preview")
    moved = []
    for key in ("preview", None):
        mpc = store.make_mpc()
        loss = make_loss(operator=qm.QPActorValueOperator(mpc, preview_key=key))
        si = qm.SystemIdentificationPenalty(1e-2)
        if second:
            update = second_order(mpc, loss, qm.GaussNewton(mpc), Penalties(si=si))
        else:
            update = first_order(
                mpc, loss, torch.optim.SGD(mpc.parameters(), 1e-3), Penalties(si=si)
            )
        before = copy.deepcopy(mpc.state_dict())
        terms, scalars = update(batch.reshape(-1).copy(), tau)
        assert scalars["unsolved"] == 0
        assert terms["loss/si"] > 0
        assert not torch.equal(before["C"], mpc.C)
        moved.append(mpc.state_dict())
        for part in (batch, batch["next"]):
            part["observation"] = torch.cat((part["preview"], part["observation"]), -1)
    assert_close(*moved)


@pytest.mark.parametrize("second", [True, False])
def test_invalid_rewards_are_counted_under_their_own_name(second):
    mpc = random_mpc(3, on_failure="mask")
    loss, batch = loss_of(mpc), transitions()
    batch["action"][2] = 9.0  # beyond a hard bound
    batch["next", "reward"][4] = torch.nan
    if second:
        optimizer = qm.GaussNewton(mpc, damping=10.0)
        update = second_order(mpc, loss, optimizer, Penalties())
    else:
        update = first_order(mpc, loss, torch.optim.SGD(mpc.parameters(), 1e-3), Penalties())
    before = mpc.C.detach().clone()
    with pytest.warns(RuntimeWarning, match=r"\('next', 'reward'\): 1 of \d+ rewards are NaN"):
        terms, scalars = update(batch, None)
    assert (scalars["unsolved"], scalars["invalid_reward"]) == (1, 1)
    assert all(term.isfinite() for term in terms.values())
    assert not torch.equal(mpc.C, before)


@pytest.mark.filterwarnings(r"ignore:\('next', 'reward'\)")
@pytest.mark.parametrize("second", [True, False])
@pytest.mark.parametrize("cause", ["reward", "action"])
def test_an_update_without_a_usable_transition_moves_nothing(cause, second):
    mpc = random_mpc(3, on_failure="mask")
    deviation = qm.DeviationPenalty(mpc, c_2=1e-2, c_3=1e-2)
    si, windows = qm.SystemIdentificationPenalty(1e-2), normal(5, mpc.n_z)
    make: Any = second_order if second else first_order
    adam = torch.optim.Adam(mpc.parameter_groups(RATES), weight_decay=0.1)
    optimizer: Any = qm.GaussNewton(mpc) if second else adam
    update = make(mpc, loss_of(mpc), optimizer, Penalties(deviation, si))
    update(transitions(), windows)
    before = copy.deepcopy((mpc.state_dict(), optimizer.state_dict()["state"]))
    batch = transitions()
    if cause == "reward":
        batch["next", "reward"][:] = torch.nan
    else:
        batch["action"][:] = 9.0  # beyond a hard bound
    unsolved = len(batch) if cause == "action" else 0
    with pytest.warns(RuntimeWarning, match=f"None of .* usable: {unsolved} "):
        terms, scalars = update(batch, windows)
    assert terms["train/accepted"] == 0
    assert scalars["unsolved"] + scalars["invalid_reward"] == len(batch)
    after = (mpc.state_dict(), optimizer.state_dict()["state"])
    assert_close(after, before, rtol=0, atol=0)


RATES = {"cost": 1e-2, "constraints": 1e-3}


def make_update(name: str, mpc: qm.QPMPC, deviation: qm.DeviationPenalty):
    loss = loss_of(mpc, td_error_clip=1.0)
    if name == "gauss_newton":
        optimizer = qm.GaussNewton(mpc)
        return second_order(mpc, loss, optimizer, Penalties(deviation)), optimizer
    kind = torch.optim.Adam if name == "adam" else torch.optim.SGD
    optimizer = kind(mpc.parameter_groups(RATES))
    return first_order(mpc, loss, optimizer, Penalties(deviation)), optimizer


@pytest.mark.parametrize(
    ("optimizer", "rule"),
    [("sgd", "cholesky"), ("adam", "projection"), ("gauss_newton", "cholesky")],
)
def test_the_proximal_step_holds_entries_above_the_band_at_zero(optimizer, rule):
    mpc = random_mpc(3, free=0.0, step=rule)
    deviation = qm.DeviationPenalty(mpc, c_2=1e-5)
    update, _ = make_update(optimizer, mpc, deviation)
    for seed in range(5):
        update(transitions(seed=seed), None)
    moved = (mpc.C - mpc.C_0).detach().abs()
    above, below = deviation.C_mask == 1, deviation.C_mask == 0
    assert (moved[below] > 0).all()
    assert (moved[above] == 0).all()


def test_a_gradient_step_with_its_proximal_step_is_the_papers():
    mpc = random_mpc(3)
    deviation = qm.DeviationPenalty(mpc, c_1=1e-2, c_2=1e-4)
    twin = copy.deepcopy(mpc)
    make_update("sgd", mpc, deviation)[0](transitions(), None)
    loss_of(twin, td_error_clip=1.0)(transitions())["loss_value"].backward()
    start, gradient = twin.C.detach().numpy(), twin.C.grad.numpy()
    step = cp.Variable(start.shape)
    penalty = cp.sum(cp.abs(cp.multiply(deviation.C_mask, start + step - deviation.C_0)))
    descent = cp.sum(cp.multiply(RATES["constraints"] * gradient, step))
    problem = cp.Problem(cp.Minimize(0.5 * cp.sum_squares(step) + descent + penalty))
    problem.solve(cp.CLARABEL, **dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12))
    expected = torch.as_tensor(start + step.value)
    assert_close(mpc.C.detach(), expected, rtol=0, atol=1e-6)
    assert (mpc.C == mpc.C_0)[deviation.C_mask == 1e-2].float().mean() > 0.05


@pytest.mark.filterwarnings("ignore:Detected call of `lr_scheduler.step")
@pytest.mark.parametrize("optimizer", ["sgd", "adam", "gauss_newton"])
def test_the_penaltys_weight_falls_with_the_rate_of_C(optimizer):
    mpc = random_mpc(3)
    deviation = qm.DeviationPenalty(mpc)
    _, made = make_update(optimizer, mpc, deviation)
    assert rate_of_C(mpc, made) == (mpc.C, 1), "without a schedule"
    schedule, shares = LambdaLR(made, lambda update: 1 / (1 + update)), []
    for _ in range(3):
        shares.append(rate_of_C(mpc, made)[1])
        made.param_groups[0]["lr"] = 0.5  # of H
        schedule.step()
    assert shares == pytest.approx([1, 1 / 2, 1 / 3])
    still = torch.optim.SGD(mpc.parameter_groups(RATES | {"C": 0.0}))
    LambdaLR(still, lambda update: 0.5)
    assert rate_of_C(mpc, still)[1] == 1, "a C that does not move has no share"


def test_the_deviation_penalty_needs_the_rate_of_a_free_C():
    """It finds C in groups without names, and says so before theta moves."""
    mpc = random_mpc(3, free=0.0)
    deviation, loss = qm.DeviationPenalty(mpc), loss_of(mpc, td_error_clip=1.0)
    optimizer = torch.optim.SGD(mpc.parameters(), 1e-3)
    first_order(mpc, loss, optimizer, Penalties(deviation))(transitions(), None)
    moved = (mpc.C - mpc.C_0).detach().abs()
    assert (moved[deviation.C_mask == 0] > 0).all()
    assert (moved[deviation.C_mask == 1] == 0).all()
    others = torch.optim.SGD(mpc.leaves("H"), 1e-2)
    with pytest.raises(qm.QPError, match="optimizer: got one that does not move C, expected"):
        first_order(mpc, loss, others, Penalties(deviation))
    fixed = random_mpc(3, learn=("H",))
    penalties = Penalties(qm.DeviationPenalty(fixed))
    with pytest.raises(qm.QPError, match="optimizer: got one that does not move C, expected"):
        second_order(fixed, loss_of(fixed), qm.GaussNewton(fixed), penalties)


def test_the_second_order_keeps_active_sets():
    mpc = random_mpc(3)
    loss = loss_of(mpc, ACTIVE_SET)
    batch = transitions()
    expected = mpc.solve(batch["observation"], batch["action"]).active
    second_order(mpc, loss, qm.GaussNewton(mpc), Penalties())(batch, None)
    assert torch.equal(batch[ACTIVE_SET], expected)
    assert ACTIVE_SET in batch["next"]
