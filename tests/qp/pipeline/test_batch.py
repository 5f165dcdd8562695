import pytest
import torch

from tests.problems import known_qp
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.program import EVENT_SHAPES


@pytest.mark.parametrize("matrices", [(), (4,)])
@pytest.mark.parametrize("batch", [(), (4,)])
def test_invalid_data_is_found_in_every_tensor(batch, matrices):
    known = known_qp(2, batch=batch, matrices=matrices)
    parts = dict(zip(EVENT_SHAPES, known.qp.tensors(), strict=True))
    fixed = known.fixed.expand(4, -1)
    assert Programs.of(*parts.values(), fixed)[0].valid() is None
    spoilt = dict.fromkeys(("H", "q", "c", "C", "b", "G"), (torch.nan, torch.inf))
    spoilt |= {"lb": (torch.nan, torch.inf), "ub": (torch.nan, -torch.inf), "w": (torch.nan, -1.0)}
    for name, values in spoilt.items():
        for value in values:
            bad = parts[name].clone()
            of_one = bad[2] if bad.ndim > len(EVENT_SHAPES[name]) else bad
            of_one.view(-1)[-1] = value
            valid = Programs.of(*(parts | {name: bad}).values(), fixed)[0].valid()
            alone = bad.ndim > len(EVENT_SHAPES[name])
            assert valid.tolist() == [alone, alone, False, alone], (name, value)
    bad = fixed.clone()
    bad[1, 0] = torch.nan
    valid = Programs.of(*parts.values(), bad)[0].valid()
    assert valid.tolist() == [True, False, True, True]


def test_operands_with_equal_rows_are_shared():
    known = known_qp(0)
    batched = [x.expand(4, *x.shape).contiguous() for x in known.qp.tensors()]
    programs, batch = Programs.of(*batched, known.fixed)
    assert batch == (4,)
    assert len(programs) == 4
    assert programs.prepared.shared
    assert programs.prepared is Programs.of(*known.qp.tensors(), known.fixed)[0].prepared
    batched[1] = batched[1] + torch.arange(4.0).double()[:, None]
    programs, _ = Programs.of(*batched, known.fixed)
    assert [len(x) for x in programs.theta] == [1, 1, 1, 4, 1, 1, 1, 1, 1]
    batched[0] = batched[0] * torch.arange(1.0, 5.0).double()[:, None, None]
    programs, _ = Programs.of(*batched, known.fixed)
    assert [len(x) for x in programs.theta[:4]] == [4, 1, 1, 4]
