"""`CompiledPolicy`: the same actions and values from compiled C, and its errors."""

import copy
import pickle
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from tests.exported import rates, tied
from tests.refused import refused
from torch_qpmpc import CompiledPolicy, QPError, SolverError
from torch_qpmpc.export import library

needs_compiler = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")


@needs_compiler
def test_actions_and_values_are_those_of_the_module():
    mpc = tied()
    policy = CompiledPolicy(mpc)
    s = torch.linspace(-1, 1, 12).reshape(2, 3, 2)
    assert policy(s).shape == (2, 3, 1)
    assert policy(s).dtype is torch.float32
    torch.testing.assert_close(policy(s), mpc.policy(s).detach())
    torch.testing.assert_close(policy.value(s.double()), mpc.value(s.double()).detach())
    torch.testing.assert_close(policy(s[0, 0]), mpc.policy(s[0, 0]).detach())
    assert policy.last.gap.max() < 1e-8


@needs_compiler
def test_each_row_of_a_batch_is_a_controller():
    policy = CompiledPolicy(tied())
    s = torch.tensor([[1.9, -0.5], [0.1, 0.0]])
    policy(s)
    first = policy.last.iterations.copy()
    assert first[0] > 3
    policy(s)
    assert policy.last.iterations.max() == 0
    policy.reset()
    policy(s)
    np.testing.assert_array_equal(policy.last.iterations, first)


@needs_compiler
def test_float32_and_a_limit():
    mpc = tied()
    s = torch.tensor([[1.9, -0.5]])
    single = CompiledPolicy(mpc, dtype="float32")
    torch.testing.assert_close(single(s), mpc.policy(s).detach(), atol=1e-4, rtol=0)
    with pytest.raises(SolverError, match=r"1 of 1 steps .* 1 not certified within"):
        CompiledPolicy(mpc, max_iterations=1)(s)


@needs_compiler
def test_unsolved_steps_raise_or_return_an_action_within_bounds():
    p = torch.tensor([[0.0, 0.0, -3.0], [torch.nan] * 3, [0.0] * 3])
    match = "2 of 3 steps have no certified solution: 1 infeasible, 1 invalid p"
    with pytest.raises(SolverError, match=match):
        CompiledPolicy(rates())(p)
    mpc = rates()
    mpc.on_failure = "mask"
    policy = CompiledPolicy(mpc)
    assert (policy(p).abs() <= 1).all()
    assert policy.last.codes.tolist() == [2, 3, 0]
    torch.testing.assert_close(value := policy.value(p), mpc.value(p).detach())
    assert value.isinf().tolist() == [True, True, False]


@needs_compiler
def test_bad_arguments_are_refused():
    with pytest.raises(QPError, match="mpc: got int, expected a QPMPC"):
        CompiledPolicy(3)  # pyright: ignore[reportArgumentType] - wrong on purpose
    with pytest.raises(QPError, match=r"s: got shape \(3,\), expected shape \(\*batch, 2\)"):
        CompiledPolicy(tied())(torch.ones(3))


@needs_compiler
@pytest.mark.parametrize("again", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_is_a_controller_of_its_own(again):
    policy, s = CompiledPolicy(tied()), torch.tensor([[1.9, -0.5]])
    u = policy(s)
    other = again(policy)
    policy.reset()
    assert torch.equal(other(s), u)
    assert other.last.iterations.max() == 0
    policy(s)
    assert policy.last.iterations.max() > 0
    assert str(other.export) == str(policy.export)


@needs_compiler
def test_states_of_half_precision_are_states():
    s = torch.tensor([[0.5, 0.25]], dtype=torch.bfloat16)
    u = CompiledPolicy(tied())(s)
    assert u.dtype is torch.bfloat16
    torch.testing.assert_close(u, tied().policy(s.double()).detach().bfloat16())
    with pytest.raises(QPError, match=r"H: got torch.bfloat16, expected torch.float32"):
        CompiledPolicy(tied().bfloat16())


@needs_compiler
def test_the_self_test_runs_in_threads_at_once():
    library = CompiledPolicy(tied())._library

    def run(_: int) -> set[int]:
        return {library.selftest() for _ in range(400)}

    with ThreadPoolExecutor(4) as pool:
        assert set().union(*pool.map(run, range(4))) == {0}


@needs_compiler
@pytest.mark.parametrize("command", ["gcc -O0", "g++", "clang++", "ccache gcc", "env gcc"])
def test_the_compiler_may_have_arguments_and_be_one_of_cpp(command, monkeypatch):
    if missing := [word for word in command.split() if word[0] != "-" and not shutil.which(word)]:
        pytest.skip(f"no {missing[0]}")
    monkeypatch.setenv("CC", command)
    s = torch.tensor([0.5, 0.2])
    torch.testing.assert_close(CompiledPolicy(tied())(s), tied().policy(s).detach())


@refused(
    ("no-such-compiler -O2", "compiler: got none on the PATH.* 'no-such-compiler' does not exist"),
    ("gcc '", r"\$CC: got \"gcc '\": No closing quotation, expected a command. Correct or unset"),
)
def test_a_wrong_command_is_named(command, monkeypatch):
    monkeypatch.setenv("CC", command)
    CompiledPolicy(tied())


def test_a_compiler_that_does_not_run_is_named(tmp_path, monkeypatch):
    program = tmp_path / "compiler"
    program.write_bytes(b"\0")
    program.chmod(0o755)
    monkeypatch.setenv("CC", str(program))
    with pytest.raises(QPError, match=r"compiler: got .*, expected a command that runs"):
        CompiledPolicy(tied())


@needs_compiler
def test_a_folder_without_programs_is_named(monkeypatch):
    def refuse(path):
        raise OSError(f"{path}: failed to map segment from shared object")

    monkeypatch.setattr(library.ctypes, "CDLL", refuse)
    match = "TMPDIR: got .* failed to map .*, expected a folder of programs. Set TMPDIR .* noexec"
    with pytest.raises(QPError, match=match):
        CompiledPolicy(tied(5))  # which no other test has compiled


def test_the_compiler_is_the_first_of_cc_gcc_clang_and_ziglang(monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(library.shutil, "which", lambda name: f"/bin/{name}" * (name == "clang"))
    assert library.compiler() == ["/bin/clang"]
    monkeypatch.setattr(library.shutil, "which", lambda _: None)
    monkeypatch.setattr(library.importlib.util, "find_spec", lambda _: None)
    assert library.compiler() is None
    monkeypatch.setattr(library.importlib.util, "find_spec", lambda _: object())
    assert library.compiler() == [sys.executable, "-m", "ziglang", "cc"]
    monkeypatch.setattr(library.shutil, "which", lambda name: name)
    monkeypatch.setenv("CC", "gcc -m32")
    assert library.compiler() == ["gcc", "-m32"]


@pytest.mark.parametrize(
    ("command", "said"),
    [("  ", "none on the PATH, expected"), ("'/my cc' -m32", "'/my cc' does not")],
)
def test_cc_may_be_blank_or_quoted(monkeypatch, command, said):
    monkeypatch.setattr(library.shutil, "which", lambda _: None)
    monkeypatch.setattr(library.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setenv("CC", command)
    with pytest.raises(QPError, match=said):
        library.required_compiler()


@needs_compiler
def test_an_error_of_the_compiler_is_named():
    with pytest.raises(QPError, match=r"(?s)compiler: got an error of .*expected a compiled"):
        library.Library({"policy.c": "int x = ;\n", "policy.h": ""}, "policy", "float64")
