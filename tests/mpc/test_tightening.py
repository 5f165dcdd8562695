import torch
from torch import Tensor
from torch.testing import assert_close

from tests.refused import refused
from torch_qpmpc import QPMPC
from torch_qpmpc.mpc.tightening import prediction_covariance, tighten

N = 4
A = torch.tensor([[1.0, 0.1], [0.0, 0.9]]).double()
B = torch.tensor([[0.0], [0.1]]).double()
K = torch.tensor([[-2.0, -1.0]]).double()
W = torch.tensor([[0.02, 0.01], [0.01, 0.03]]).double()
SIGMA = prediction_covariance(A, W, N)
#: The 95 % quantile of the standard normal distribution.
QUANTILE = 1.6448536269514722


def scheme(**options) -> QPMPC:
    bounds = {"state_bounds": ([-2.0, -3.0], [2.0, 3.0]), "action_bounds": ([-1.0], [1.0])}
    settings = {**bounds, "stage_weight": [1.0, 1.0, 0.1], "learn": ("H",)}
    return QPMPC.from_model(A, B, N, **settings | options)


def errors(paths: int, K: Tensor) -> tuple[Tensor, Tensor]:
    """Simulate the errors e_k and K e_k of the predictions, (N + 1, paths, ..)."""
    v = torch.randn(N, paths, 2, generator=torch.Generator().manual_seed(0)).double()
    v = v @ torch.linalg.cholesky(W).mT
    e = [torch.zeros_like(v[0])]
    for k in range(N):
        e.append(e[-1] @ (A + B @ K).mT + v[k])
    e = torch.stack(e)
    return e, e @ K.mT


def test_the_covariance_is_the_sum_of_those_of_the_steps():
    initial = torch.eye(2).double()
    found = prediction_covariance(A, W, N, initial)
    powers = [torch.linalg.matrix_power(A, k) for k in range(N + 1)]
    for k in range(N + 1):
        steps = sum((P @ W @ P.mT for P in powers[:k]), torch.zeros_like(W))
        assert_close(found[k], powers[k] @ initial @ powers[k].mT + steps)
    assert torch.equal(prediction_covariance(A, W, N)[0], 0 * W)


def test_rows_hold_with_the_probability():
    D = torch.tensor([[1.0, 0.5, 2.0]])
    rows = {"constraints": (D, [-4.0], [4.0]), "terminal_constraints": (D[:, :2], [-5.0], [5.0])}
    mpc, loose = scheme(action_slack=10.0, **rows), scheme(action_slack=10.0, **rows)
    tighten(mpc, prediction_covariance(A + B @ K, W, N), K=K)
    e, u = errors(20000, K)
    plan = torch.cat((e, u), -1).movedim(0, 1).flatten(1)[:, :-1]  # as z without an x_0
    side = plan @ mpc.G.mT
    assert torch.equal(mpc.ub[:3], loose.ub[:3])  # x_0 is known, and so is u_0
    held = (side <= loose.ub - mpc.ub).double().mean(0)[3:]
    uncertain = (loose.ub - mpc.ub)[3:] > 0
    assert_close(held[uncertain], torch.full_like(held, 0.95)[uncertain], atol=0.01, rtol=0)
    assert_close(mpc.lb - loose.lb, loose.ub - mpc.ub)


def test_hard_rows_and_known_stages_stay():
    mpc, loose = scheme(), scheme()
    covariances = prediction_covariance(A, W, N)
    tighten(mpc, covariances)
    assert torch.equal(mpc.ub[~mpc.soft], loose.ub[~mpc.soft])
    assert torch.equal(mpc.lb[~mpc.soft], loose.lb[~mpc.soft])
    x_2 = slice(6, 8)
    std = covariances[2].diagonal().sqrt()
    assert_close(loose.ub[x_2] - mpc.ub[x_2], QUANTILE * std)


def test_the_first_covariance_is_that_of_the_current_output_behind_a_preview():
    E = torch.ones(2, 1).double()
    bounds = {"state_bounds": ([-2.0, -3.0], [2.0, 3.0]), "stage_weight": [1.0, 1.0, 0.1]}
    mpc = QPMPC.from_model(A, B, N, E=E, learn=("H",), **bounds)
    covariances = prediction_covariance(A, W, N, W)
    tighten(mpc, covariances)
    plan = mpc.ub[mpc.soft].unflatten(0, (N + 1, 2))
    std = covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    assert_close(plan, torch.tensor([2.0, 3.0]).double() - QUANTILE * std)


def test_bounds_that_would_cross_meet_halfway_and_infinite_ones_stay():
    bounds = ([-1.0, -torch.inf], [3.0, torch.inf])
    mpc = scheme(state_bounds=bounds)
    tighten(mpc, prediction_covariance(A, 1e4 * W, N))
    x = torch.stack((mpc.lb, mpc.ub))[:, mpc.soft].unflatten(1, (N + 1, 2))
    assert_close(x[:, 1:, 0], torch.ones(2, N).double())
    assert x[..., 1].isinf().all()


@refused(
    (lambda: tighten(scheme(), SIGMA, 0.4), "probability: got 0.4, expected a probability in"),
    (lambda: tighten(scheme(), SIGMA[1:]), "covariances: got shape .* expected shape"),
    (lambda: tighten(scheme(), SIGMA / 0), "covariances: got NaN or inf, expected finite"),
    (lambda: tighten(scheme(), SIGMA, K=SIGMA[0]), "K: got shape .* expected shape"),
    (lambda: tighten(None, SIGMA), "mpc: got NoneType, expected a QPMPC"),  # pyright: ignore[reportArgumentType]
    (lambda: tighten(scheme(learn=("C", "ub")), SIGMA), "mpc: got one that learns ub, expected"),
)
def test_a_mistake_is_named(call):
    call()
