from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.learning.test_updates import make_loss
from tests.learning.test_warm_start import transitions
from tests.problems import normal, random_mpc, random_states
from torch_qpmpc import QPMPC, GaussNewton, QPError
from torch_qpmpc.learning.policy_gradient import PARTS, PolicyGradient, policy_sensitivities
from torch_qpmpc.learning.replay import ACTIVE_SET
from torch_qpmpc.learning.updates import second_order, with_policy_gradient

LEARN = ("c", *PARTS)
PREFIX: dict[str, Any] = {
    "past": 2,
    "n_d": 1,
    "rate_bounds": ([-0.4], [0.4]),
    "rate_slack": 3.0,
}


@pytest.mark.parametrize("options", [{}, {"structure": "tied"}, PREFIX], ids=["free", "tied", "p"])
def test_sensitivities_equal_finite_differences(options):
    mpc = random_mpc(1, learn=LEARN, **options)
    s, h = random_states(12, mpc.n_p), 1e-6
    solution, M = policy_sensitivities(mpc, s, PARTS)
    assert solution.active.any(-1).float().mean() > 0.3, "some constraints are active"
    theta, column = mpc.coordinates(), 0
    for part in PARTS:
        for i in range(theta[part].numel()):
            move = torch.zeros(len(s), theta[part].numel()).double()
            move[:, i] = h
            with torch.no_grad():
                ends = [
                    mpc.policy(s, qp=mpc.quadratic_program({part: x.view(-1, *theta[part].shape)}))
                    for x in (move, -move)
                ]
            assert_close(M[:, :, column], (ends[0] - ends[1]) / (2 * h), atol=2e-5, rtol=1e-4)
            column += 1
    assert M.shape[-1] == column


class Known:
    """A QP, explored states and actions, and an advantage that is linear in its features."""

    def __init__(self, count: int = 64, **options: Any) -> None:
        settings = {"structure": "tied", "learn": ("c", "b", "ub"), "on_failure": "mask"}
        self.mpc = random_mpc(0, **{**settings, **options})
        self.s = random_states(count, self.mpc.n_p, size=0.8)
        _, M = policy_sensitivities(self.mpc, self.s, ("b",))
        self.M, self.w = M, torch.tensor([0.7, -0.4]).double()
        self.pi, self.V = self.mpc.policy(self.s).detach(), self.mpc.value(self.s).detach()

    def draw(self, seed: int, noise: float = 0.1) -> tuple[Tensor, Tensor]:
        """Draw actions and targets: V, an error of V, the advantage, and noise."""
        explored = 0.1 * normal(len(self.s), 1, seed=2 * seed)
        advantage = ((self.M @ self.w) * explored).sum(-1)
        error = 3.0 + self.s @ torch.tensor([1.0, -2.0]).double()
        target = self.V + error + advantage + noise * normal(len(self.s), seed=2 * seed + 1)
        return self.pi + explored, target


def test_the_weights_of_a_known_advantage_are_unbiased():
    known = Known()
    improve = PolicyGradient(known.mpc, ["b"], rate=1e-12, ridge=1e-9)
    found = torch.stack(
        [improve.step(known.s, *known.draw(seed)).w["b"].detach() for seed in range(40)]
    )
    error = found.std(0) / math.sqrt(len(found))
    assert (error < 0.1).all()
    assert ((found.mean(0) - known.w).abs() < 3.5 * error).all()


def test_a_step_goes_down_the_advantage_within_its_bound():
    known = Known()
    improve = PolicyGradient(known.mpc, ["b"], rate=0.01, ridge=1e-9)
    a, target = known.draw(0, noise=0.0)
    report = improve.step(known.s, a, target)
    assert_close(report.w["b"], known.w, atol=1e-6, rtol=1e-6)
    assert report.share == pytest.approx(1.0, abs=1e-6)
    change = known.mpc.policy(known.s).detach() - known.pi
    assert (change * (known.M @ known.w)).sum() < 0
    rms, explored = (x.square().mean().sqrt() for x in (change, a - known.pi))
    assert rms / explored == pytest.approx(0.01, rel=0.05)
    assert report.change == pytest.approx(0.01, rel=1e-6)


def test_noise_alone_moves_little():
    known, share = Known(), []
    improve = PolicyGradient(known.mpc, ["b"], rate=1e-12)
    for seed in range(20):
        a, _ = known.draw(seed)
        target = known.V + normal(len(known.s), seed=1000 + seed)
        share.append(improve.step(known.s, a, target).share)
    assert sum(share) / len(share) < 0.4, "the mean"


def test_an_error_of_V_is_no_advantage():
    """The action moves s+, where V is wrong by R."""
    known, gamma = Known(), 0.9
    improve = PolicyGradient(known.mpc, ["b"], rate=1e-12, ridge=1e-9)
    a = known.pi + 0.1 * normal(len(known.s), 1)
    target = known.V + ((known.M @ known.w) * (a - known.pi)).sum(-1)
    following = known.s @ torch.tensor([[1.0, 0.0], [0.2, 0.9]]).double() + a * 0.5 + 0.1
    following += 0.1 * normal(len(a), 2, seed=5)
    ended = torch.arange(len(a)) % 4 == 0
    discount = gamma * (~ended).double()
    following[ended] = torch.nan

    def error(s: Tensor) -> Tensor:
        return 7 + 3 * s[:, 0] - s[:, 1] + 2 * s[:, 0].square()

    later = discount * error(following).nan_to_num()
    target = target + error(known.s) - later
    plain = improve.step(known.s, a, target)
    assert not torch.allclose(plain.w["b"], known.w, atol=0.3)
    report = improve.step(known.s, a, target, following=following, discount=discount)
    assert_close(report.w["b"], known.w, atol=1e-5, rtol=1e-5)


def test_signals_that_are_known_take_their_share_of_the_noise():
    known = Known(n_d=1)
    improve = PolicyGradient(known.mpc, ["b"], rate=1e-12, ridge=1e-9)
    p, price = known.s, normal(len(known.s), 1, seed=9)
    a = known.pi + 0.1 * normal(len(p), 1)
    advantage = ((known.M @ known.w) * (a - known.pi)).sum(-1)
    following = torch.cat((p[:, 1:4], price, p[:, 4:]), -1)
    target = known.V + advantage + 5.0 * price[:, 0] + p[:, 2]
    report = improve.step(p, a, target, following=following, discount=0.9)
    assert_close(report.w["b"], known.w, atol=1e-6, rtol=1e-6)


def test_memory_joins_batches():
    whole, halves = Known(), Known()
    (a, target), half = whole.draw(0), len(whole.s) // 2
    expected = PolicyGradient(whole.mpc, ["b"], rate=1e-12).step(whole.s, a, target)
    improve = PolicyGradient(halves.mpc, ["b"], rate=1e-12, memory=half)
    improve.step(halves.s[:half], a[:half], target[:half])
    saved = improve.state_dict()
    for one in (improve, PolicyGradient(halves.mpc, ["b"], rate=1e-12, memory=half)):
        one.load_state_dict(saved)
        found = one.step(halves.s[half:], a[half:], target[half:])
        assert_close(found.w["b"], expected.w["b"], rtol=1e-6, atol=1e-9)
        assert found.share == pytest.approx(expected.share, rel=1e-6)


@pytest.mark.filterwarnings("ignore:None of the")
def test_pairs_without_a_solution_or_a_target_are_left_out():
    one, other = Known(), Known()
    a, target = one.draw(0)
    s, worse = one.s.clone(), target.clone()
    s[3], worse[5] = torch.nan, torch.inf
    rest = [i for i in range(len(s)) if i not in (3, 5)]
    found = PolicyGradient(one.mpc, ["b"]).step(s, a, worse)
    expected = PolicyGradient(other.mpc, ["b"]).step(one.s[rest], a[rest], target[rest])
    assert (found.unsolved, found.without_target) == (1, 1)
    assert_close(found.w["b"], expected.w["b"])
    assert_close(one.mpc.b, other.mpc.b)
    before = one.mpc.b.clone()
    report = PolicyGradient(one.mpc, ["b"]).step(one.s, a, target * torch.nan)
    assert report.without_target == len(s)
    assert torch.equal(one.mpc.b, before)


def test_no_usable_pair_warns():
    known = Known()
    a, target = known.draw(0)
    with pytest.warns(RuntimeWarning, match="0 without a QP solution, 64 without a finite"):
        PolicyGradient(known.mpc, ["b"]).step(known.s, a, target * torch.nan)


@pytest.mark.filterwarnings("ignore:None of the")
def test_a_batch_without_a_usable_pair_moves_nothing_and_is_not_remembered():
    known = Known()
    improve = PolicyGradient(known.mpc, ["b"], memory=1000)
    a, target = known.draw(0)
    improve.step(known.s, a, target)
    before, state = known.mpc.b.clone(), improve.state_dict()["past"]
    report = improve.step(known.s, a, target * torch.nan)
    assert (report.change, report.without_target) == (0.0, len(a))
    assert torch.equal(known.mpc.b, before)
    assert_close(improve.state_dict()["past"], state, rtol=0, atol=0)


def test_a_part_in_large_units_counts_as_in_others():
    """The floor of the features' sizes is relative to the largest of their own part."""
    mpc = random_mpc(0, structure="tied", learn=("c", "b", "q"))
    s, explored = random_states(64), 0.1 * normal(64, 1)
    _, M = policy_sensitivities(mpc, s, ("b", "q"))
    n_b = mpc.coordinates()["b"].numel()
    column = n_b + int(M[:, 0, n_b:].square().sum(0).argmax())
    M[..., n_b:] *= 1e-9
    delta = 1e9 * M[:, 0, column] * explored[:, 0]
    nothing = torch.zeros_like(s), torch.zeros_like(s), torch.zeros(64).double()
    improve = PolicyGradient(mpc, ["b", "q"], ridge=1e-12)
    w, _ = improve._weights(M, explored, delta, *nothing)
    found = (M @ w)[:, 0] * explored[:, 0]
    assert (found - delta).abs().max() < 0.02 * delta.abs().max()
    assert w[column] != 0


@pytest.mark.parametrize("unit", [0.0, 1e-14, 1e-5])
def test_what_hardly_shapes_the_policy_does_not_move(monkeypatch, unit):
    """The bounds and slack weights of rows that no plan touches."""
    parts = ("b", "lb", "w")
    mpc = random_mpc(0, structure="tied", learn=("c", *parts))

    def hardly(*arguments: Any) -> tuple[Any, Tensor]:
        solution, M = policy_sensitivities(*arguments)
        n_b = mpc.coordinates()["b"].numel()
        M[..., n_b:] *= unit
        return solution, M

    monkeypatch.setattr("torch_qpmpc.learning.policy_gradient.policy_sensitivities", hardly)
    improve = PolicyGradient(mpc, parts)
    before = {part: getattr(mpc, part).detach().clone() for part in parts}
    s = random_states(64)
    a = mpc.policy(s).detach() + 0.1 * normal(64, 1)
    improve.step(s, a, mpc.value(s).detach() + a[:, 0])
    moved = [part for part in parts if not torch.equal(getattr(mpc, part), before[part])]
    assert moved == ["b"]


def test_actions_without_exploration_move_nothing():
    known = Known()
    before = known.mpc.b.clone()
    report = PolicyGradient(known.mpc, ["b"]).step(known.s, known.pi, known.V)
    assert report.change == 0
    assert torch.equal(known.mpc.b, before)


def test_bounds_of_hard_rows_stay():
    known = Known(structure="free", learn=("c", "b", "lb", "ub"))
    before = {part: getattr(known.mpc, part).detach().clone() for part in ("lb", "ub")}
    s = random_states(64)
    a = known.mpc.policy(s).detach() + 0.3 * normal(64, 1)
    target = known.mpc.value(s).detach() + 9.0 * a[:, 0]
    PolicyGradient(known.mpc, ["lb", "ub"], rate=1.0).step(s, a, target)
    soft = known.mpc.soft
    for part, old in before.items():
        new = getattr(known.mpc, part).detach()
        assert torch.equal(new[~soft], old[~soft])
        assert not torch.equal(new[soft], old[soft])


def test_td_errors_leave_its_parts_alone():
    mpc = random_mpc(2, learn=("H", "c", "C", "b"))
    improve = PolicyGradient(mpc, ["b"])
    before = {name: x.clone() for name, x in mpc.named_parameters()}
    s, a = random_states(16), random_states(16, 1, size=0.4, seed=1)
    GaussNewton(mpc).step(s, a, mpc.action_value(s, a).detach() + 1.0)
    moved = {name for name, x in mpc.named_parameters() if not torch.equal(x, before[name])}
    assert "b" not in moved
    assert "C" in moved
    assert improve.parts == ("b",)


def test_an_update_is_a_step_by_td_errors_and_one_by_the_policy_gradient():
    mpc = random_mpc(3, learn=("H", "c", "C", "b"), on_failure="mask")
    improve = PolicyGradient(mpc, ["b"], rate=0.5)
    loss = make_loss(mpc, ACTIVE_SET)
    update = second_order(mpc, loss, GaussNewton(mpc, trust_region=False), None, None)
    before = {part: getattr(mpc, part).detach().clone() for part in ("H", "b")}
    terms, losses = with_policy_gradient(update, loss, improve, lambda: 0.5)(transitions(), None)
    assert terms["policy/change"] == pytest.approx(0.25 * float(terms["policy/share"]))
    assert {"loss/value", "policy/share"} <= set(terms)
    assert "td_error" in losses
    assert not torch.equal(mpc.H.detach(), before["H"])
    assert torch.equal(mpc.b.detach(), before["b"]) == (terms["policy/share"] == 0)


def scheme(**options: Any) -> QPMPC:
    """Make the MPC of x+ = x + u, drawn to 0 but with an upper bound of x at -0.5."""
    settings: dict[str, Any] = {
        "structure": "tied",
        "stage_weight": [1.0, 0.1],
        "state_bounds": ([-5.0], [-0.5]),
        "action_bounds": ([-1.0], [1.0]),
        "state_slack": 10.0,
        "solver": "daqp",
    }
    return QPMPC.from_model([[1.0]], [[1.0]], 4, **{**settings, **options})


def rollout(mpc: QPMPC, seed: int, explore: float = 0.0, steps: int = 20) -> tuple[Tensor, ...]:
    """Run x+ = x + u + noise, and return x, u, the costs and x+, ``(steps * 32, ..)``."""
    x, rows = torch.full((32, 1), -1.0).double(), []
    noise = normal(steps, 2, 32, 1, seed=seed)
    for k in range(steps):
        with torch.no_grad():
            u = (mpc.policy(x) + explore * noise[k, 0]).clamp(-1, 1)
        beyond = (x + 0.5).clamp(min=0)
        cost = 0.5 * x.square() + 0.05 * u.square() + 10 * beyond
        following = x + u + 0.1 * noise[k, 1]
        rows.append((x, u, cost[:, 0], following))
        x = following
    return tuple(map(torch.cat, zip(*rows, strict=True)))


@pytest.mark.parametrize(
    ("part", "options"), [("ub", {}), ("b", {"offset": [-0.2]})], ids=["margin", "wrong offset"]
)
def test_closed_loops_cost_less(part, options):
    """A margin pays with noise, as does the true offset: theta's values learn nothing here."""
    ratios = []
    for seed in range(3):
        mpc = scheme(learn=("c", part), **options)
        improve = PolicyGradient(mpc, [part], rate=0.3)
        before = rollout(mpc, 100 + seed)[2].mean()
        for update in range(8):
            x, u, cost, following = rollout(mpc, 1000 * seed + update, explore=0.1, steps=8)
            target = cost + 0.9 * mpc.value(following).detach()
            improve.step(x, u, target, following=following, discount=0.9)
        ratios.append(float(rollout(mpc, 100 + seed)[2].mean() / before))
    assert max(ratios) < 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parts": []}, r"parts: got \[\]"),
        ({"parts": ["C"]}, "parts.*C.*expected different names of q, b, lb, ub, w"),
        ({"parts": ["b", "b"]}, "parts"),
        ({"parts": ["b", "w"]}, "part: got 'w', expected one of the learned parts"),
        ({"rate": 0}, "rate"),
        ({"ridge": 0.0}, "ridge"),
        ({"memory": -1}, "memory"),
        ({"mpc": None}, "mpc"),
    ],
)
def test_errors(options, message):
    arguments = {"mpc": random_mpc(0, learn=("c", "b")), "parts": ["b"]} | options
    mpc, parts = arguments.pop("mpc"), arguments.pop("parts")
    with pytest.raises(QPError, match=message):
        PolicyGradient(mpc, parts, **arguments)
    assert mpc is None or mpc.b.requires_grad, "what is refused freezes nothing"


@pytest.mark.parametrize(
    ("name", "shape"),
    [("s", (8, 3)), ("a", (8, 2)), ("target", (8, 1)), ("following", (8, 3)), ("discount", (8, 1))],
    ids=str,
)
def test_shapes(name, shape):
    batch: dict[str, Any] = {
        "s": torch.zeros(8, 2),
        "a": torch.zeros(8, 1),
        "target": torch.zeros(8),
    }
    improve = PolicyGradient(random_mpc(0, learn=("c", "b")), ["b"])
    with pytest.raises(QPError, match=f"^{name}: got shape"):
        improve.step(**{**batch, name: torch.zeros(shape)})
