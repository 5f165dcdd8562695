"""Logs from CSV files, DataFrames and arrays."""

import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.logs import NAMES, arx_log, lengths, room
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.identification.log import Log


def same(one: Log, other: Log) -> bool:
    pairs = zip(one.trajectories, other.trajectories, strict=True)
    return all(
        torch.allclose(x, y, rtol=1e-14) for a, b in pairs for x, y in zip(a, b, strict=True)
    )


# The forms


def test_rows_are_steps_and_the_last_one_needs_outputs_alone():
    frame = room()
    frame.loc[59, ["q", "T_out"]] = np.nan
    log = qm.read_log(frame, **NAMES, time="t")
    (part,) = log.trajectories
    assert (part.y.shape, part.u.shape, part.d.shape) == ((60, 1), (59, 1), (59, 1))
    assert part.y.dtype == torch.float64
    assert part.y[:, 0].tolist() == frame["T"].tolist()
    assert part.d[:, 0].tolist() == frame["T_out"].tolist()[:-1]
    assert (log.outputs, log.inputs, log.known, log.dt) == (("T",), ("q",), ("T_out",), 0.25)
    assert "0.0% of rows dropped" in str(log)


def test_all_forms_are_the_same_log(tmp_path):
    frame = room()
    expected = qm.read_log(frame, **NAMES)
    file = tmp_path / "room.csv"
    frame.to_csv(file, index=False)
    arrays = {name: frame[name].to_numpy(copy=True) for name in frame}
    dated = frame.set_index(pd.date_range("2024-03-01", periods=60, freq="15min"))
    tensors = {name: torch.tensor(array) for name, array in arrays.items()}
    for data in (file, str(file), arrays, tensors, dated):
        assert same(qm.read_log(data, **NAMES), expected)
    masked = {name: np.ma.masked_values(array, array[7]) for name, array in arrays.items()}
    frame[frame == frame.iloc[7]] = np.nan
    assert same(qm.read_log(masked, **NAMES), qm.read_log(frame, **NAMES))
    shorter = {"T": arrays["T"], "q": arrays["q"][:-1], "T_out": arrays["T_out"][:-1]}
    assert same(qm.read_log(shorter, **NAMES), expected)


def test_arrays_and_columns_have_names_by_default():
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(20, 2)), rng.normal(size=(19, 1))
    log = qm.read_log({"y": y, "u": u})
    assert (log.outputs, log.inputs, log.known) == (("y1", "y2"), ("u",), ())
    assert_close(log.trajectories[0].y, torch.as_tensor(y))
    frame = pd.DataFrame({"y1": y[:, 0], "y2": y[:, 1], "u": y[:, 0], "d": y[:, 1]})
    with pytest.warns(UserWarning, match="u is a linear function of y1; d is a linear function of"):
        assert qm.read_log(frame).known == ("d",)


def test_steps_of_torchrl_get_names():
    log = qm.read_log(arx_log(), ["T", "p"], ["q"], ["w"])
    assert str(log) == "120 steps: outputs T, p; inputs q; known w"
    assert qm.identify(log, 4, order=0).log is log
    with pytest.raises(QPError, match=r"^inputs: got \['q', 'v'\], expected 1 names"):
        qm.read_log(arx_log(), ["T", "p"], ["q", "v"])
    with pytest.raises(QPError, match=r"^time, episode: got 't' and None, expected None for a"):
        qm.read_log(arx_log(), time="t")


def test_units_in_headers_are_kept():
    frame = room().rename(columns={"T": "T [degC]", "q": " q[kW]"})
    log = qm.read_log(frame, **NAMES)
    assert log.units == {"T": "degC", "q": "kW"}
    assert str(log).startswith("59 steps: outputs T [degC]; inputs q [kW]; known T_out\n60 rows: ")
    assert "RMSE of T [degC]" in str(qm.identify(log, 4))


TABLE: Any = room()[["T", "q", "T_out"]]
LINES = TABLE.to_csv(index=False).splitlines()
HEADER, ROWS = LINES[0], LINES[1:]
TWICE = "column: got 'T', which is there twice, expected one of T, q, T_out"


@pytest.mark.parametrize(
    ("lines", "steps"),
    [
        ([HEADER, *(f"{row}," for row in ROWS)], [59]),
        ([HEADER, *(f"{row},,," for row in ROWS)], "Length of header"),
        ([f"{HEADER},", *(f"{row}," for row in ROWS)], [59]),
        (["\ufeff", HEADER.replace(",", " , "), "", *ROWS], [59]),
        ([HEADER, *ROWS[:20], HEADER, *ROWS[20:]], [19, 39]),
        ([HEADER.replace("q", "q1"), *ROWS[:20], HEADER.replace("q", "q1"), *ROWS[20:]], [19, 39]),
        ([HEADER, *(f"{row},1" for row in ROWS)], "expected .* begins with a name for each field"),
        ([HEADER, ROWS[0], *(f"{row},1" for row in ROWS)], "Expected 3 fields in line 3, saw 4"),
        ([f"{HEADER},T", *(f"{row},1" for row in ROWS)], TWICE),
        ([], "which cannot be read"),
    ],
)
def test_a_file_is_read_by_its_header(tmp_path, lines, steps):
    """Without a delimiter too many, and without columns that move."""
    (file := tmp_path / "room.csv").write_text("\n".join(lines), encoding="utf-8")
    if isinstance(steps, str):
        with pytest.raises(QPError, match=steps):
            qm.read_log(file, **NAMES)
        return
    inputs = ["q1" if any("q1" in line for line in lines) else "q"]
    log = qm.read_log(file, **{**NAMES, "inputs": inputs})
    assert lengths(log) == steps
    read = torch.cat([part.y for part in log.trajectories])[:, 0]
    assert torch.allclose(read, torch.as_tensor(TABLE["T"].to_numpy()), rtol=1e-14)


@pytest.mark.parametrize(
    ("sep", "decimal", "encoding"),
    [
        (";", ",", "utf-8"),
        (";", ",", "cp1252"),
        (";", ".", "utf-8-sig"),
        ("|", ".", "utf-8"),
        ("\t", ",", "utf-8"),
        ("\t", ",", "utf-16"),
    ],
)
def test_a_file_of_another_country_is_read(tmp_path, sep, decimal, encoding):
    frame = room().rename(columns={"T": "T [°C]", "t": "t [h]"})
    text = frame.to_csv(index=False, sep=sep, decimal=decimal)
    (file := tmp_path / "room.csv").write_bytes(text.encode(encoding))
    log = qm.read_log(file, **NAMES, time="t")
    assert same(log, qm.read_log(frame, **NAMES, time="t"))
    assert (log.units, log.dt, log.dt_unit) == ({"T": "°C"}, 0.25, "h")
    assert str(log).startswith("59 steps, one step every 0.25 h: outputs T [°C]; inputs q;")


@pytest.mark.parametrize(
    ("sep", "decimal", "thousands", "remedy"),
    [
        (";", ",", ".", "decimal=.., thousands=.."),
        ("\t", ".", ",", "decimal=.., thousands=.."),
        (";", ",", " ", "thousands=' '"),
        (";", ",", "\u202f", r"thousands='\u202f'"),
        (",", ".", "'", 'thousands="\'"'),
        (",", ".", ",", "thousands=',' or decimal=','"),
    ],
)
def test_separated_thousands_are_an_error_with_a_remedy_that_works(
    tmp_path, sep, decimal, thousands, remedy
):
    """Of whole numbers: with a delimiter other than a comma, 101.000 was read as 101."""
    frame = room()
    frame["T"] = (1000 * frame["T"] + 100000).round()
    text = frame.assign(T=[f"{x:,.0f}".replace(",", thousands) for x in frame["T"]])
    text.to_csv(tmp_path / "a.csv", index=False, sep=sep, decimal=decimal)
    with pytest.raises(QPError) as error:
        qm.read_log(tmp_path / "a.csv", **NAMES)
    assert f"pandas.read_csv(.., sep=.., engine='python', {remedy})" in str(error.value)
    options: Any = {"sep": sep, "decimal": decimal, "thousands": thousands}
    read = pd.read_csv(tmp_path / "a.csv", engine="python", **options)
    assert same(qm.read_log(read, **NAMES), qm.read_log(frame, **NAMES))


@pytest.mark.parametrize("rows", [1, 60])
def test_rows_that_are_there_twice_count_once(rows):
    """Else the time of a step would be half of it, or a trajectory end."""
    frame = room()
    doubled = pd.concat([frame[:rows].loc[frame.index[:rows].repeat(2)], frame[rows:]])
    log, expected = (qm.read_log(x, **NAMES, time="t") for x in (doubled, frame))
    assert same(log, expected)
    assert log.dt == 0.25
    assert f"{rows} row{'s' * (rows > 1)} left out that repeat the one before" in str(log)


def test_an_error_of_a_spreadsheet_is_a_missing_number():
    column = room()["T"].astype(object)
    column[7] = "#DIV/0!"
    log = qm.read_log(room().assign(T=column), **NAMES)
    assert int(log.trajectories[0].y.isnan().sum()) == 1


@pytest.mark.parametrize("time", [None, "", "Unnamed: 0"])
@pytest.mark.parametrize("kind", ["DatetimeIndex", "TimedeltaIndex", "PeriodIndex"])
def test_the_index_that_pandas_wrote_is_the_times(tmp_path, kind, time):
    index: Any = pd.date_range("2024-01-01", periods=60, freq="7min", tz="UTC")
    if kind != "DatetimeIndex":
        index = index - index[0] if kind == "TimedeltaIndex" else clock_periods(index)
    frame = room().drop(columns="t").set_index(index).drop(index=index[20:27])
    frame.to_csv(tmp_path / "a.csv")
    expected = qm.read_log(frame, **NAMES)
    assert (lengths(expected), expected.dt) == ([19, 32], 420)
    log = qm.read_log(tmp_path / "a.csv", **NAMES, time=time)
    assert same(log, expected)
    assert (log.dt, log.dt_unit) == (420, "s")


def clock_periods(index: pd.DatetimeIndex) -> pd.PeriodIndex:
    return index.tz_localize(None).to_period("7min")


def test_the_numbers_that_pandas_wrote_are_no_times(tmp_path):
    frame = room().drop(index=range(20, 30))
    frame.to_csv(tmp_path / "a.csv")
    assert lengths(qm.read_log(tmp_path / "a.csv", **NAMES)) == [49]
    assert lengths(qm.read_log(tmp_path / "a.csv", **NAMES, time="")) == [19, 29]


def test_a_signal_has_its_header_or_its_name():
    frame = room().rename(columns={"T": "TI-101 [degC]", "q": "q [kW]", "t": "t [min]"})
    names: Any = {"outputs": ["TI-101 [degC]"], "inputs": "q [kW]", "known": ["T_out"]}
    log = qm.read_log(frame, **names, time="t [min]")
    assert (log.outputs, log.inputs, log.dt_unit) == (("TI-101",), ("q",), "min")
    assert same(log, qm.read_log(frame, ["TI-101"], ["q"], ["T_out"], time="t"))
    both = frame.assign(**{"TI-101 [K]": 273.15 + frame["TI-101 [degC]"]})
    log = qm.read_log(both, ["TI-101 [K]"], ["q"])
    assert (log.outputs, log.trajectories[0].y[0, 0].item()) == (("TI-101 [K]",), 273.15)
    with pytest.raises(QPError, match=r"got 'TI-101', which is missing, .* TI-101 \[degC\], q"):
        qm.read_log(both, ["TI-101"], ["q"])
    with pytest.raises(QPError, match=r"^data: got q in kW and in W, expected one unit in all"):
        qm.read_log([frame, room().rename(columns={"q": "q [W]", "T": "TI-101"})], **names)


@pytest.mark.parametrize("names", [["T", "d"], ["d", "q1"], ["y", "u1"], ["known", "time"]])
def test_a_signal_may_have_any_name(names):
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(30, 2)), rng.normal(size=30)
    log = qm.read_log({names[0]: y[:, 0], names[1]: y[:, 1], "u": u, "t": u}, names, ["u"])
    assert (log.outputs, log.inputs, log.known) == (tuple(names), ("u",), ())
    assert qm.LinearMPC(qm.identify(log, 2, order=0), 3, Q=1.0).horizon == 3
    assert qm.read_log({"y": u, "u": u**2, "d": np.arange(30)}, time="d").known == ()


# Gaps, marks and missing numbers


def test_gaps_marks_and_missing_inputs_end_trajectories_and_missing_outputs_stay():
    frame = room()
    frame.loc[10:, "t"] += 5.0  # between rows 9 and 10
    frame.loc[20, "T"] = np.nan
    frame["run"] = np.where(frame.index < 40, "a", "b")
    frame.loc[50, "q"] = np.inf
    frame.loc[51, "T"] = 1e200
    frame["T"] = frame["T"].astype(object)
    frame.loc[59, "T"] = "n/a"
    log = qm.read_log(frame, **NAMES, time="t", episode="run")
    assert lengths(log) == [9, 29, 10, 6]
    note = "60 rows: 1 gap, 4 trajectories, 3.3% of rows dropped, 1.7% of outputs missing"
    assert log.notes[0] == note
    assert log.trajectories[1].y.isnan().flatten().nonzero().flatten().tolist() == [10]
    assert log.notes[1:] == ("T is no number in 1 row, as in 'n/a'",)
    assert_close(
        log.trajectories[1].y[:10, 0], torch.as_tensor(np.array(frame["T"][10:20], dtype=float))
    )


# What is wrong with columns


def test_constant_and_collinear_columns_are_named():
    frame = room().assign(valve=3.0)
    frame["F"] = 1.8 * frame["T"] + 32 + 0.5 * frame["q"]
    names: Any = {"outputs": ["T"], "inputs": ["q", "valve"], "known": ["T_out", "F"]}
    message = "In this log, valve is constant at 3; F is a linear function of T, q."
    with pytest.warns(UserWarning, match=message):
        log = qm.read_log(frame, **names)
    assert log.notes[1:] == ("valve is constant at 3", "F is a linear function of T, q")
    del names["known"]
    with pytest.warns(UserWarning, match="valve"):
        log = qm.read_log(frame, **names)
    with pytest.raises(QPError, match="action: got valve constant at 3, expected one that moves"):
        qm.identify(log, 4)


@pytest.mark.parametrize(("number", "rows"), [(-9999.0, 3), (-999.25, 2), (1e31, 2), (9999.0, 0)])
def test_numbers_that_mark_missing_ones_are_named(number, rows):
    frame = room()
    frame.loc[list(range(5, 5 + rows)), "q"] = number
    frame.loc[9, "T_out"] = 1e4  # once: it may have been so
    with warnings.catch_warnings(record=True, action="always") as caught:
        log = qm.read_log(frame, **NAMES)
    said = [f"q is {number:.6g} in {rows} rows, far from all others, which may mark missing"]
    assert [str(x.message)[: len(said[0]) + 13].split(", ", 1)[1] for x in caught] == said[:rows]
    assert len(log.notes) == 1 + len(caught)


@pytest.mark.parametrize(("rows", "said"), [(2, True), (3, True), (1, False), (30, False)])
def test_a_few_numbers_that_are_far_from_all_others_are_named(rows, said):
    rng = np.random.default_rng(0)
    y = rng.normal(size=200)
    y[rng.choice(200, rows, replace=False)] = (
        1e3 * rng.choice([-1, 1], rows) * (2 + np.arange(rows))
    )
    log = {"y": y, "u": rng.normal(size=200)}
    with warnings.catch_warnings(record=True, action="always") as caught:
        qm.read_log(log)
    named = f"In this log, y is far from all others in {rows} rows, such as "
    assert [str(x.message)[: len(named)] for x in caught] == [named] * said


def slow(hold: int, step: float = 0.0) -> dict[str, np.ndarray]:
    """Return the log of two outputs, of which a sensor shows the first in every fifth row."""
    rng = np.random.default_rng(0)
    u, y = rng.uniform(0, 12, 200 // hold + 1).repeat(hold)[:200], np.full((200, 2), 18.0)
    for k in range(199):
        y[k + 1] = y[k] - 0.1 * (y[k] - 5) + 0.25 * u[k]
    y = y + 0.03 * rng.normal(size=(200, 2))
    y = np.round(y / step) * step if step else y
    return {"y1": y[np.arange(200) // 5 * 5, 0], "y2": y[:, 1], "u": u}


@pytest.mark.usefixtures("rough_fits")
def test_the_repeats_of_a_slow_sensor_are_missing():
    """They made it a random walk in short logs."""
    with pytest.warns(UserWarning, match="y1 has a new value every 5 rows: its repeats are taken"):
        log = qm.read_log(slow(8))
    assert log.trajectories[0].y.isfinite().sum(0).tolist() == [40, 200]
    assert qm.identify(log).R2[-1].min() > 0.98


def set_point(rows: int) -> dict[str, np.ndarray]:
    """Return the log of a loop whose set-point, an output, changes every so many rows."""
    rng = np.random.default_rng(0)
    r, y, u = rng.uniform(0, 9, 20).repeat(rows), np.zeros(20 * rows), np.zeros(20 * rows)
    for k in range(len(u) - 1):
        u[k] = 2 * (r[k] - y[k])
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k] + 0.1 * rng.normal()
    return {"y1": y, "y2": r, "u": u}


@pytest.mark.parametrize(
    ("header", "name", "units"),
    [
        ("T[0] [degC]", "T[0]", {"T[0]": "degC"}),
        ("T [degC] raw", "T [degC] raw", {}),
        (("T", "degC"), ("T", "degC"), {}),
    ],
)
def test_a_unit_is_the_last_part_of_a_header_in_brackets(header, name, units):
    rows = pd.DataFrame({header: np.arange(9.0), "q": np.arange(9.0) ** 2})
    log = qm.read_log(rows, outputs=[name], inputs="q")
    assert (log.outputs, log.units) == ((str(name),), units)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "log",
    [slow(5), slow(8, 2.0), set_point(40)],
    ids=["inputs repeat, too", "quantised", "a set-point"],
)
def test_other_repeats_stay(log):
    assert qm.read_log(log).trajectories[0].y.isfinite().all()


def test_a_response_that_is_rare_is_no_error():
    u, y = np.zeros(400), 1e-3 * np.random.default_rng(0).normal(size=401)
    u[100] = 1.0
    y[101:115] += 0.8 ** np.arange(14)
    with warnings.catch_warnings(action="error"):
        qm.read_log({"y": y, "u": u})


@refused(
    (5, {}, "data: got int, expected a CSV file, a DataFrame, a dict of arrays, a list"),
    ([], {}, "data: got an empty list, expected a CSV file"),
    (room().set_index(["T_out", "t"]), {}, "data: got an index of several levels, expected one"),
    ("none.csv", {}, r"data: got none.csv, which cannot be read \(.*No such file"),
    ("http://a.b/c.csv", {}, r"data: got http://a.b/c.csv, which cannot be read"),
    (room(), {"inputs": [None]}, "column: got 'None', which is missing"),
    ({"T": np.ones(9), "q": []}, {}, "q: got 0 rows, expected 9 rows, as others, or 8"),
    (room(), {"outputs": ["p"]}, "column: got 'p', which is missing, expected one of t, T, q,"),
    (room(), {"inputs": ["T"]}, "column: got 'T' twice, expected each once"),
    (room(), {"outputs": None}, "outputs: got none, and columns t, T, q, T_out, expected nam"),
    (room(), {"inputs": None}, r"inputs: got none, .* Pass read_log\(.., inputs=\[..\]\)"),
    (room(), {"time": "clock"}, "column: got 'clock', which is missing"),
    (room(), {"episode": "run"}, "column: got 'run', which is missing"),
    (room().assign(q="on"), {}, "column: got q, without a number"),
    *(
        (
            room().assign(q=[text, *map(str, range(59))]),
            {},
            f"column: got q with '{text}' in row 0, one of 1",
        )
        for text in ("1,234.5", "2,5", "12.3 kW", "-4e", "2020-01-01")
    ),
    *(
        (room().assign(t=t), {"time": "t"}, f"time: got t with '{t}', expected numbers or dates")
        for t in ("noon", "12:xx")
    ),
    *(
        (
            room().assign(t=[*range(full), *[None] * (60 - full)]),
            {"time": "t"},
            f"time: got t, empty in {60 - full} of 60 rows, expected times in two rows or more",
        )
        for full in (0, 1)
    ),
    (
        room().assign(t=["2020-09-01", *["13/09/2020"] * 59]),
        {"time": "t"},
        "time: got t with '2020-09-01', expected numbers or dates of one format",
    ),
    *(
        (
            room().assign(t=np.r_[np.arange(30), 30 + step * np.arange(30)]),
            {"time": "t"},
            f"time: got steps of {step} from row 30 on, and of 1 in the median, expected one",
        )
        for step in (1.45, 1.2, 0.1, 3)
    ),
    (room()[::-1], {"time": "t"}, "time: got steps of -0.25, expected times that increase"),
    (
        [room(), room(30).assign(t=0.5 * np.arange(30))],
        {"time": "t"},
        "time: got steps of 0.5 from row 60 on, and of 0.25 in the median, expected one samp",
    ),
    (room(1), {}, "data: got 1 rows, of which no two have outputs and all inputs between them, ex"),
    ({"T": np.zeros((2, 3, 4))}, {}, r"T: got shape \(2, 3, 4\), expected shape \(T,\) or"),
    ({"T": np.ones(9), "q": np.ones(7)}, {}, "q: got 7 rows, expected 9 rows, as others, or 8"),
    (pd.concat([room(), room()[["T"]]], axis=1), {}, "column: got 'T', which is there twice, expe"),
)
def test_a_mistake_is_named(data, options):
    qm.read_log(data, **{**NAMES, **options})


# Where logs are taken


def test_plain_data_are_identified_and_start_a_qp():
    frame = room()
    plain = frame.rename(columns={"T": "y", "q": "u", "T_out": "d"})
    found = qm.identify(plain, 4)
    assert_close(found.model.A, np.array([[0.9]]))
    assert_close(found.model.E, np.array([[0.1]]))
    mpc = qm.QPMPC.from_data([plain, plain], 4, stage_weight=[1.0, 0.1])
    assert mpc.n_d == 1
    log = qm.read_log(frame, **NAMES)
    assert torch.equal(qm.QPMPC.from_data(log, 4, stage_weight=[1.0, 0.1]).C, qm.QPMPC.of(
        **qm.identify(log, 4).arguments, stage_weight=[1.0, 0.1]).C)  # fmt: skip
    for data in (plain, log, [plain]):
        with pytest.raises(QPError, match=r"^stage_weight: got none, and a log without rewards"):
            qm.QPMPC.from_data(data, 4)
    with pytest.raises(QPError, match=r"^n_d: got 2, but 1 of T_out, expected the log's own. Omit"):
        qm.identify(log, 4, n_d=2)
    with pytest.raises(QPError, match=r"^n_x: got 2, but 1 of T, expected the log's own"):
        qm.identify(log, 4, n_x=2)
