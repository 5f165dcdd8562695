"""The file of rows of other packages' plants: each once, and what learning adds to it."""

import math

import pandas as pd

from tests.benchmarks import outside


def test_learning_is_added_to_the_row_of_its_plant_and_seed(tmp_path):
    file = tmp_path / "rows.csv"
    assert outside.finished(file, "Reacher", 1) is None
    row = dict.fromkeys(outside.FIELDS, 0.0) | {"plant": "Reacher", "chosen": "MPC of the estimate"}
    for seed, start in ((1, 4.0), (2, 6.0)):
        outside.add(file, row | {"seed": seed, "start": start, "learned": math.nan})
    first = outside.finished(file, "Reacher", 1)
    assert first is not None
    assert math.isnan(first["learned"])
    assert len(outside.learning(pd.read_csv(file)).splitlines()) == 2  # the head alone
    outside.add(file, first | {"learned": 3.0, "simulated": 500})
    rows = pd.read_csv(file)
    assert rows["start"].tolist() == [4.0, 6.0]
    assert rows["learned"].tolist()[:1] == [3.0]
    assert rows["chosen"].tolist() == 2 * ["MPC of the estimate"]
    # The start beside it is that of the same seed, not the mean of both.
    assert outside.learning(rows).splitlines()[-1] == "| Reacher | 4.000 | 3.000 | 1 of 1 | 500 |"
