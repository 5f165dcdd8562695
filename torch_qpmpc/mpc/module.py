"""QPMPC: the module that holds theta and computes V, Q and the policy (eq:qp4, eq:qp5).

All values are costs to go, as in the paper; rewards appear only in `torch_qpmpc.learning`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.checks import check_choice, check_kind, check_tensor, ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.files import load_file, reading, save_file
from torch_qpmpc.identification.identification import measured_model, model_arguments
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.levels import Levels
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.nonlinear import PlanSolution, SequentialQP, linearised
from torch_qpmpc.mpc.parameters import Leaves, Theta, for_each
from torch_qpmpc.mpc.parametrizations import (
    SIGNED,
    Banded,
    Masked,
    Tied,
    make_hessian,
    parametrizations_for,
)
from torch_qpmpc.mpc.projections import CHOLESKY, NEAREST, check_step
from torch_qpmpc.mpc.scheme import GAMMA, KEYWORDS, MODELS, Scheme, check_names
from torch_qpmpc.mpc.stage_cost import fit_rewards, scheme_cost
from torch_qpmpc.mpc.state import KIND, check_identity, check_own, encoded, identity, reduce, stored
from torch_qpmpc.mpc.validation import (
    CONSTRAINTS,
    COST,
    STRUCTURES,
    check_dynamics,
    check_learn,
    check_one_model,
    check_pair,
    learned_entries,
)
from torch_qpmpc.qp.pipeline.solve import ON_FAILURE, AtRest
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solve import solve
from torch_qpmpc.qp.solvers import backend
from torch_qpmpc.qp.tracing import full_precision, is_differentiating, is_eager

#: The parts of theta that are learned by default.
LEARN = ("H", "c", "C")


class QPMPC(Theta):
    """A parametric QP (eq:qp5) that starts from a `Scheme`.

    `from_model` makes one from a model, `from_data` from a log, `of` from a scheme's arguments.

    Its variable is z = [x_0, u_0, x_1, .., x_N], n_z = N (n_x + n_u) + n_x. The cost (eq:qpH) has a
    stage block H_k, q_k for (x_k, u_k), discounted by gamma^k, and a terminal block H_f, q_f for
    x_N, discounted by gamma^N. Parameters and buffers are float64, inputs of any float dtype;
    outputs have the input's dtype. H and H_f are the blocks; `quadratic_program` has the QP's H.

    Signals that are known ahead of time, such as prices, forecasts and references, are the
    *preview* d_0, .., d_N (``n_d`` entries each), z = [d_0, .., d_N, x_0,  u_0, x_1, .., x_N]. V
    fixes the first n_p entries p, up to x_0, and Q fixes p and u_0. All s below are p.

    Args:
        scheme: the sizes, the model, the cost, the bounds and the discount.
        learn: the parameters among H, H_f, q, c, C, b, G, lb, ub, w; the others are buffers. In a
            mapping, ``{"H": True, "C": mask}``, a mask is True at the entries that are learned.
        structure: the ties between learned parts of theta. ``"free"``: none, C is any matrix
            (eq:qp5). ``"tied"``: a linear MPC scheme (eq:q1), with one A, B, D and one entry
            of b, q, lb, ub and w for all stages. In both, the bounds of hard rows are known limits
            (eq:v1c3), and are not learned.
        step: the rule that keeps H and H_f positive semidefinite and w non-negative (eq:sdp1).
            ``"cholesky"``: theta is a factor of them. ``"projection"`` and ``"sdp"``: theta is H
            itself, which `project_` corrects after each step, by eigenvalues or by a semidefinite
            program; see `torch_qpmpc.mpc.projections`.
        solver, on_failure: see `solve_qp`.
        dynamics: the function x+ = f(x, u) that replaces the scheme's model, or f(x, u, d) with a
            preview, of tensors ``(*batch, n_x)``, ``(*batch, n_u)`` and ``(*batch, n_d)``; it may
            return the pair of x+ and a stage cost ``(*batch,)``, which is added to theta's. V is
            then a local minimum, see `torch_qpmpc.mpc.nonlinear`. A module's parameters are
            learned, too; C and b are not. `of` linearises f at the origin for A and B.
        iterations: the most QPs of a call with ``dynamics``; 1 is real-time iteration.

    Attributes:
        scheme: the `Scheme` that theta starts from.
        layout: its `Layout`.
        levels: the `Levels` of its actions; None without any. V is then the minimum over plans on
            levels, and its gradient that of the best plan's QP.
        C_0: the banded C of the initial model, ``(N n_x, n_z)``.
        sequential: the `SequentialQP` of the dynamics; None without any.
        n_p: the number of entries of p, (N + 1) n_d + n_x.

    Raises:
        QPError: an argument is invalid.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model(
        ...     torch.eye(1),
        ...     torch.eye(1),
        ...     3,
        ...     action_bounds=([-1.0], [1.0]),
        ...     stage_weight=[1.0, 0.1],
        ...     state_bounds=([-5.0], [5.0]),
        ... )
        >>> mpc.policy(torch.tensor([[0.1], [4.0]])).detach()
        tensor([[-0.0908],
                [-1.0000]])
    """

    H: Tensor
    H_f: Tensor
    q: Tensor
    c: Tensor
    C: Tensor
    b: Tensor
    G: Tensor
    lb: Tensor
    ub: Tensor
    w: Tensor
    C_0: Tensor
    discount: Tensor
    slack_discount: Tensor
    soft: Tensor
    hardness: Tensor
    repetitions: Tensor
    repeated: Tensor

    def __init__(
        self,
        scheme: Scheme,
        *,
        learn: Collection[str] = LEARN,
        structure: str = "free",
        step: str = CHOLESKY,
        solver: str = "proxqp",
        on_failure: str = "raise",
        dynamics: Callable[..., Any] | None = None,
        iterations: int = 30,
    ) -> None:
        super().__init__()
        check_kind("scheme", scheme, Scheme, "QPMPC.from_model takes A and B.")
        check_choice("structure", structure, STRUCTURES)
        check_choice("on_failure", on_failure, ON_FAILURE)
        check_step(step)
        if dynamics is not None and learn is LEARN:
            learn = tuple(x for x in LEARN if x != "C")
        check_learn(learn, structure, scheme.layout)
        backend(solver)
        self.scheme, self.layout = scheme, scheme.layout
        self.n_x, self.n_u, self.horizon = self.layout.n_x, self.layout.n_u, self.layout.horizon
        self.n_d, self.gamma = self.layout.n_d, scheme.gamma
        self.levels = Levels.of(scheme)
        self.n_p, self.n_z = self.layout.n_p, self.layout.n_z
        self.hessian, self.structure, self.step = scheme.cost.hessian, structure, step
        self.solver, self.on_failure = solver, on_failure
        check_dynamics(dynamics, learn, scheme.bounds.action_levels)
        self.sequential = None
        if dynamics is not None:
            self.sequential = SequentialQP(dynamics, self.layout, self.gamma, iterations)
        with torch.device("cpu"):
            self._start(learn)
        if (device := torch.get_default_device()).type != "cpu":
            self.to(device)

    def _start(self, learn: Collection[str]) -> None:
        """Register the scheme's theta as parameters and buffers."""
        theta = dict(self.scheme.theta)
        self.learned = tuple(name for name in (*COST, *CONSTRAINTS) if name in learn)
        self._masks = learned_entries(learn, theta)
        self.register_buffer("C_0", self.scheme.C_0.clone())
        self.register_buffer("soft", theta["w"].isfinite())
        self._derive()
        # A hard row's entry is a placeholder: inf as a parameter would have NaN gradients.
        theta["w"] = theta["w"].masked_fill(~self.soft, 0.0)
        self._block_ndims = [theta[name].ndim for name in ("H", "H_f")]
        for name, start in theta.items():
            if name in self.learned:
                own = self._parametrizations_for(name, start)
                self._attach(name, start.clone(), own)
            else:
                self.register_buffer(name, start.clone())

    @classmethod
    def of(cls, n_x: int, n_u: int, horizon: int, n_d: int = 0, **options: Any) -> Self:
        """Return a QPMPC of these sizes and of the arguments of its scheme by name.

        Args:
            n_x, n_u, horizon, n_d: see `Layout`.
            options: the keyword arguments of `QPMPC` and of `Scheme.of`, with A, B and
                ``stage_weight`` at least.

        Raises:
            QPError: an argument is missing or invalid.
        """
        own = {x: options.pop(x) for x in (*KEYWORDS, *MODELS) if x in options}
        if own.get("dynamics") is not None and options.get("A") is None:
            options |= (parts := linearised(own["dynamics"], Layout(n_x, n_u, 1, n_d)))
            if not all(x.isfinite().all() for x in parts.values()):
                got, want = "x+ or a slope with NaN or inf at the origin", "finite ones"
                raise QPError.expected("dynamics", got, want, "Or pass A and B of another point.")
        return cls(Scheme.of(n_x, n_u, horizon, n_d, **options), **own)

    @classmethod
    def from_model(cls, A: Any, B: Any, horizon: int, **options: Any) -> Self:
        """Return a QPMPC whose C starts as the banded C_0 of the model x+ = A x + B u (eq:cband).

        Args:
            A, B: see `Model`; their shapes give n_x and n_u.
            horizon: N.
            options: as in `of`; ``stage_weight`` is required, and the shape of E gives n_d.

        Raises:
            QPError: an argument is invalid, or there is no stage cost.
        """
        layout = Model(A, B, options.get("E")).layout(horizon)
        check_names(options)
        arguments = {"n_d": layout.n_d, "A": A, "B": B} | options
        return cls.of(layout.n_x, layout.n_u, layout.horizon, **arguments)

    @classmethod
    def from_data(
        cls,
        trajectories: Any,
        horizon: int,
        *,
        n_d: int | None = None,
        n_x: int | None = None,
        **options: Any,
    ) -> Self:
        """Return a QPMPC whose model is fitted to logged trajectories, with the outputs as state.

        If the outputs show only a part of the state, `identify` a model: pass its ``arguments`` to
        `of`, and let a `torch_qpmpc.envs.KalmanFilter` estimate the state. Without ``stage_weight``
        the cost is fitted to the rewards of the log, with a warning if it explains them poorly. It
        is dense unless ``hessian="diagonal"`` is passed.

        Args:
            trajectories, horizon, n_d, n_x: see `identify`.
            options: as in `of`, such as cost and bounds.

        Raises:
            QPError: as in `identify` and `QPMPC`, or there is neither a stage cost nor rewards.

        Example:
            >>> import torch, torch_qpmpc as qm
            >>> env = qm.envs.LinearSystemEnv(qm.envs.PointMass(), num_envs=4, seed=0)
            >>> log = env.rollout(50)  # random actions
            >>> mpc = qm.QPMPC.from_data(
            ...     log, 10, structure="tied", action_bounds=([-1] * 2, [1] * 2)
            ... )
            >>> tuple(mpc.model()[0].shape)
            (4, 4)
        """
        check_names(options)
        model, log = measured_model(trajectories, n_x, n_d)
        arguments = {**model_arguments(model), "horizon": horizon, **options}
        if arguments.get("stage_weight") is None:
            hessian = arguments.setdefault("hessian", "block")
            layout = Layout(len(log.outputs), len(log.inputs), horizon, n_d=len(log.known))
            fitted = fit_rewards(trajectories, layout, hessian == "diagonal", model)
            cost = scheme_cost(fitted, layout, options.get("gamma", GAMMA), hessian)
            arguments = vars(cost) | {name: x for name, x in arguments.items() if x is not None}
        return cls.of(**arguments)

    def value(self, s: Tensor, qp: QuadraticProgram | None = None) -> Tensor:
        """Return V(s) (eq:qp4), a cost to go: s ``(*batch, n_p)`` to ``(*batch,)``.

        ``qp`` and errors are as in `solve`.
        """
        return self._solve(self._checked(s), qp).value.to(s.dtype)

    def action_value(self, s: Tensor, a: Tensor, qp: QuadraticProgram | None = None) -> Tensor:
        """Return Q(s, a) (eq:qp5), a cost to go, from ``(*batch, n_p)`` and ``(*batch, n_u)``.

        ``qp`` and errors are as in `value`.
        """
        return self._solve(self._checked(s, a), qp).value.to(s.dtype)

    def policy(
        self,
        s: Tensor,
        warm_start: QPSolution | Tensor | None = None,
        qp: QuadraticProgram | None = None,
    ) -> Tensor:
        """Return pi(s), the u_0 of V's solution: s ``(*batch, n_p)`` to ``(*batch, n_u)``.

        ``warm_start``, ``qp`` and errors are as in `solve`.
        """
        s = self._checked(s)
        alone = qp is None and warm_start is None and s.is_cpu and s.numel() == self.n_p
        plain = alone and s.dtype in (torch.float32, torch.float64) and is_eager((s,))
        if plain and not is_differentiating():
            u = self._action_at_rest(s.numpy(), warm=False)
            if u is not None:
                return torch.from_numpy(u)
        return self._action(self._solve(s, qp, warm_start), s.dtype)

    def predict(self, observation: Any) -> np.ndarray:
        """Return pi(observation) as an array, without gradients: the action to apply, and no more.

        Args:
            observation: s or p, an array ``(n_p,)`` or ``(*batch, n_p)``.

        Returns:
            The actions, ``(n_u,)`` or ``(*batch, n_u)``, in the observation's float dtype.

        Raises:
            QPError: the observation has another shape, or is not finite.
            SolverError: a QP has no certified solution, whatever ``on_failure`` is.

        Example:
            >>> import numpy as np, torch_qpmpc as qm
            >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 3, stage_weight=[1.0, 0.1])
            >>> mpc.predict(np.ones((4, 1))).shape
            (4, 1)
        """
        if isinstance(ungraded("observation", observation), Tensor):
            observation = observation.detach().cpu()
        try:
            x = np.asarray(observation)
            if np.iscomplexobj(x):
                raise TypeError
            kind = x.dtype if x.dtype in (np.float16, np.float32) else np.float64
            x = np.array(x, kind, ndmin=1, order="C")  # torch warns of a read-only one
        except (TypeError, ValueError) as error:
            got, want = type(observation).__name__, f"real numbers of shape (.., {self.n_p})"
            remedy = "Pass the observation alone; env.reset and env.step return more."
            raise QPError.expected("observation", got, want, remedy) from error
        if x.shape[-1:] != (self.n_p,):
            check_tensor("observation", torch.as_tensor(x), self.n_p)
        if not np.isfinite(x).all():
            raise QPError.expected("observation", "NaN or inf", "finite numbers")
        if x.size == self.n_p and (u := self._action_at_rest(x, warm=True)) is not None:
            return u
        with torch.no_grad():
            s = torch.as_tensor(x).to(self.C_0.device)
            return self._action(self._solve(s, None, on_failure="raise"), s.dtype).cpu().numpy()

    def forward(
        self, s: Tensor, a: Tensor | None = None, qp: QuadraticProgram | None = None
    ) -> Tensor:
        """Return V(s), or Q(s, a) for an action; ``qp`` is as in `value`."""
        return self.value(s, qp) if a is None else self.action_value(s, a, qp)

    def solve(
        self,
        s: Tensor,
        a: Tensor | None = None,
        warm_start: QPSolution | Tensor | None = None,
        qp: QuadraticProgram | None = None,
    ) -> QPSolution:
        """Return the solution of V's QP, or of Q's for an action, in theta's dtype.

        Args:
            s: states ``(*batch, n_x)`` or, with more known, p ``(*batch, n_p)``.
            a: actions ``(*batch, n_u)``.
            warm_start: see `solve_qp`; with dynamics, a plan ``(*batch, N, n_u)`` or the
                `PlanSolution` that has one, which is what this returns then.
            qp: the `quadratic_program` of the current theta, if available, or one with residuals.

        Raises:
            QPError: an argument is invalid, or (with ``on_failure="raise"``) all unsolved QPs have
                invalid data.
            SolverError: with ``on_failure="raise"``, a QP has no certified solution.
        """
        return self._solve(self._checked(s, *([] if a is None else [a])), qp, warm_start)

    def policy_and_active_set(
        self,
        s: Tensor,
        warm_start: Tensor | None = None,
        qp: QuadraticProgram | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return pi(s), and the active set ``(*batch, n_g)`` as the next step's ``warm_start``.

        With dynamics, the latter is a plan that begins one step later, ``(*batch, N n_u)``. ``qp``
        is as in `solve`.
        """
        solution = self.solve(s, warm_start=warm_start, qp=qp)
        next_start = solution.later if isinstance(solution, PlanSolution) else solution.active
        return self._action(solution, s.dtype), next_start

    def predicted(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states ``(*batch, N + 1, n_x)`` and actions ``(*batch, N, n_u)`` of a plan.

        The plan is z ``(*batch, n_z)``, as `solve` returns it.
        """
        return self.layout.predicted(check_tensor("z", z, self.n_z))

    def model(self) -> tuple[Tensor, ...]:
        """Return A and B, ``(n_x, n_x)`` and ``(n_x, n_u)``, and with a preview E ``(n_x, n_d)``.

        Raises:
            QPError: C is free, and need not contain a model; or there are dynamics.
        """
        check_one_model(self)
        if self.structure == "free":
            raise QPError.expected("structure", "'free'", "'tied', which has a model")
        return Banded(self.layout).right_inverse(self.C)

    def release(self) -> None:
        """Remove the ties of a linear MPC scheme in place, without a change of values.

        The learned parts get new parameters: create the loss module and the optimiser again.
        """
        self.structure = "free"
        for part in self.learned:
            if parametrize.is_parametrized(self, part) and part not in ("H", "H_f"):
                value = getattr(self, part).detach()
                self._replace(part, self._parametrizations_for(part, value))
        # In the order of a module that is made free, as optimisers load their state by it.
        for part in [x for x in self.scheme.theta if x in self._parameters]:
            self._parameters[part] = self._parameters.pop(part)

    @torch.no_grad()
    def project_(self) -> None:
        """Make H, H_f and w non-negative in place by projection, after a step (eq:sdp1).

        Call it after each step of an optimiser; `GaussNewton` does so itself. With
        ``step="cholesky"`` it does nothing.
        """
        for name, leaf in self._projected().items():
            dense = self.hessian != "diagonal" and name != "w"
            of_plan = leaf[..., self.n_d :, self.n_d :] if dense else leaf[..., None, None]
            of_plan.copy_(NEAREST[self.step](of_plan))

    def quadratic_program(self, residuals: Mapping[str, Tensor] | None = None) -> QuadraticProgram:
        """Return the current theta as a QuadraticProgram, with discounts (eq:qpH).

        Args:
            residuals: tensors ``(*batch, ..)``, such as the outputs of a network, that are added to
                theta's `coordinates` of these names, before factors become H and w: the QPs of the
                batch then have their own theta. Parts without residuals stay shared.

        Raises:
            QPError: a residual's name, shape or device is wrong.
        """
        with full_precision(self.C_0):
            if residuals is not None:
                theta = self._moved(residuals)
            else:
                theta = {part: getattr(self, part) for part in (*COST, *CONSTRAINTS)}
            hessian = partial(make_hessian, self.layout, self.hessian, discount=self.discount)
            weights = theta["H"], theta["H_f"]
            if residuals is None:
                H = hessian(*weights)
            else:
                H = for_each(hessian, weights, self._block_ndims)
            q = self.discount * theta["q"]
            # A hard row's w is a placeholder, to which its hardness adds inf.
            w = torch.addcmul(self.hardness, self.slack_discount, theta["w"])
            c, C, b, G, lb, ub = map(theta.__getitem__, ("c", *CONSTRAINTS))
            if self.layout.blocks:
                rows = self.repetitions.expand(*C.shape[:-2], -1, -1)
                C, b = torch.cat((C, rows), -2), F.pad(b, (0, rows.shape[-2]))
                of_z, again = self.n_z - self.layout.n_preview, self.repeated
                for side in (lb, ub):  # bounds of a stage's own stay
                    z, D = side[..., :of_z], side[..., of_z:]
                    same = z == z.roll(self.layout.n, -1), D.roll(self.layout.n_mixed, -1) == D
                    again = again & torch.cat(same, -1)
                lb, ub = lb.masked_fill(again, -torch.inf), ub.masked_fill(again, torch.inf)
            return QuadraticProgram(H, q, c, C, b, G, lb, ub, w, check_values=False)

    def save(self, path: str | Path) -> None:
        """Write this QPMPC atomically to a file of tensors and plain values, which runs no code.

        A symbolic link at ``path`` is replaced. Later releases read the file.

        Raises:
            QPError: a part has a parametrization that is not QPMPC's own, or dynamics are code.
            OSError: writing failed; the old file is unchanged.
        """
        check_own("save", self)
        if isinstance(self._options().get("dynamics"), Callable):
            remedy = "Save the state_dict, and load it into a QPMPC with the same dynamics."
            want = "A and B, or a LearnedModel"
            raise QPError.expected("save", "dynamics, which are code", want, remedy)
        save_file(path, KIND, stored(self))

    @classmethod
    def load(cls, path: str | Path) -> QPMPC:
        """Return the QPMPC that `save` wrote to ``path``, on the CPU, with all of theta.

        Raises:
            QPError: the file is missing, damaged, of another kind or of another release.

        Example:
            >>> import tempfile, torch_qpmpc as qm
            >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 3, stage_weight=[1.0, 0.1])
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     mpc.save(f"{folder}/mine.qpmpc")
            ...     twin = qm.QPMPC.load(f"{folder}/mine.qpmpc")
            >>> twin.predict([1.0]) == mpc.predict([1.0])
            array([ True])
        """
        content = load_file(path, KIND)
        remedy = "Restore the file, or register the solver that it names."
        with reading(path, "a file that QPMPC.save wrote", remedy):
            arguments = {x: y for x, y in content["arguments"].items() if x != "seed"}  # unused
            mpc = cls.of(**arguments)
            mpc.load_state_dict(content["mpc"])
        return mpc

    def reset_parameters(self) -> None:
        """Reset theta to its initial values."""
        fresh = parametrize.type_before_parametrizations(self)(self.scheme, **self._options())
        for name, start in (*fresh.named_parameters(), *fresh.named_buffers()):
            owner, _, leaf = name.rpartition(".")
            # By attribute, as a functional call replaces parameters with plain tensors.
            getattr(self.get_submodule(owner), leaf).data.copy_(start.detach())

    def extra_repr(self) -> str:
        names = ["n_x", "n_u", "horizon", *["n_d"] * bool(self.n_d), "hessian", "structure"]
        return ", ".join(f"{x}={getattr(self, x)!r}" for x in (*names, "learned", "solver"))

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `QPMPC.of`, as tensors and plain values."""
        return self.scheme.arguments | self._options()

    def __reduce_ex__(self, protocol: Any) -> tuple:
        return reduce(self)

    def __copy__(self) -> QPMPC:
        twin = type(self).__new__(type(self))
        twin.__dict__.update(self.__dict__)  # a shallow copy, which shares the parameters
        return twin

    def get_extra_state(self) -> Tensor:
        """Return the identity of this QPMPC for its state_dict, as JSON bytes."""
        return encoded(identity(self))

    def set_extra_state(self, state: Tensor) -> None:
        """Do nothing: `_load_from_state_dict` has compared the identities already."""

    def _options(self) -> dict[str, Any]:
        """Return the constructor's arguments besides the scheme."""
        learn = {name: self._masks.get(name, True) for name in self.learned}
        names = ("structure", "step", "solver", "on_failure")
        options = {"learn": learn, **{name: str(getattr(self, name)) for name in names}}
        if self.sequential is not None:
            dynamics = self.sequential.dynamics
            learned = isinstance(dynamics, LearnedModel)
            options["dynamics"] = dynamics.arguments if learned else dynamics
            options["iterations"] = self.sequential.iterations
        return options

    def checked_state(self, state_dict: dict[str, Any], prefix: str) -> dict[str, Any]:
        """Return ``state_dict``, whose keys begin with ``prefix``, with an identity if it has none.

        Raises:
            QPError: it belongs to another QPMPC.
        """
        key, own = f"{prefix}_extra_state", identity(self)
        state_dict = {key: encoded(own)} | state_dict
        check_identity(state_dict[key], own)
        return state_dict

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        super()._load_from_state_dict(self.checked_state(state_dict, prefix), prefix, *args)
        self._derive()

    def _derive(self) -> None:
        """Register the buffers that follow from the arguments and are not in the state_dict."""
        discount, of_rows = self.layout.discounts(self.gamma)
        weights = of_rows if self.scheme.bounds.discount_slack else torch.ones_like(of_rows)
        hardness = torch.where(self.soft, 0.0, torch.inf)
        derived = {"discount": discount, "slack_discount": weights, "hardness": hardness}
        if self.layout.blocks:
            derived["repetitions"] = self.layout.repetitions()
            repeated = self.layout.repeated(self.scheme.of_actions).to(self.soft) & ~self.soft
            self.register_buffer("repeated", repeated, persistent=False)
        for name, buffer in derived.items():
            self.register_buffer(name, buffer.to(self.C_0), persistent=False)
        for part in self.modules():
            if isinstance(part, Masked | Tied):
                part.place(self.C_0.device)

    def _checked(self, s: Tensor, *a: Tensor) -> Tensor:
        """Return the fixed entries of z: s ``(*batch, n_p)``, or [s, a] ``(*batch, n_p + n_u)``."""
        if not a:
            return check_tensor("s", s, self.n_p, device=self.C_0.device)
        return check_pair(s, a[0], self.n_p, self.n_u, self.C_0.device)

    def _solve(
        self,
        fixed: Tensor,
        qp: QuadraticProgram | None,
        warm_start: QPSolution | Tensor | None = None,
        on_failure: str | None = None,
    ) -> QPSolution:
        qp = self.quadratic_program() if qp is None else qp
        check_kind("qp", qp, QuadraticProgram, "Pass mpc.quadratic_program(), or omit it.")
        n_kept = self.n_p + self.n_u  # V, Q and the policy share one elimination
        fixed = fixed.to(qp.C.dtype)
        on_failure = on_failure or self.on_failure
        if self.sequential is not None:
            return self.sequential.solve(qp, fixed, n_kept, self.solver, on_failure, warm_start)
        if self.levels is not None:
            return self.levels.solve(qp, fixed, n_kept, self.solver, on_failure)
        return solve(qp, fixed, n_kept, self.solver, on_failure, warm_start)

    @torch.no_grad()
    def at_rest(self) -> AtRest:
        """Return a solver of V's QPs, without levels, that keeps the current theta prepared."""
        check_one_model(self)
        return AtRest(self.quadratic_program(), self.n_p, self.n_p + self.n_u, self.solver)

    def _action_at_rest(self, x: np.ndarray, warm: bool) -> np.ndarray | None:
        """Return pi of one state, from the last active set or none; None if the QP is not solved.

        From none, it does not depend on earlier calls, so that a resumed run repeats it. The
        preparation is kept until theta changes; it is None, too, if that cannot be seen.
        """
        if self.levels is not None or self.sequential is not None:
            return None
        leaves, at_rest = vars(self).get("_at_rest", (None, None))
        if leaves is None or not leaves.unchanged(self) or at_rest.solver != self.solver:
            leaves, at_rest = Leaves(self), self.at_rest()
            vars(self)["_at_rest"] = leaves, at_rest
        if not leaves.known:
            return None
        solution = at_rest.solve(x.reshape(1, -1).astype(np.float64), warm)
        u = solution.z[0, self.n_p : self.n_p + self.n_u]
        return None if solution.status[0] else u.reshape(*x.shape[:-1], -1).astype(x.dtype)

    def _action(self, solution: QPSolution, dtype: torch.dtype) -> Tensor:
        """Return u_0 of a solution of V's QP."""
        if isinstance(solution, PlanSolution) and self.on_failure != "mask":
            solution.warn()
        return solution.z[..., self.n_p : self.n_p + self.n_u].to(dtype)

    def _parametrizations_for(self, name: str, value: Tensor) -> list[nn.Module]:
        mask = self._masks.get(name)
        if name in ("lb", "ub"):  # hard bounds, as of actuators, stay
            soft = self.soft.cpu()
            mask = soft if mask is None else mask & soft
        options = (self.layout, self.structure, self.hessian, self.step, mask)
        return parametrizations_for(name, value, *options)

    def _projected(self) -> dict[str, nn.Parameter]:
        """Return the parameters that `project_` projects, by part."""
        names = () if self.step == CHOLESKY else SIGNED
        return {name: self.leaves(name)[0] for name in names if name in self.learned}
