"""`LinearMPC`: a linear MPC in an engineer's terms, whose QPs are `QPMPC`s."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_whole
from torch_qpmpc.control.design import (
    Design,
    Target,
    read_prices,
    read_switching,
    read_wishes,
    signals_of,
)
from torch_qpmpc.control.disturbance import Disturbances, choose
from torch_qpmpc.control.lowering import aimed, lowered, target_mpc
from torch_qpmpc.control.state_space import StateSpace, read_model
from torch_qpmpc.errors import QPError
from torch_qpmpc.files import load_file, reading, save_file
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.mpc.layout import read_blocks
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.scheme import KEYWORDS, check_keywords
from torch_qpmpc.mpc.state import KIND, check_own, stored

#: The options of a plan's `QPMPC`.
OPTIONS = {"structure": "tied", "learn": (), "solver": "daqp"}
#: What the files that `save` writes are, and what to do about a damaged one.
SAVED = "a file that save wrote", "Restore it."


class LinearMPC:
    """A linear MPC with set-points, prices of moves and disturbances.

    The plan's cost is the sum over the stages of

        (y - r)'Q(y - r) + (u - u_s)'R(u - u_s) + du'dR du + price u,    du = u_k - u_{k-1},

    without a half, with the set-point r, the input u_s of the target and the known signals of each
    stage. The target is the steady state (x_s, u_s, y_s) of the model that is nearest to r within
    the bounds, so that R moves no output off r. The terminal cost is the Riccati equation's about
    the last stage's target if it has a stabilising solution, with the slope that an endless loop
    has there if r is out of reach; else it is y_N's.

    All signals are deviations from the last target, which keeps the values near it exact. p has
    d_0, .., d_N, the known signals, less the last ones if they act on the plant; then the state
    [x - x_s; u_last - u_s; y_s - r; y_s; u_s; 1]: u_last if moves cost or are bounded, y_s - r of
    outputs with a weight, y_s and u_s of bounds and constraints, and an entry that adds a small
    constant to the values, which their errors are relative to. A preview of references has r - y_s
    in d_k instead, and with weights of inputs d_k has the u_s of its stage. `target` and `arrange`
    make p, and the `plan`'s policy is u - u_s; `Controller` does all of it.

    Args:
        model, E, dt, inputs, outputs, known: the plant; see `read_model`.
        horizon: N.
        Q, R, dR: weights by name, as a number, a vector or a matrix; zero by default.
        y_bounds, u_bounds, du_bounds: pairs (lower, upper) by name, or one pair; unbounded by
            default. Of inputs and moves they are hard; a target ignores those of moves. Bounds of
            outputs and inputs may be names of known signals that act on no state, and then vary.
        y_slack: the price of a unit of violation of an output's bounds; inf makes them hard. By
            default a violation by half the distance between the bounds costs 1000 times a stage
            with all signals that far off the target.
        constraints: bounds of combinations of outputs and inputs by a name, with the weights of
            their signals: ``{"power": ({"heater": 1.0, "fan": 0.5}, (None, 8.0))}``. A third entry
            is the price of a violation: by default as ``y_slack``'s, without outputs inf.
        terminal_constraints: the same of outputs, for the last stage alone.
        linear: price times input, as a mapping from inputs to numbers or names of known signals.
        references: ``"held"``: one r for the plan. ``"preview"``: one for each stage.
        disturbances: the ones that an observer estimates, by default one for each output; see
            `torch_qpmpc.control.disturbance.choose`.
        blocks: numbers of stages that share one input, ``[1, 1, 2, 4]`` for a horizon of 8, or
            ``[1, 1, 6]`` for a control horizon of 3. Bounds of moves then hold between blocks.
        gamma: the discount.
        violation: the share of steps in which outputs may leave a bound of theirs, by name: plans
            stay away from it by what the identified model's held-out predictions err.
        u_target: inputs that the set-points leave free rest near these, weighted by R; by name, a
            number or a vector. By default the means of the model's log, and zero without one.
        u_levels: the levels of inputs that take no others, ``{"q": (0.0, 4.0, 8.0)}``; the lowest
            is off.
        min_on, min_off: the fewest steps that such an input stays on and off, by name.
        start_cost: the cost of going on, likewise.
        integer_horizon: the stages that are decided on levels, N by default; others are relaxed.
        max_nodes: the most QPs that a search for the best plan on levels solves.
        options: ``learn``, ``structure``, ``step``, ``solver`` and ``on_failure`` of the plan's
            `QPMPC`; by default a tied structure that learns nothing, and DAQP.

    Attributes:
        design, horizon: the `Design` of the arguments, and N.
        plan: the `QPMPC` of the plan, with V, Q, the policy and what is learned.
        targets: the QPMPC whose policy maps [f_0; r; w; d; 1] to the target; see
            `torch_qpmpc.control.lowering`.

    Raises:
        QPError: an argument is invalid, or nothing has a cost.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> model = ([[0.9]], [[0.5]])  # x+ = 0.9 x + 0.5 u, which is measured
        >>> mpc = qm.LinearMPC(model, 10, Q=1.0, R=0.1, dR=0.1, u_bounds=(-1.0, 1.0))
        >>> target = mpc.target(r=[2.0])
        >>> p = mpc.arrange(x=[2.0], u_last=[0.4], target=target)
        >>> target.u + mpc.plan.policy(p).detach()  # at the set-point the input that holds it
        tensor([0.4000], dtype=torch.float64)
    """

    def __init__(
        self,
        model: Any,
        horizon: int | None = None,
        *,
        Q: Any = None,
        R: Any = None,
        dR: Any = None,
        y_bounds: Any = None,
        u_bounds: Any = None,
        du_bounds: Any = None,
        y_slack: Any = None,
        u_target: Any = None,
        violation: Any = None,
        constraints: Any = None,
        terminal_constraints: Any = None,
        linear: Mapping[str, str | float] | None = None,
        references: str = "held",
        disturbances: Any = "auto",
        blocks: Sequence[int] = (),
        gamma: float = 1.0,
        u_levels: Mapping[str, Sequence[float]] | None = None,
        min_on: Any = 1,
        min_off: Any = 1,
        start_cost: Any = 0.0,
        integer_horizon: int | None = None,
        max_nodes: int = 10_000,
        E: Any = None,
        dt: float | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        known: Sequence[str] = (),
        **options: Any,
    ) -> None:
        check_keywords("LinearMPC", options, [*KEYWORDS, *signature(LinearMPC).parameters])
        prices = [*linear.values()] if isinstance(linear, Mapping) else []
        prices += [*signals_of(y_bounds), *signals_of(u_bounds)]
        plant = read_model(model, E, dt, inputs, outputs, known, prices)
        check_whole("horizon", horizon, 1)
        ends = {"constraints": constraints, "terminal_constraints": terminal_constraints}
        wished = {"y_slack": y_slack, "u_target": u_target, "violation": violation, **ends}
        bounds = {"y_bounds": y_bounds, "u_bounds": u_bounds, "du_bounds": du_bounds}
        wishes = read_wishes(plant, None, Q=Q, R=R, dR=dR, **wished, **bounds)
        rules = {"min_on": min_on, "min_off": min_off, "start_cost": start_cost}
        rules |= {"integer_horizon": integer_horizon, "max_nodes": max_nodes}
        design = Design(
            plant=plant,
            horizon=int(horizon),  # pyright: ignore[reportArgumentType] - a number
            **wishes,
            linear=read_prices(linear, plant),
            references=references,
            disturbances=choose(plant, None),
            gamma=gamma,
            blocks=read_blocks(blocks, int(horizon)),  # pyright: ignore[reportArgumentType]
            **read_switching(u_levels, plant, **rules),
        )
        own = choose(plant, disturbances, design.scaling)
        self._start(replace(design, disturbances=own), options)

    @classmethod
    def of_design(cls, design: Design, **options: Any) -> LinearMPC:
        """Return the MPC of a ``design``, with the plan's ``options``, as the constructor's."""
        mpc = cls.__new__(cls)
        mpc._start(design, options)
        return mpc

    def _start(self, design: Design, options: dict[str, Any]) -> None:
        """Make the QPs; those of the target are not learned."""
        self.design, self.horizon = design, design.horizon
        self.plan = QPMPC(lowered(design), **{**OPTIONS, **options})
        vars(self.plan)["check_linear"] = design.plant.check_linear  # which `export_c` asks
        if self.plan.learned or self.plan.levels:
            design.plant.check_linear("learn and u_levels")
        self.targets = target_mpc(design)
        self._target_qp = self.targets.quadratic_program()

    @property
    def options(self) -> dict[str, Any]:
        """The options of the plan's `QPMPC`."""
        return {name: self.plan.arguments[name] for name in KEYWORDS}

    def __repr__(self) -> str:
        """Return its design and what it learns."""
        learned = f"; learned {', '.join(self.plan.learned)}" * bool(self.plan.learned)
        return f"LinearMPC({self.design}{learned})"

    def redesigned(self, **changes: Any) -> LinearMPC:
        """Return this MPC with other bounds or weights, ``changes`` as `Controller.redesign`'s."""
        if learned := ", ".join(self.plan.learned):
            got, remedy = f"an MPC that learns {learned}", "Change the parameters of its plan."
            raise QPError.expected("mpc", got, "one whose theta is its design's", remedy)
        design = replace(self.design, **read_wishes(self.design.plant, self.design, **changes))
        return LinearMPC.of_design(design, **self.options)

    def save(self, path: str | Path) -> None:
        """Write this MPC with its design to the file ``path``, with the errors of `QPMPC.save`.

        `LinearMPC.load` reads it, and `QPMPC.load` its plan's QP alone.
        """
        save_file(path, KIND, self.stored())

    @classmethod
    def load(cls, path: str | Path) -> LinearMPC:
        """Return the LinearMPC that `save` wrote to ``path``, with all of theta.

        Raises:
            QPError: as in `QPMPC.load`, or the file has no design.
        """
        content = load_file(path, KIND, "LinearMPC.save")
        if "design" not in content:
            remedy = "QPMPC.load reads it."
            raise QPError.expected("path", f"{path}, a QPMPC", "a saved LinearMPC", remedy)
        with reading(path, *SAVED):
            return cls.of_stored(content)

    def stored(self) -> dict[str, Any]:
        """Return the content of a file, tensors and plain values, that `of_stored` reads.

        Raises:
            QPError: a part has a parametrization that is not QPMPC's own.
        """
        check_own("save", self.plan)
        return {**stored(self.plan), "design": packed(self.design)}

    @classmethod
    def of_stored(cls, content: Mapping[str, Any]) -> LinearMPC:
        """Return the LinearMPC of the ``content`` of a file."""
        options = {name: content["arguments"][name] for name in KEYWORDS}
        parts = unpacked(content["design"])
        if (dynamics := parts["plant"].get("dynamics")) is not None:
            parts["plant"]["dynamics"] = LearnedModel(**dynamics)
        parts["plant"] = StateSpace(**parts["plant"])
        parts["disturbances"] = Disturbances(**parts["disturbances"])
        mpc = cls.of_design(Design(**parts), **options)
        if mpc.plan.learned:  # else theta is the design's
            mpc.plan.load_state_dict(content["mpc"])
        return mpc

    def target(self, r: Any, w: Any = 0.0, known: Any = None) -> Target:
        """Return the steady states within the bounds that are nearest to set-points.

        If a plant that integrates has no steady state within the bounds, the inputs exceed them as
        little as possible. All arguments are differentiable.

        Args:
            r: ``(*batch, n_y)``.
            w: the disturbances ``(*batch, n_w)``, or a number for all.
            known: the known signals ``(*batch, n_d)``, or a number for all; by default
                `Design.nominal`.

        Raises:
            QPError: a shape is wrong.
        """
        nominal = torch.from_numpy(self.design.nominal)
        values = {"r": r, "w": w, "known": nominal if known is None else known}
        sizes = len(self.design.Q), len(self.design.disturbances.names), len(nominal)
        parts = {name: torch.as_tensor(x, dtype=torch.float64) for name, x in values.items()}
        batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts.values()))
        r, w, known = _expanded(parts, zip(sizes), batch)
        s = torch.cat((r, w, known - nominal, r.new_ones(*batch, 1)), -1)

        def solve(state: Tensor) -> tuple[Tensor, Tensor]:
            solution = self.targets.solve(state, qp=self._target_qp)
            return solution.z, solution.lam

        return aimed(self.design, torch, solve, s)

    def arrange(self, x: Any, target: Target, u_last: Any = None, known: Any = None) -> Tensor:
        """Return p ``(*batch, n_p)`` in float64.

        Args:
            x: the state, ``(*batch, n)``.
            target: the `target` of the last stage; if the design is `staged`, one for each stage,
                ``(*batch, N + 1, ..)``.
            u_last: the last input, ``(*batch, m)``, by default u_s.
            known: ``(*batch, N + 1, n_d)``, by default zero, and bounds as `Design.nominal`.

        Raises:
            QPError: a shape is wrong.
        """
        design, (n, m, n_y, n_d) = self.design, self.design.plant.sizes
        if u_last is None:
            u_last = target.u[..., -1, :] if design.staged else target.u
        known = torch.from_numpy(design.nominal) if known is None else known
        values, stages = {"x": x, "known": known, "u_last": u_last}, [self.horizon + 1]
        values |= {f"target.{name}": part for name, part in target._asdict().items()}
        shapes = [[n], [*stages, n_d], [m]]
        shapes += [[*stages * design.staged, size] for size in (n, m, n_y, n_y, n_y)]
        x, known, u_last, *steady = _expanded(values, shapes, torch.as_tensor(x).shape[:-1])
        return design.arranged(torch, x, Target(*steady), u_last, known)


def _expanded(
    values: Mapping[str, Any], shapes: Iterable[Sequence[int]], batch: Sequence[int]
) -> list[Tensor]:
    """Return values of the shapes ``(*batch, *shape)`` in float64, which errors name."""
    expanded = []
    for (name, value), shape in zip(values.items(), shapes, strict=True):
        part = torch.as_tensor(value, dtype=torch.float64)
        try:
            expanded.append(part.expand(*batch, *shape))
        except RuntimeError as error:
            want = f"{shape[-1]} entries, and batch dimensions as those of the others"
            raise QPError.expected(name, f"shape {tuple(part.shape)}", want) from error
    return expanded


def packed(value: Any) -> Any:
    """Return dataclasses and named tuples as dictionaries, and arrays as tensors, but no code."""
    value = value.arguments if isinstance(value, LearnedModel) else value
    if callable(value):
        want = "what qm.identify_nonlinear returns, for a file"
        raise QPError.expected("model", "a function", want)
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: packed(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [packed(part) for part in value]
    return torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value


def unpacked(value: Any) -> Any:
    """Return tensors as arrays, and lists as tuples."""
    if isinstance(value, Mapping):
        return {name: unpacked(part) for name, part in value.items()}
    if isinstance(value, list):
        return tuple(unpacked(part) for part in value)
    return value.numpy() if isinstance(value, Tensor) else value
