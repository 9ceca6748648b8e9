from __future__ import annotations

import sys
from types import ModuleType

import jaxtyping
import pytest
import torch
from shapes import check_shapes

SOURCE = """
from __future__ import annotations
from jaxtyping import Float
from torch import Tensor

def add(x: Float[Tensor, "vertices 3"], y: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
    return x + y

class Mass:
    def of(self, area: Float[Tensor, " vertices"]) -> Float[Tensor, " vertices"]:
        return area.sum(dim=0, keepdim=True)

def plain(x):
    return x
"""


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    made = ModuleType("shaped_sample")
    monkeypatch.setitem(sys.modules, "shaped_sample", made)
    exec(SOURCE, made.__dict__)
    return made


def test_wraps_what_is_annotated(module: ModuleType) -> None:
    assert check_shapes("shaped_sample") == 2


def test_wrong_argument_is_refused(module: ModuleType) -> None:
    check_shapes("shaped_sample")
    assert module.add(torch.ones(4, 3), torch.ones(4, 3)).shape == (4, 3)
    with pytest.raises(jaxtyping.TypeCheckError):
        module.add(torch.ones(4, 3), torch.ones(1, 3))


def test_wrong_result_of_a_method_is_refused(module: ModuleType) -> None:
    check_shapes("shaped_sample")
    with pytest.raises(jaxtyping.TypeCheckError):
        module.Mass().of(torch.ones(4))
