"""Heat maps: what is measured, what is written, and that nothing changes in a layer without them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import tube
from layers import COAT, TIMES, errors, fine_points, make_shot, open_over, refine_all, result_of
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from shots import CLOTH, cloth_shot, faults, refine
from stages import COLLIDER_API

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.colliders.mesh import MeshBody
from physgraph_usd.solver.colliders.pose import Pose
from physgraph_usd.solver.contact.report import penetration_map
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.writer import LayerWriter

NAMES = ("penetration", "crossing")


class TestPenetration:
    @pytest.mark.parametrize(("side", "depth"), [("auto", 0.0), ("back", 0.0), ("front", 20.0)])
    def test_an_open_body_has_a_behind_only_where_its_side_is_fixed(self, side: str, depth: float):
        (surface,) = MeshBody(side=side, device="cpu", threads=1).pose(Pose(*tube(around=256)))
        found = penetration_map([surface], np.array([[0.08, 0.0, 0.0]]))
        assert found[0] == pytest.approx(depth, abs=0.1)


def write(shot_file: Path, out: Path, heat: Mapping[Any, dict[str, Any] | None], **options: object) -> Path:
    """Refine a shot linearly into a layer with given heat maps."""
    shot = open_shot(str(shot_file), level=1)
    steps = refine_all(shot)
    with LayerWriter(shot, steps, out, **options) as writer:  # type: ignore[arg-type]
        for time in shot.scene.times or (None,):
            writer.write(result_of(time, fine_points(shot, steps, time), heat=heat.get(time) or {}))
    return out


def values(composed: Usd.Stage, name: str, time: float | None, *, path: str = COAT) -> np.ndarray | None:
    primvar = UsdGeom.PrimvarsAPI(composed.GetPrimAtPath(path)).GetPrimvar(f"physgraph:{name}")
    value = primvar.Get(Usd.TimeCode.Default() if time is None else time)
    return None if value is None else np.asarray(value)


def samples(out: Path, name: str, path: str = COAT) -> list[float]:
    layer = Sdf.Layer.FindOrOpen(str(out))
    return list(layer.ListTimeSamplesForPath(f"{path}.primvars:physgraph:{name}"))


class TestLayers:
    @pytest.fixture
    def shot(self, tmp_path: Path) -> Path:
        make_shot(tmp_path / "shot.usda")
        return tmp_path / "shot.usda"

    @pytest.mark.parametrize(("mode", "suffix"), [("over", ".usdc"), ("sibling", ".usda")])
    def test_values_come_back_per_sample(self, shot: Path, tmp_path: Path, mode: str, suffix: str):
        rng = np.random.default_rng(0)
        heat = {t: {n: rng.random(63, np.float32) for n in NAMES} for t in TIMES}
        out = write(shot, tmp_path / f"out{suffix}", heat, mode=mode)
        path = COAT if mode == "over" else f"{COAT}_refined"
        stage = open_over(shot, out)
        for time in TIMES:
            for name in NAMES:
                np.testing.assert_array_equal(values(stage, name, time, path=path), heat[time][name])
        primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path)).GetPrimvar("physgraph:penetration")
        assert (primvar.GetInterpolation(), primvar.GetTypeName()) == ("vertex", Sdf.ValueTypeNames.FloatArray)
        assert errors(out, shot) == []

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("penetration", [-1.0] * 63, "has values from -1 to 0"),
            ("penetration", [float("nan")] * 63, "has values from nan"),
            ("crossing", [2.0] * 63, "has values from 0 to 2"),
            ("penetration", [0.0] * 5, "has 5 elements; its interpolation needs 63"),
        ],
    )
    def test_the_validator_sees_broken_maps(
        self, shot: Path, tmp_path: Path, name: str, value: list[float], message: str
    ):
        out = write(shot, tmp_path / "out.usdc", {t: {n: np.zeros(63) for n in NAMES} for t in TIMES})
        layer = Sdf.Layer.FindOrOpen(str(out))
        layer.SetTimeSample(f"{COAT}.primvars:physgraph:{name}", TIMES[1], Vt.FloatArray(value))
        layer.Save()
        found = [problem for problem in validate_layer(out, shot) if name in problem.path]
        assert any(message in problem.message and problem.severity == "error" for problem in found)
        assert TIMES[0] not in {problem.time for problem in found}


def body_shot(path: Path, *, frozen: bool = False) -> Path:
    """The waving sheet with a ball that passes through it."""
    cloth_shot(path, frozen=frozen)
    stage = Usd.Stage.Open(str(path))
    ball_prim = UsdGeom.Sphere.Define(stage, "/World/ball")
    ball_prim.CreateRadiusAttr(1.5)
    operation = ball_prim.AddTranslateOp()
    for time in (1.0, 6.0):
        operation.Set(Gf.Vec3d(2.0, 2.0, time - 3.0), time)
    ball_prim.GetPrim().AddAppliedSchema(COLLIDER_API)
    stage.Save()
    return path


class TestShots:
    @pytest.mark.parametrize("contact", [pytest.param("quadratic", marks=pytest.mark.slow), "off"])
    def test_a_layer_tells_how_deep_the_cloth_is(self, tmp_path: Path, contact: str):
        shot, out = body_shot(tmp_path / "shot.usdc"), tmp_path / "fine.usdc"
        report = refine(shot, out, heat_map=True, contact=contact)
        assert report.options["heat_map"] is True
        assert faults(out, shot) == []
        stage = open_over(shot, out)
        deepest = 0.0
        for time in (1.0, 3.0, 6.0):
            found = values(stage, "penetration", time, path=CLOTH)
            assert found is not None
            points = 0.05 * np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().Get(time))
            away = np.linalg.norm(points - 0.05 * np.array([2.0, 2.0, time - 3.0]), axis=1)
            np.testing.assert_allclose(found, 1e3 * np.maximum(0.075 - away, 0.0), atol=0.1)  # A faceted ball.
            deepest = max(deepest, float(found.max()))
            crossing = values(stage, "crossing", time, path=CLOTH)
            assert crossing is not None
            assert set(np.unique(crossing)) <= {0.0, 1.0}
            assert crossing.any() == (contact == "off" and time == 3.0)
        assert (deepest > 1.0) == (contact == "off")

    def test_a_body_moving_through_cloth_at_rest_shows(self, tmp_path: Path):
        shot, out = body_shot(tmp_path / "shot.usdc", frozen=True), tmp_path / "fine.usdc"
        report = refine(shot, out, heat_map=True, contact="off")
        assert all("reused" in frame["garments"][0]["start"] for frame in report.frames[1:])
        assert samples(out, "penetration", CLOTH) == [1.0, 2.0, 3.0, 4.0, 5.0]  # at 6 it is past, as at 5

    def test_without_it_a_layer_has_no_trace_of_it(self, tmp_path: Path):
        shot, out = body_shot(tmp_path / "shot.usdc"), tmp_path / "fine.usda"
        refine(shot, out)
        text = out.read_text()
        assert "penetration" not in text
        assert "heat" not in text
        assert "heat_map" not in RefineOptions().plain()
