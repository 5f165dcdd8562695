"""`Controller.review`: designs with planted mistakes, which the remedies mend."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from torch_qpmpc.control import linear_loop
from torch_qpmpc.control.linear_loop import LinearLoop
from torch_qpmpc.control.state_space import read_model
from torch_qpmpc.export.tables import make_tables

LAG = ([[0.9]], [[0.5]])
INTEGRATOR = ([[1.0, 0.1], [0.0, 0.8]], [[0.0], [1.0]], [[1.0, 0.0]])
INVERSE = ([[0.9, 0.0], [0.0, 0.5]], [[1.0], [1.0]], [[0.3, -1.2]])
DEAD_TIME = (np.eye(6, k=1), np.eye(6)[:, -1:], np.eye(6)[:1])
TWO_INPUTS = ([[0.9]], [[0.5, 0.4]])


def controller(model, horizon=10, filtered=None, r=None, **options):
    design = {"Q": 1.0, "dR": 0.1, "u_bounds": (-1.0, 1.0), "y_bounds": (-4.0, 4.0), **options}
    return qm.Controller(qm.LinearMPC(model, horizon, **design), **(filtered or {})), r


def made(model, *args, **options):
    made, r = controller(model, *args, **options)
    return made.review(r)


def fast(**filtered):
    return {"horizon": 20, "dR": None, "R": 1e-6, "filtered": filtered}


def weighted(R):
    return {"R": float(R)}


#: A mistake, the finding that names it, its remedy, and what the remedy changes when it is followed
#: word by word, from its groups.
MISTAKES = {
    "inputs without a weight": (
        (TWO_INPUTS, {"dR": None}),
        ("cost", r"Raise the weights of the inputs to R={'u1': (0\.02), 'u2': 0\.02}\."),
        weighted,
    ),
    "prices alone": (
        (LAG, {"Q": None, "dR": None, "linear": {"u1": 0.3}}),
        ("cost", r"Raise the weights of the inputs to R={'u1': (0\.0003)}\."),
        weighted,
    ),
    "a set-point out of reach": (
        (LAG, {"r": [7.0]}),
        ("set-points", r"Set y1 to (4), not 7, or widen y_bounds of y1\."),
        lambda y: {"r": [float(y)]},
    ),
    "a band out of reach": (
        (LAG, {"y_bounds": (10.0, 20.0)}),
        ("set-points", r"Let y_bounds of y1 overlap (-5) \.\. 5\."),
        lambda lower: {"y_bounds": (float(lower), 20.0)},
    ),
    "a hard bound of an output": (
        (INTEGRATOR, {"y_slack": np.inf}),
        ("hard bounds", r"Give y1 a finite y_slack\."),
        lambda: {"y_slack": 100.0},
    ),
    "an inverse response and a short horizon": (
        (INVERSE, {"horizon": 3}),
        ("horizon", r"Take a horizon of (32) or more\."),
        lambda N: {"horizon": int(N)},
    ),
    "a dead time and a short horizon": (
        (DEAD_TIME, {"horizon": 4}),
        ("horizon", r"Take a horizon of (12) or more\."),
        lambda N: {"horizon": int(N)},
    ),
    "a disturbance that looks like the state": (
        (([[0.99999]], [[0.5]]), {"disturbances": {"y1": "output"}}),
        ("disturbances", r"Take disturbances='(auto)': the disturbance of y1 looks like a.*"),
        lambda auto: {"disturbances": auto},
    ),
    "no disturbances": (
        (LAG, {"disturbances": None}),
        ("offset", r"Take disturbances='(auto)': one for each output\."),
        lambda auto: {"disturbances": auto},
    ),
    "a mode without a weight": (
        (INTEGRATOR[:2], {"Q": [0.0, 1.0]}),
        ("terminal weight", r"Weight an output that shows this mode, by Q\."),
        lambda: {"Q": [1.0, 1.0]},
    ),
    "a discount that forgets an unstable plant": (
        (([[1.1]], [[0.5]]), {"gamma": 0.5, "Q": 1e-4, "dR": 1.0}),
        ("stability", r"Take gamma=(1)\."),
        lambda gamma: {"gamma": float(gamma)},
    ),
    "a filter that trusts all": (
        (INTEGRATOR, fast(noise=0.1, drift=1.0)),
        ("margin", r"Slow .*, noise={'y1': (1)}\), or raise R and dR tenfold\."),
        lambda noise: fast(noise={"y1": float(noise)}, drift=1.0),
    ),
    "inputs that set-points leave free, without a weight": (
        (TWO_INPUTS, {}),
        ("terminal weight", r"Weight all inputs by R: several of them hold the same outputs\."),
        lambda: {"R": 0.01},
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_planted_mistake_is_named_and_its_remedy_mends_it(mistake):
    (model, options), (name, remedy), change = MISTAKES[mistake]
    design = {"model": model, **options}
    fault = made(**design)[name]
    assert not fault.ok
    words = re.fullmatch(remedy, fault.remedy)
    assert words, fault.remedy
    changed = {**design, **change(*words.groups())}
    assert made(**changed).faults == []
    run, mended = loop(**design), loop(**changed)
    # In the weights and units of the mended design.
    unit = (run.r / mended.r)[0] if design["model"] != changed["model"] else 1.0
    before = replace(mended, y=run.y / unit, u=run.u)
    assert mended.costs(mended.u_s).sum() <= 1.001 * before.costs(mended.u_s).sum()


#: A lag that a log has identified, with slow noise that the outputs hardly show.
NOISY = replace(read_model(LAG), noise=(np.array([[0.02]]), np.eye(1)))


def test_deviations_by_noise_are_those_of_the_impulse_of_each_innovation():
    looped, _ = controller(NOISY, u_bounds=None, y_bounds=None)
    mpc, x, costs = looped.mpc, np.zeros(1), []
    for k in range(150):
        y = x + (k == 1)  # it begins at rest
        (u,) = looped.step(y, [0.0])
        costs.append((float(y @ y), u**2))
        x = 0.9 * (x + 0.02 * (k == 1)) + 0.5 * u
    linear, noise = LinearLoop.of(mpc, looped.observer), mpc.design.plant.noise
    assert noise is not None
    cost, moved = linear.under(noise, mpc.design.Q)
    assert (cost, moved[0] ** 2) == pytest.approx(np.sum(costs, 0), rel=1e-6)
    held = 1 + (0.9 * 0.02) ** 2 / (1 - 0.9**2)
    held_loop = LinearLoop.of(mpc, looped.observer, held=True)
    assert held_loop.under(noise, mpc.design.Q) == (pytest.approx(held), 0.0)


def test_a_review_makes_the_tables_of_a_plan_and_its_target_once(monkeypatch):
    looped, made_of = controller(NOISY)[0], []
    monkeypatch.setattr(linear_loop, "make_tables", lambda x: made_of.append(x) or make_tables(x))
    assert "noise" in [finding.name for finding in looped.review(r=[0.0]).findings]
    assert made_of == [looped.mpc.plan, looped.mpc.targets]


def noisy(L=0.02, S=1e-3, A=0.9):
    return replace(NOISY, A=np.array([[A]]), noise=(np.array([[L]]), S * np.eye(1)))


def test_a_filter_that_takes_noise_for_disturbances_is_named_and_its_remedy_mends_it():
    filtered = {"drift": 10 * controller(noisy())[0]._law.drift}
    fault = made(noisy(), dR=1e-3, filtered=filtered)["noise"]
    words = re.fullmatch(r"Slow .*drift={'(disturbance of y1)': (.*)}\), or .*", fault.remedy)
    assert words, fault.text
    filtered = {"drift": {words[1]: float(words[2])}}
    assert made(noisy(), dR=1e-3, filtered=filtered)["noise"].ok
    assert made(noisy(A=1.1), dR=1e-3, filtered=filtered)["noise"].ok, "it must act"


@pytest.mark.parametrize("weights", [{"R": 1e-4}, {"R": 0.1}, {"R": 10.0, "dR": 1.0}])
@pytest.mark.parametrize("L", [0.0, 0.1, 0.5])
def test_what_the_default_filter_passes_on_is_the_price_of_no_offset(weights, L):
    assert made(noisy(L), **{"dR": None, **weights})["noise"].ok


def test_noise_that_drives_inputs_to_their_bounds_is_named_and_its_remedy_mends_it():
    model, dR = noisy(0.5, 0.25), 1e-4
    while not (fault := made(model, dR=dR)["noise"]).ok:
        assert dR < 10, fault.text
        assert "raise R and dR tenfold" in fault.remedy
        dR *= 10
    assert dR > 1e-4
    assert made(model, dR=1e-4, u_bounds=None)["noise"].ok, "there is no bound"


def loop(model, **options):
    looped, r = controller(model, **options)
    noise = 0.01 * looped.mpc.design.y_bounds[1]
    r = 10 * noise if r is None else r
    return looped.simulate(steps=40, r=r, load=0.05, noise=noise)


@pytest.mark.parametrize("model", [LAG, INTEGRATOR, DEAD_TIME])
def test_a_sound_design_has_no_fault(model):
    found = made(model, 15, r=[0.5])
    assert found.faults == []
    assert len(found.findings) == 9
    assert str(found).startswith(
        "0 faults in 9 findings\nok    cost: Each plan has a cost with one"
    )
    assert all(x.text[0].isupper() and x.text[-1] == "." for x in found.findings)


def test_a_slow_mode_that_inputs_hardly_move_is_told_a_smaller_order():
    """As of a log whose level drifts, which hides the gain: 'auto' is taken already."""
    plant = np.diag([0.4, 0.999]), [[0.6], [-0.00098]], [[1.0, 1.0]]
    fault = made(plant)["disturbances"]
    assert not fault.ok
    assert fault.remedy.startswith("Take a model of smaller order: ")
    assert made(([[0.4]], [[0.6]]))["disturbances"].ok


@pytest.mark.parametrize("moves", [0.01, 1.0])
def test_a_log_that_shows_an_input_s_effect_less_than_the_noise_is_a_fault(moves):
    rng, y = np.random.default_rng(2), np.zeros(61)
    u = moves * rng.choice([-1.0, 1.0], 12).repeat(5)
    for k in range(60):
        y[k + 1] = 0.8 * y[k] + u[k]
    log = qm.read_log({"T": y + 0.2 * rng.normal(size=61), "q": np.append(u, 0.0)}, ["T"], ["q"])
    mpc = qm.LinearMPC(qm.identify(log, 5, order=1), 10, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0))
    found = qm.Controller(mpc).review()["model"]
    assert found.text.startswith("Errors 5 steps ahead, of the log's deviations: T ")
    assert found.ok == (moves == 1.0)
    assert found.ok or found.remedy.startswith("The log does not show how to move T: ")


def test_findings_are_about_the_last_known_signals_or_those_passed():
    options = {"E": [[0.1]], "known": ["rain"], "u_bounds": (0.0, 5.0), "y_bounds": (0.0, 50.0)}
    controller = qm.Controller(qm.LinearMPC(LAG, 12, Q=1.0, dR=0.1, **options))
    controller.reset(y=[20.0], u=[2.0], known=[10.0])
    found = controller.review(r=[35.0])
    assert found["set-points"].text == "At rain 10 the outputs reach y1 10 to 35."
    assert found.faults == []
    (fault,) = controller.review(r=[35.0], known=[5.0]).faults
    assert fault.remedy == "Set y1 to 30, not 35, or widen u_bounds of u1."
    controller.reset()
    assert controller.review()["set-points"].text.startswith("At rain 0 (assumed) the outputs")


@pytest.mark.usefixtures("rough_fits")
def test_a_log_s_means_are_assumed_and_offsets_below_its_noise_are_no_fault():
    rng, y = np.random.default_rng(0), np.zeros(400)
    u, d = rng.uniform(0, 4, (2, 400))
    for k in range(399):
        y[k + 1] = 0.8 * y[k] + 0.5 * u[k] + 0.5 * d[k] + 0.2 * rng.normal()
    log = {"T": y, "q": u, "d": d + 6.0}
    model = qm.identify(qm.read_log(log, outputs=["T"], inputs=["q"], known=["d"]), horizon=8)
    mpc = qm.LinearMPC(model, 8, Q=1.0, dR=0.1, u_bounds=(0.0, 4.0))
    found = (controller := qm.Controller(mpc)).review()["set-points"]
    assert found.text.startswith(f"At d {log['d'][:-1].mean():.4g} (assumed) the outputs")
    top = found.numbers["T reaches"][1]
    assert controller.review(r=[top + 0.15])["set-points"].ok
    assert not controller.review(r=[top + 0.4])["set-points"].ok


@pytest.mark.parametrize(
    ("gains", "lower", "upper"),
    [
        ([1.0, 2.0, 2.0], [-1.0, None, None], [1.0, None, 2.0]),
        ([0.0, 2.0, -3.0], [None, -1.0, None], [None, 2.0, None]),
        ([3.0, -1.0, 3.0], [-2.0, None, None], [1.0, None, 1.0]),
    ],
)
def test_a_reach_without_an_end_is_no_fault(gains, lower, upper):
    """HiGHS called the search for the end infeasible, so that no input seemed to hold the plant."""
    finding = made(([[0.4]], [gains]), dR=1.0, y_bounds=None, u_bounds=(lower, upper), r=[1.0])
    assert finding["set-points"].ok
    assert finding["set-points"].numbers["y1 reaches"].tolist() == [-np.inf, np.inf]


def test_outputs_reach_what_the_zones_of_others_leave():
    """y2, without a weight, moves with y1."""
    model = ([[0.9]], [[0.5]], [[1.0], [0.5]])
    design = {"Q": [1.0, 0.0], "dR": 0.1, "u_bounds": (-1.0, 1.0)}
    for zone, expected in ((None, [-5, 5]), ((-1.0, 0.5), [-2, 1]), ((4.0, 5.0), [-5, 5])):
        mpc = qm.LinearMPC(model, 10, **design, y_bounds={"y2": zone or (None, None)})
        numbers = qm.Controller(mpc).review()["set-points"].numbers
        assert np.allclose(numbers["y1 reaches"], expected)
        assert np.allclose(numbers["y2 reaches"], [-2.5, 2.5])


@pytest.mark.parametrize("least", [1.0, 2.0])
def test_an_end_of_the_reach_that_rounding_leaves_of_zero_is_zero(least):
    model = {"model": ([[0.95]], [[0.3]]), "E": [[0.1]], "u_bounds": (least, 12.0)}
    mpc = qm.LinearMPC(horizon=5, Q=1.0, dR=0.1, **model)
    finding = qm.Controller(mpc).review(r=[1.0], known=[-3.0 * least])["set-points"]
    assert " reach y1 0 to " in finding.text


COUPLED = (np.diag([0.9, 0.8]), np.array([[0.5, 0.1], [0.13, 0.47]]))


@pytest.mark.parametrize(
    ("model", "options", "r", "limits"),
    [
        (COUPLED, {"u_bounds": (10.0, 50.0)}, [300.0, 50.0], "or widen u_bounds of u1"),
        (COUPLED, {"u_bounds": (-3.17, 7.77)}, [60.0, 30.0], "or widen u_bounds of u1 and u2"),
        (
            COUPLED,
            {"u_bounds": (-3.17, 7.77), "y_bounds": {"y2": (-5, 5)}, "y_slack": 0.3},
            [10.0, 7.0],
            "or widen y_bounds of y2",
        ),
        (
            (COUPLED[0], COUPLED[1][:, :1]),
            {"u_bounds": (-1.0, 1.0)},
            [1.0, 0.3],
            "as no inputs hold these set-points together",
        ),
    ],
)
def test_set_points_of_a_remedy_pass_as_they_are_printed(model, options, r, limits):
    controller = qm.Controller(qm.LinearMPC(model, 10, Q=[1.0, 0.05], dR=0.1, **options))
    fault = controller.review(r=r)["set-points"]
    assert not fault.ok
    assert f", {limits}." in fault.remedy
    typed = dict(zip(("y1", "y2"), r, strict=True))
    typed |= {y: float(x) for y, x in re.findall(r"Set (y\d) to (\S+), not", fault.remedy)}
    assert controller.review(r=typed)["set-points"].ok


def test_known_signals_that_no_input_balances_are_a_fault():
    options = {"E": [[1.0]], "known": ["d"], "u_bounds": (-1.0, 0.0)}
    controller = qm.Controller(qm.LinearMPC(([[1.0]], [[0.5]]), 10, Q=1.0, dR=0.1, **options))
    finding = controller.review(known={"d": [5.0]})["set-points"]
    assert not finding.ok
    assert finding.text == "At d 5 the plant rests with no input within its bounds."
    assert finding.remedy == "Widen u_bounds."
    assert controller.review(known={"d": [0.2]})["set-points"].ok


@pytest.mark.parametrize("horizon", [10, 30])
def test_an_integrator_responds_as_early_with_any_horizon(horizon):
    model = ([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]])
    mpc = qm.LinearMPC(model, horizon, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0))
    assert qm.Controller(mpc).review()["horizon"].numbers["y1"] == 1


def test_the_noise_of_a_fit_is_no_response():
    """A dead time of six steps, with 1 % of the gain at once and an input that does nothing."""
    B = np.hstack((DEAD_TIME[1], 1e-3 * np.ones((6, 1))))
    B[0, 0] = 0.01
    text = made((DEAD_TIME[0], B, DEAD_TIME[2]), R=0.01)["horizon"].text
    assert text == "Steps of the horizon 10, until an input moves y1 6."


def test_a_learned_cost_that_is_indefinite_is_named():
    mpc = qm.LinearMPC(LAG, 5, Q=1.0, R=0.1, structure="free", step="projection", learn=("H",))
    assert qm.Controller(mpc).review().faults == []
    with torch.no_grad():
        for leaf in mpc.plan.leaves("H"):
            leaf -= 1.0
    found = qm.Controller(mpc).review()
    assert "If learning has made it indefinite, mpc.plan.reset_parameters()" in found["cost"].remedy
    with pytest.raises(KeyError):
        found["stability"]


def test_learned_bounds_that_cross_are_no_fault_of_the_cost():
    mpc = qm.LinearMPC(LAG, 5, Q=1.0, R=0.1, y_bounds=(-1.0, 1.0), learn=("lb",))
    with torch.no_grad():
        for leaf in mpc.plan.leaves("lb"):
            leaf += 3.0
    with pytest.raises(qm.QPError, match=r"^lb: got entries above ub, expected lb <= ub in every"):
        qm.Controller(mpc).review()


# The linear loop


@pytest.mark.parametrize("options", [{}, {"references": "preview"}, {"blocks": [1, 2, 5]}])
def test_the_linear_loop_is_that_of_the_controller(options):
    mpc = qm.LinearMPC(INTEGRATOR, 8, Q=1.0, R=0.1, dR=0.1, **options)
    controller = qm.Controller(mpc)
    loop = LinearLoop.of(mpc, controller.observer)
    A, B, C = loop.plant
    state, constant = np.zeros(len(loop.A)), np.array([0.1, -0.2, 0.3])  # load, bias and r
    controller.reset(y=[0.0])
    x = np.zeros(2)
    for _ in range(15):
        u = controller.step(C @ x - 0.2, [0.3])
        x = A @ x + B @ (u + 0.1)
        state = loop.A @ state + loop.B @ constant
        assert np.allclose(state, [*x, *controller.x, *controller.w, *u], atol=1e-9)


def test_the_margin_is_that_of_the_loop_s_gain():
    """The loop is unstable from the gain on that the margin of one input allows at least."""
    mpc = qm.LinearMPC(INTEGRATOR, 8, Q=1.0, R=0.1, dR=0.1)
    controller = qm.Controller(mpc)
    loop = LinearLoop.of(mpc, controller.observer)
    A_c, B_c, C_c, D_c = loop.controller
    A, B, C = loop.plant
    margin = loop.modulus_margin()

    def radius(gain):
        closed = [[A + gain * B @ D_c @ C, gain * B @ C_c], [B_c @ C, A_c]]
        return np.abs(np.linalg.eigvals(np.block(closed))).max()

    assert max(map(radius, np.linspace(1 / (1 + margin), 1 / (1 - margin), 50))) < 1
    assert radius(3.0) > 1


def test_a_known_signal_without_a_use_is_a_fault():
    """A forgotten E took away the feedforward without a word."""
    options = {"known": ["d", "cap", "price"], "E": None, "Q": 1.0, "dR": 0.1}
    own = {"u_bounds": {"u1": (0.0, "cap")}, "linear": {"u1": "price"}}
    controller = qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), 5, **options, **own))
    finding = controller.review(r=[1.0], known=[0.0, 1.0, 0.1])["known signals"]
    assert finding.text == "d moves no state, bounds nothing and is no price."
    options["E"] = [[0.1, 0.0, 0.0]]
    controller = qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), 5, **options, **own))
    assert controller.review(r=[1.0], known=[0.0, 1.0, 0.1])["known signals"].ok


def test_an_integrator_in_a_zone_alone_is_told_what_would_hold_it():
    zone = {"Q": {"y2": 1.0}, "dR": 0.1, "y_bounds": {"y1": (-1.0, 1.0)}}
    mpc = qm.LinearMPC((np.diag([1.0, 0.8]), np.eye(2) / 10), 10, **zone)
    review = qm.Controller(mpc).review(r=[0.0, 0.0])
    assert review["stability"].remedy == review["terminal weight"].remedy
    assert review["stability"].remedy == "Weight an output that shows this mode, by Q."
