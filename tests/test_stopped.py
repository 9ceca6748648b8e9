"""What a stopped run left is looked at: drawn, and written as a partial layer; and the picture of a first frame."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from shots import CLOTH, cloth_shot, faults, fine, interrupted, only, refine, run, sample_times

pytest.importorskip("PIL", reason="previews are written with Pillow")

from PIL import Image, ImageSequence
from pxr import Usd, UsdGeom

from physgraph_usd.errors import UsageError
from physgraph_usd.shot import refine as refining
from physgraph_usd.shot.frames import Finished, frames_folder
from physgraph_usd.shot.stitch import stitch
from physgraph_usd.shot.stopped import preview_any

SMALL = ("--size", "160x80")


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A shot of six frames, and the layer that a run of it would have written, which stopped after three."""
    folder = tmp_path_factory.mktemp("stopped")
    shot, out = cloth_shot(folder / "shot.usdc"), folder / "fine.usdc"
    interrupted(shot, out, after=3)
    return shot, out


@pytest.fixture(scope="module")
def whole(stopped: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layer of the same run, not stopped."""
    out = tmp_path_factory.mktemp("whole") / "fine.usdc"
    refine(stopped[0], out)
    return out


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


class TestPicture:
    def test_of_the_folder_and_of_the_layer_is_that_of_the_frame_in_a_layer(
        self, stopped: tuple[Path, Path], tmp_path: Path
    ):
        _, out = stopped
        stitch([out], tmp_path / "part.usdc", partial=True, frames=(2.0, 2.0))
        for number, place in enumerate((out, frames_folder(out), tmp_path / "part.usdc")):
            done = run("preview", place, "-o", tmp_path / f"{number}.png", "--time", 2, *SMALL)
            assert (done.exit_code, done.stdout.strip()) == (0, str(tmp_path / f"{number}.png")), done.output
        first, second, expected = (picture(tmp_path / f"{number}.png") for number in range(3))
        assert np.array_equal(first, expected)
        assert np.array_equal(second, expected)

    def test_shows_the_last_finished_frame_or_all_of_them(self, stopped: tuple[Path, Path], tmp_path: Path):
        last = preview_any(stopped[1], tmp_path / "last.png", size=(160, 80))
        third = preview_any(stopped[1], tmp_path / "third.png", times=[3.0], size=(160, 80))
        assert np.array_equal(picture(last), picture(third))
        with Image.open(preview_any(stopped[1], tmp_path / "loop.gif", size=(160, 80))) as loop:
            assert len(list(ImageSequence.Iterator(loop))) == 3

    def test_refusals_name_what_there_is(self, stopped: tuple[Path, Path], tmp_path: Path):
        with pytest.raises(UsageError, match=r"^5: not finished in .*; finished: 1, 2, 3$"):
            preview_any(stopped[1], tmp_path / "a.png", times=[5.0])
        (tmp_path / "there.png").write_bytes(b"")
        with pytest.raises(UsageError, match="exists"):
            preview_any(stopped[1], tmp_path / "there.png")
        assert run("preview", tmp_path / "none.usdc", "-o", tmp_path / "b.png").exit_code == 2
        assert run("preview", tmp_path, "-o", tmp_path / "b.png").exit_code == 2
        assert only(tmp_path, "there.png")

    def test_refuses_frames_of_a_shot_that_changed(self, stopped: tuple[Path, Path], tmp_path: Path):
        shot, out = shutil.copy(stopped[0], tmp_path / "shot.usdc"), tmp_path / "fine.usdc"
        shutil.copytree(frames_folder(stopped[1]), frames_folder(out))
        cloth_shot(Path(shot), times=(1.0, 2.0))
        with pytest.raises(UsageError, match="the shot has changed"):
            preview_any(out, tmp_path / "a.png")


class TestPartialLayer:
    def test_holds_the_finished_frames_and_names_the_others(
        self, stopped: tuple[Path, Path], whole: Path, tmp_path: Path
    ):
        shot, out = stopped
        part = tmp_path / "part.usdc"
        report, _ = stitch([out], part, partial=True)
        assert sample_times(part) == (1.0, 2.0, 3.0)
        assert faults(part, shot) == []
        for time in (1.0, 2.0, 3.0):
            assert np.array_equal(fine(shot, part, time), fine(shot, whole, time))
        assert [each for each in report.warnings if "the layer has 3 of 6 frames; not finished: 4:6" in each]
        assert (report.exit_code, out.exists(), frames_folder(out).is_dir()) == (0, False, True)

    def test_of_a_chunk_with_a_hole_starts_anew_behind_it(self, tmp_path: Path):
        """The cloth stops at time code 3, which is missing: the frame after it is no copy of the frame before it."""
        shot, chunk, part = cloth_shot(tmp_path / "s.usdc"), tmp_path / "chunk", tmp_path / "part.usdc"
        stage = Usd.Stage.Open(str(shot))
        points = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr()
        for time in (4.0, 5.0, 6.0):
            points.Set(points.Get(3.0), time)
        stage.Save()
        refine(shot, chunk, frames=(1.0, 6.0), preroll=0)
        result = Finished(chunk).read(3, 4.0)
        assert result is not None
        (solved,) = result.garments
        assert solved.points is not None
        assert solved.reused
        (chunk / "2.npz").unlink()
        done = run("stitch", chunk, "-o", tmp_path / "all.usdc")
        assert done.exit_code == 2
        assert "frames 3:3 are in no chunk" in done.stderr
        assert "leave them out by --partial" in done.stderr
        assert run("stitch", chunk, "-o", part, "--partial").exit_code == 0
        assert sample_times(part)[:3] == (1.0, 2.0, 4.0)
        assert np.allclose(fine(shot, part, 4.0), solved.points, rtol=0, atol=1e-7)
        assert faults(part, shot) == []

    def test_frames_choose_among_the_finished_ones(self, stopped: tuple[Path, Path], tmp_path: Path):
        stitch([stopped[1]], tmp_path / "part.usdc", partial=True, frames=(2.0, 5.0))
        assert sample_times(tmp_path / "part.usdc") == (2.0, 3.0)

    def test_refuses_the_layers_own_name_and_no_frame(self, stopped: tuple[Path, Path], tmp_path: Path):
        with pytest.raises(UsageError, match="name another for a part of its frames"):
            stitch([stopped[1]], stopped[1], partial=True)
        with pytest.raises(UsageError, match=r"frames 5:6 are in no chunk; those there: .*1:3"):
            stitch([stopped[1]], tmp_path / "part.usdc", partial=True, frames=(5.0, 6.0))
        with pytest.raises(UsageError, match="--partial takes the finished frames of a stopped run"):
            stitch([frames_folder(stopped[1])], tmp_path / "part.usdc")

    def test_of_frames_that_were_a_part_of_the_shot(self, tmp_path: Path):
        shot, out = cloth_shot(tmp_path / "s.usdc"), tmp_path / "fine.usdc"
        interrupted(shot, out, after=2, frames=(3.0, 6.0))
        stitch([out], tmp_path / "part.usdc", partial=True)
        assert sample_times(tmp_path / "part.usdc") == (3.0, 4.0)
        assert faults(tmp_path / "part.usdc", shot) == []


class TestFirstFrame:
    def test_is_drawn_while_the_run_goes_on(self, tmp_path: Path):
        shot, drawn = cloth_shot(tmp_path / "s.usdc"), tmp_path / "first.png"
        interrupted(shot, tmp_path / "fine.usdc", after=1, preview=drawn)
        assert picture(drawn).shape == (640, 1280, 3)
        before = drawn.read_bytes()
        report = refine(shot, tmp_path / "fine.usdc", resume=True, preview=drawn)
        assert (report.exit_code, drawn.read_bytes() == before) == (0, True)

    def test_never_replaces_a_file_unasked(self, tmp_path: Path):
        shot, drawn, out = (
            cloth_shot(tmp_path / "s.usdc", times=(1.0, 2.0)),
            tmp_path / "first.png",
            tmp_path / "f.usdc",
        )
        drawn.write_bytes(b"mine")
        done = run("refine", shot, "-o", out, "--preview", drawn)
        assert (done.exit_code, drawn.read_bytes(), out.exists()) == (2, b"mine", False)
        assert f"{drawn} exists" in done.stderr
        assert run("refine", shot, "-o", out, "--level", 1, "--preview", drawn, "--overwrite").exit_code == 0
        assert picture(drawn).shape == (640, 1280, 3)

    def test_is_a_png(self, tmp_path: Path):
        done = run(
            "refine", cloth_shot(tmp_path / "s.usdc"), "-o", tmp_path / "f.usdc", "--preview", tmp_path / "a.jpg"
        )
        assert (done.exit_code, "'.jpg'" in done.stderr) == (2, True), done.stderr

    def test_that_cannot_be_drawn_costs_no_frame(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        shot, drawn = cloth_shot(tmp_path / "s.usdc", times=(1.0, 2.0)), tmp_path / "first.png"
        monkeypatch.setattr(refining, "picture_of", lambda options: drawn / "no" / "folder.png")
        drawn.write_bytes(b"")
        report = refine(shot, tmp_path / "fine.usdc")
        assert sample_times(tmp_path / "fine.usdc", CLOTH) == (1.0, 2.0)
        assert [each for each in report.warnings if each.startswith("the first frame is not drawn into ")]
