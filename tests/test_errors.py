import pytest

from torch_qpmpc import QPError, SolverError


def test_message_has_argument_value_expectation_and_remedy():
    error = QPError.expected("w", -1, "non-negative slack weights", "Use inf for a hard row.")
    assert str(error) == "w: got -1, expected non-negative slack weights. Use inf for a hard row."


def test_message_without_a_remedy_ends_with_the_expectation():
    assert str(QPError.expected("c", 2, "a scalar")) == "c: got 2, expected a scalar."


@pytest.mark.parametrize(("error", "builtin"), [(QPError, ValueError), (SolverError, RuntimeError)])
def test_errors_are_caught_as_the_builtin_ones(error, builtin):
    with pytest.raises(builtin, match="why"):
        raise error("why")
