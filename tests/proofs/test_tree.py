"""Search trees: against the regions, and their C against the tree."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.integrator import integrator
from tests.law_code import actions
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.export.library import compiler
from torch_qpmpc.proofs import Polytope, SearchTree, explicit_law


def built(state_slack: float = 2.0) -> SearchTree:
    mpc = integrator(stage_weight=[1.0, 0.5, 0.1], state_slack=state_slack)
    law = explicit_law(mpc, Polytope.box([-1.2, -0.8], [1.2, 0.8]))
    return SearchTree.of(law)


def samples(tree: SearchTree) -> np.ndarray:
    return np.random.default_rng(0).uniform(tree.law.set.lower, tree.law.set.upper, (5000, 2))


def test_each_leaf_has_the_law_of_its_region():
    tree = built()
    s = samples(tree)
    assert tree.policy(s) == pytest.approx(tree.law.policy(s), abs=1e-9)
    assert tree.depth < len(tree.laws) < len(tree.law.regions)


def test_a_law_without_bounds_is_a_leaf():
    mpc = QPMPC.from_model([[0.9]], [[1.0]], 2, stage_weight=[1.0, 1.0])
    tree = SearchTree.of(explicit_law(mpc, Polytope.box([-1.0], [1.0])))
    assert (len(tree.planes), tree.depth) == (0, 0)
    s = torch.tensor([[0.3], [-0.7]], dtype=torch.float64)
    assert tree.policy(s) == pytest.approx(mpc.policy(s).detach().numpy(), abs=1e-7)


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
@pytest.mark.parametrize(("dtype", "near"), [("float64", 1e-9), ("float32", 1e-3)])
def test_the_c_code_agrees(dtype, near):
    tree = built(np.inf)
    s = np.append(samples(tree), [[np.nan, 0.0], [1.3, 0.0]], axis=0)
    u, codes = actions(tree, s, dtype)
    law = tree.law.policy(s.astype(dtype))[:, 0]
    assert (codes == np.isnan(law)).all()
    assert codes[-2:].all()
    assert abs(u[codes == 0, 0] - law[codes == 0]).max() < near


@pytest.mark.parametrize(
    ("options", "sentence"), [({"name": "static"}, "a keyword of C"), ({"dtype": "int"}, "dtype")]
)
def test_errors(options, sentence, tmp_path):
    with pytest.raises(QPError, match=sentence):
        built().export_c(tmp_path, **options)
