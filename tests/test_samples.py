"""Sample shots: valid stages, the same bytes every time, and cloth that leaves something to refine."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from shots import run

from physgraph_usd.errors import UsageError
from physgraph_usd.lab.samples import SAMPLES, write_sample

GARMENT = "PhysGraphGarmentAPI"


def prims_with(stage: Usd.Stage, schema: str) -> list[Usd.Prim]:
    return [prim for prim in stage.Traverse() if schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]


HEAVY = ("dancer", "torus", "skirt", "block", "trims")
"""Samples that take seconds to make."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in ("dancer", "trims") else name for name in SAMPLES]
)
def test_stage_is_complete_and_valid(sample: Callable[[str], Path], name: str) -> None:
    validation = pytest.importorskip("pxr.UsdValidation", reason="pxr before 24.11 cannot validate")
    stage = Usd.Stage.Open(str(sample(name)))
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert stage.HasAuthoredMetadata("upAxis")
    assert stage.HasAuthoredMetadata("timeCodesPerSecond")
    assert stage.HasAuthoredTimeCodeRange()
    assert Usd.ModelAPI(stage.GetDefaultPrim()).GetKind() == "component"
    assert prims_with(stage, GARMENT)
    for prim in prims_with(stage, GARMENT):
        assert prim.GetAttribute("physgraph:material:bendStiffness").Get() > 0
    for prim in stage.Traverse():
        mesh = UsdGeom.Mesh(prim)
        if not mesh:
            continue
        indices, counts = mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get()
        points = mesh.GetPointsAttr()
        for code in [Usd.TimeCode.Default(), *points.GetTimeSamples()]:
            place = points.Get(code)
            valid, reason = UsdGeom.Mesh.ValidateTopology(indices, counts, len(place))
            assert valid, reason
            np.testing.assert_allclose(mesh.GetExtentAttr().Get(code), [np.min(place, 0), np.max(place, 0)])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in HEAVY else name for name in SAMPLES]
)
def test_same_bytes_every_time_and_soon(sample: Callable[[str], Path], name: str, tmp_path: Path) -> None:
    start = time.process_time()
    again = write_sample(name, tmp_path / "new" / "folder")
    assert time.process_time() - start < 15.0
    assert again.read_bytes() == sample(name).read_bytes()


def test_samples_are_listed_with_descriptions() -> None:
    done = run("sample", "--list")
    assert done.exit_code == 0
    assert done.stdout.splitlines() == [f"{name}: {words}" for name, words in SAMPLES.items()]


def test_unknown_sample_is_named() -> None:
    with pytest.raises(UsageError, match=r"unknown sample 'scarf'; known samples: sleeve, skirt"):
        write_sample("scarf", Path())
