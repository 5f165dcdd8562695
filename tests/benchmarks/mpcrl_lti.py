"""mpcrl's on-policy LSTD Q-learning of the linear system of Gros and Zanon, on its public API."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from scipy.linalg import solve_discrete_are

from tests.benchmarks.peers import needs
from torch_qpmpc.envs import GrosZanonLTI

#: The plant s+ = A s + B a + (e, 0); the MPC starts from a wrong model.
PHYSICS = GrosZanonLTI()
A, B = PHYSICS.A.numpy(), PHYSICS.B.numpy()
A_0, B_0 = (matrix.numpy() for matrix in PHYSICS.wrong_model())
NOISE = -0.1, 0.0
START = PHYSICS.starts(np.random.default_rng(), 1)[0].numpy()
LOWER, UPPER, PENALTY = PHYSICS.lb_s.numpy(), PHYSICS.ub_s.numpy(), PHYSICS.w
HORIZON, DISCOUNT, LEARNING_RATE = 10, 0.9, 0.05
QUIET = {
    "print_time": False,
    "bound_consistency": True,
    "calc_lam_p": False,
    "ipopt": {"sb": "yes", "print_level": 0},
}


@dataclass(frozen=True)
class Stream:
    """Costs, violations and time of one agent on one noise sequence."""

    #: ``(steps,)``
    costs: np.ndarray
    #: ``(steps,)``: total violation of the box by the state of each cost.
    violations: np.ndarray
    #: The learning loop's wall time, without building the problem.
    seconds: float


def run(seed: int, steps: int = 5000, learn: bool = True) -> Stream:
    """Run one episode under the learning agent, or under the MPC at the initial parameters.

    mpcrl seeds the plant with ``default_rng(seed).integers(2**32)``. The closed loop is chaotic:
    rounding alone moves a total by hundreds, so that other versions, solvers or processors agree
    with it on average, not digit by digit.
    """
    mpcrl, optim = needs("mpcrl"), needs("mpcrl.optim")
    mpc, first = _mpc(), _first()
    if learn:
        shaped = (mpcrl.LearnableParameter(name, v.shape, v) for name, v in first.items())
        agent = mpcrl.LstdQLearningAgent(
            mpc,
            update_strategy=1,
            discount_factor=DISCOUNT,
            optimizer=optim.NewtonMethod(learning_rate=LEARNING_RATE),
            learnable_parameters=mpcrl.LearnableParametersDict(shaped),
            hessian_type="approx",
            # As published: Q of an action at its bound would have no interior.
            remove_bounds_on_initial_action=True,
        )
        follow = agent.train
    else:
        follow = mpcrl.Agent(mpc, fixed_parameters=first).evaluate
    plant = _Plant(steps)
    began = time.perf_counter()
    follow(plant, episodes=1, seed=seed)
    seconds = time.perf_counter() - began
    return Stream(np.array(plant.costs), np.array(plant.violations), seconds)


class _Plant(gymnasium.Env):
    """The linear system, which records its costs and violations."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, steps: int) -> None:
        self.costs: list[float] = []
        self.violations: list[float] = []
        self._steps = steps
        self._s = np.array(START)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._s = np.array(START)
        self.costs.clear()
        self.violations.clear()
        return self._s, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        # mpcrl's actions are CasADi matrices.
        s, a = self._s, np.asarray(action, dtype=float).reshape(1)
        outside = np.maximum(LOWER - s, 0.0).sum() + np.maximum(s - UPPER, 0.0).sum()
        cost = float(0.5 * (s @ s + 0.5 * a @ a + PENALTY * outside))
        self.costs.append(cost)
        self.violations.append(float(outside))
        self._s = A @ s + B @ a + np.array([self.np_random.uniform(*NOISE), 0.0])
        return self._s, cost, False, len(self.costs) >= self._steps, {}


def _first() -> dict[str, np.ndarray]:
    """Return the 16 initial parameters."""
    return {
        "V0": np.zeros(1),
        "x_lb": np.zeros(2),
        "x_ub": np.array([1.0, 0.0]),
        "b": np.zeros(2),
        "f": np.zeros(3),
        "A": A_0,
        "B": B_0,
    }


def _mpc() -> Any:
    """Make the soft-constrained MPC as mpcrl's wrapper of an NLP."""
    cs, csnlp, wrappers = needs("casadi"), needs("csnlp"), needs("csnlp.wrappers")
    mpc = wrappers.Mpc(csnlp.Nlp("SX"), HORIZON)
    theta = {}
    for name, value in _first().items():
        rows, columns = value.shape if value.ndim == 2 else (value.size, 1)
        theta[name] = mpc.parameter(name, (rows, columns))
    x, _ = mpc.state("x", 2)
    u, _ = mpc.action("u", 1, lb=-1.0, ub=1.0)
    slack, _, _ = mpc.variable("slack", (2, HORIZON), lb=0.0)
    mpc.set_affine_dynamics(theta["A"], theta["B"], c=theta["b"])
    # One slack serves both bounds of an entry.
    mpc.constraint("x_lower", x[:, 1:], ">=", LOWER + theta["x_lb"] - slack)
    mpc.constraint("x_upper", x[:, 1:], "<=", UPPER + theta["x_ub"] + slack)

    stage = cs.sum1(x[:, :-1] ** 2) + 0.5 * u**2 + PENALTY * cs.sum1(slack)
    discounts = cs.DM(DISCOUNT ** np.arange(HORIZON))
    linear = cs.sum2(theta["f"].T @ cs.vertcat(x[:, :-1], u))
    terminal = cs.bilin(solve_discrete_are(A_0, B_0, 0.5 * np.eye(2), 0.25), x[:, -1])
    mpc.minimize(theta["V0"] + terminal + linear + 0.5 * stage @ discounts)
    mpc.init_solver(QUIET, solver="ipopt")
    return mpc
