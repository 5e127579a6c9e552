"""Shapes of records' tensors against their annotations."""

import dataclasses

import pytest
import torch
from jaxtyping import Float
from primdiffusion.geometry.records import TensorRecord, check_shapes
from support.errors import refused
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Rows(TensorRecord):
    rows: Float[Tensor, "n 3"]
    weight: Float[Tensor, "n"]
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Pairs(TensorRecord):
    pairs: Float[Tensor, "n n"]


def test_a_name_is_one_size_in_all_records():
    check_shapes(Rows(torch.zeros(4, 3), torch.zeros(4)), Pairs(torch.zeros(4, 4)))
    check_shapes(Rows(torch.zeros(0, 3), torch.zeros(0)))


@pytest.mark.parametrize(
    ("records", "name"),
    [
        ([Rows(torch.zeros(4, 2), torch.zeros(4))], "rows"),
        ([Rows(torch.zeros(4, 3), torch.zeros(1))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(()))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(4, dtype=torch.int64))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(4)), Pairs(torch.zeros(5, 5))], "pairs"),
        ([Pairs(torch.zeros(4, 5))], "pairs"),
    ],
)
def test_other_shapes_and_types_are_named(records, name):
    with refused(ValueError, name):
        check_shapes(*records)
