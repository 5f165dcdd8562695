"""`QPMPC.predict` of one state: the answers of a batch, after every kind of change of theta."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.utils import parametrize
from torch.testing import assert_close

from tests.mpc.settings import PREVIEWED, SETTINGS, inputs, made
from tests.problems import drawn_mpc, random_mpc, random_states
from torch_qpmpc import QPMPC, QPError, SolveLog, SolverError

STATES = random_states(24, seed=1)


@torch.no_grad()
def policy(mpc: QPMPC, s: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the policy in torch, and a mask of states that their own active sets solve exactly."""
    actions, exact = [], []
    for x in s:
        start = mpc.solve(x)
        with SolveLog() as log:
            actions.append(mpc.policy(x, warm_start=start).numpy())
        exact.append(log.recalled == 1)
    return np.stack(actions), np.array(exact)


def assert_predicted(mpc: QPMPC, s: Tensor = STATES, near: float = 1e-9) -> None:
    """Solvers have tolerances: where no active set is exact, the actions agree within these."""
    found, (expected, exact) = np.stack([mpc.predict(x) for x in s.numpy()]), policy(mpc, s)
    errors = np.abs(found - expected).max(-1)
    assert errors[exact].max() <= near
    assert errors.max() <= 1e-6
    assert exact.mean() > 0.5


@pytest.mark.parametrize("name", SETTINGS)
def test_one_state_has_the_action_of_a_batch(name):
    mpc = made(name, 1)
    s, _ = inputs(mpc, 12)
    # Multipliers within their tolerance of 1e-9 move the action more where there is no curvature.
    assert_predicted(mpc, s.detach(), 1e-6 if name in PREVIEWED else 1e-9)


def moved(mpc: QPMPC) -> None:
    with torch.no_grad():
        mpc.C[:, :4] *= 0.5


def by_numpy(mpc: QPMPC) -> None:
    mpc.C.detach().numpy()[0, 0] += 0.3


def by_data(mpc: QPMPC) -> None:
    mpc.ub.data.mul_(0.5)


def by_an_optimiser(mpc: QPMPC) -> None:
    optimizer = torch.optim.Adam(mpc.parameters(), lr=0.05)
    mpc.value(STATES).sum().backward()
    optimizer.step()


def by_a_state_dict(mpc: QPMPC) -> None:
    mpc.load_state_dict(random_mpc(7).state_dict())


def by_assignment(mpc: QPMPC) -> None:
    mpc.load_state_dict(random_mpc(7).state_dict(), assign=True)


def replaced(mpc: QPMPC) -> None:
    mpc.c, mpc.C = nn.Parameter(mpc.c.detach().clone()), nn.Parameter(mpc.C.detach() - 0.1)


def parametrized(mpc: QPMPC) -> None:
    class Third(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x / 3

    parametrize.register_parametrization(mpc, "ub", Third())


def a_sign(mpc: QPMPC) -> None:
    mpc.C.data[0, :2].neg_()


CHANGES = (
    moved,
    by_numpy,
    by_data,
    by_an_optimiser,
    by_a_state_dict,
    by_assignment,
    replaced,
    parametrized,
    a_sign,
    QPMPC.reset_parameters,
)


@pytest.mark.parametrize("change", CHANGES)
def test_no_change_of_theta_leaves_an_old_answer(change):
    mpc = random_mpc(3)
    assert_predicted(mpc)
    before = np.stack([mpc.predict(x) for x in STATES.numpy()])
    change(mpc)
    assert_predicted(mpc)
    assert np.abs(before - policy(mpc, STATES)[0]).max() > 1e-4


def test_large_parts_that_are_not_learned_are_compared_by_version():
    mpc = drawn_mpc(4, 2, 25, stage_weight=[1.0] * 6, state_bounds=([-1.0] * 4, [1.0] * 4), seed=2)
    assert mpc.G.numel() > 2**14
    s = random_states(8, 4, size=2.0)
    assert_predicted(mpc, s)
    mpc.G *= 2
    assert_predicted(mpc, s)
    mpc.C.data[:, :9].mul_(0.9)  # large, and learned
    assert_predicted(mpc, s)


class Acting(nn.Module):
    def __init__(self, mpc: QPMPC) -> None:
        super().__init__()
        self.mpc = mpc

    def forward(self, s: np.ndarray) -> np.ndarray:
        return self.mpc.predict(s)


def test_a_functional_call_uses_its_own_theta():
    mpc, other, s = random_mpc(3), random_mpc(7), STATES[0].numpy()
    expected = policy(other, STATES[:1])[0][0]
    own = mpc.predict(s)
    theta = {f"mpc.{name}": x.detach() for name, x in other.named_parameters()}
    rest = {f"mpc.{name}": x for name, x in other.named_buffers()}
    for _ in range(2):
        found = functional_call(Acting(mpc), theta | rest, (s,))
        assert np.abs(found - expected).max() <= 1e-9
    assert np.abs(mpc.predict(s) - own).max() <= 1e-12
    assert np.abs(own - expected).max() > 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (1, 1), (2, 3)])
def test_the_action_has_the_batch_and_the_dtype_of_the_state(batch, dtype):
    mpc = random_mpc(5)
    s = STATES[0].to(dtype).expand(*batch, 2)
    for policy in (mpc, random_mpc(5).float()):
        action = policy.predict(s)
        assert action.shape == (*batch, 1)
        assert action.dtype == s.numpy().dtype
        assert_close(torch.from_numpy(action), mpc.policy(s).detach(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("on_failure", ["raise", "mask"])
def test_a_state_without_a_solution_has_the_errors_of_a_batch(on_failure):
    """A masked QP's placeholder must not reach a plant."""
    hard = {"state_bounds": ([-1.0], [1.0]), "state_slack": torch.inf}
    mpc = drawn_mpc(1, 1, 3, solver="daqp", on_failure=on_failure, **hard)
    assert_predicted(mpc, torch.full((1, 1), 0.1, dtype=torch.float64))
    for _ in range(2):
        with pytest.raises(SolverError, match=r"1 of 1 QPs .* 1 INFEASIBLE"):
            mpc.predict([5.0])
    for bad in ([np.nan], [np.inf]):
        with pytest.raises(QPError, match="observation: got NaN or inf"):
            mpc.predict(bad)
    with torch.no_grad():
        mpc.C[0, 0] = torch.nan
    with pytest.raises(QPError, match="INVALID_DATA"):
        mpc.predict([0.1])


def test_threads_share_a_policy():
    mpc = random_mpc(6)
    expected, _ = policy(mpc, STATES)
    with ThreadPoolExecutor(4) as pool:
        results = [*pool.map(lambda _: np.stack([mpc.predict(s) for s in STATES]), range(8))]
    assert np.abs(np.stack(results) - expected).max() <= 1e-9


@pytest.mark.parametrize("learn", [("H", "c", "C"), ("lb", "ub"), {"q": torch.arange(9) > 3}])
def test_its_solves_are_counted(learn):
    options = {"stage_weight": [1.0, 0.1], "action_bounds": ([-1.0], [1.0]), "learn": learn}
    mpc = QPMPC.from_model([[1.0]], [[1.0]], 4, **options)
    mpc.predict([0.1])
    with SolveLog() as log:
        for _ in range(5):
            mpc.predict([0.1])
    assert (log.solves, log.recalled, log.unsolved, log.fallback) == (5, 5, 0, 0)
    assert log.residual < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_policy_without_gradients_is_as_fast_and_forgets_earlier_states(dtype):
    mpc, s = random_mpc(6), STATES.to(dtype)
    batch = mpc.policy(s).detach()
    with torch.no_grad(), SolveLog() as log:
        first = [mpc.policy(x) for x in s]
        again = [mpc.policy(x) for x in reversed(s)]
        assert mpc.policy(s[:1]).shape == (1, mpc.n_u)
    assert log.solves == 2 * len(s) + 1
    assert log.recalled > 0.5 * log.solves
    assert torch.equal(torch.stack(first), torch.stack(again[::-1])), "as a resumed run needs it"
    assert_close(torch.stack(first), batch, atol=1e-6, rtol=1e-5)
    assert first[0].dtype == dtype
    assert mpc.policy(s[0]).requires_grad
    with torch.no_grad(), pytest.raises(QPError, match=r"^s: got list, expected a floating"):
        mpc.policy([0.1, 0.2])  # pyright: ignore[reportArgumentType]
