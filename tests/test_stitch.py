"""Chunks of a shot, refined apart and stitched: the same cloth as in one run, and nothing missing, doubled or mixed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from cloth import rms
from layers import open_over
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, EDGE, cloth_shot, faults, fine, interrupted, refine, run, sample_times
from stages import add_sheet, new_stage, save, vec3

from physgraph_usd.cli.printing import seam_lines
from physgraph_usd.errors import LayerError, PhysGraphError, UsageError
from physgraph_usd.shot.frames import Finished, kept_for
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.stitch import SEAM_BOUND, Seam, check_seams, stitch
from physgraph_usd.usd.check.validate import validate_layer
from physgraph_usd.usd.provenance import read_record
from physgraph_usd.usd.stage import paths_in

TIMES = tuple(float(time) for time in range(1, 25))
SPANS = ((1.0, 8.0), (9.0, 16.0), (17.0, 24.0))
ALONE: dict[str, Any] = {"temporal": "off"}
"""Options with which frames do not depend on one another."""


def refine_chunks(
    shot: Path, folder: Path, spans: Sequence[tuple[float, float]] = SPANS, *, preroll: int = 6, **options: Any
) -> list[Path]:
    """Refine parts of a shot, each by itself."""
    chunks = [folder / f"chunk{first:g}" for first, _ in spans]
    for span, chunk in zip(spans, chunks, strict=True):
        assert refine(shot, chunk, frames=span, preroll=preroll, **options).exit_code == 0
    return chunks


def record_of(file: Path) -> dict[str, Any]:
    return read_record(Sdf.Layer.FindOrOpen(str(file))) or {}


def points(layer: Path, time: float) -> np.ndarray:
    return np.asarray(Sdf.Layer.FindOrOpen(str(layer)).QueryTimeSample(f"{CLOTH}.points", time))


def solved(chunk: Path, time: float) -> np.ndarray:
    """World positions [m] of the sheet in a chunk."""
    result = Finished(chunk).read(TIMES.index(time), time)
    assert result is not None
    assert result.garments[0].points is not None
    return result.garments[0].points


def points_in(stage: Usd.Stage, path: str, time: float) -> Any:
    return UsdGeom.Mesh(stage.GetPrimAtPath(path)).GetPointsAttr().Get(time)


class Runs(NamedTuple):
    """24 frames of a sheet: as one run, and as three chunks that were stitched."""

    shot: Path
    one: Path
    chunks: list[Path]
    joined: Path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("stitch")
    shot = cloth_shot(folder / "shot.usdc", times=TIMES)
    refine(shot, folder / "one.usdc")
    (folder / "parts").mkdir()
    chunks = refine_chunks(shot, folder / "parts")
    stitch(chunks[::-1], folder / "joined.usdc")
    return Runs(shot, folder / "one.usdc", chunks, folder / "joined.usdc")


class TestOneLayer:
    def test_h34_seams_move_less_than_a_twentieth_of_a_fine_edge(self, runs: Runs):
        apart = [rms(fine(runs.shot, runs.one, t) - fine(runs.shot, runs.joined, t)) / (EDGE / 2) for t in TIMES]
        assert max(apart[:2]) == 0.0
        assert 0.0 < max(apart) < SEAM_BOUND, apart

    def test_holds_the_chunks_positions(self, runs: Runs):
        assert sample_times(runs.joined) == TIMES
        for span, chunk in zip(SPANS, runs.chunks, strict=True):
            own = [time for time in TIMES if span[0] <= time <= span[1]]
            for time in own:
                held = solved(chunk, time)
                same = np.allclose(held, fine(runs.shot, runs.joined, time), rtol=0, atol=1e-7)
                assert same == (time + 6 <= span[1] or time > 16), time

    def test_is_valid_and_records_what_it_was_made_from(self, runs: Runs):
        assert validate_layer(runs.joined) == []
        record, one = record_of(runs.joined), record_of(runs.one)
        assert list(record.pop("chunks")) == ["1:8", "9:16", "17:24"]
        assert record["options"].pop("preroll") == 6
        assert record == one

    def test_the_command_says_how_far_seams_move_and_reports_all_frames(self, runs: Runs, tmp_path: Path):
        report = tmp_path / "report.json"
        done = run("stitch", *runs.chunks, "-o", tmp_path / "joined.usdc", "--report", report)
        assert done.exit_code == 0, done.stderr
        assert [frame["time"] for frame in json.loads(report.read_text())["frames"]] == list(TIMES)
        assert done.stdout.strip() == str(tmp_path / "joined.usdc")
        assert [line.partition(":")[0] for line in done.stderr.splitlines()] == ["seam at 9", "seam at 17"]
        assert all("bound" in line and f"{SEAM_BOUND:g} RMS" in line for line in done.stderr.splitlines())
        assert faults(tmp_path / "joined.usdc", runs.shot) == []

    @pytest.mark.parametrize("time", [12.0, 16.0])
    def test_a_damaged_frame_is_refused_by_name_and_no_chunk_is_touched(self, runs: Runs, tmp_path: Path, time: float):
        """In the middle of a chunk, and where two are joined."""
        copies = copied(runs, tmp_path / "c")
        file = copies[1] / f"{TIMES.index(time)}.npz"
        broken = dict(np.load(file))
        broken["points0"][7, 1] = np.nan
        np.savez(file, **broken)
        there = sorted(tmp_path.rglob("*"))
        with pytest.raises(LayerError, match=rf"{file} is damaged .*remove it and --resume"):
            stitch(copies, tmp_path / "joined.usdc", shot=runs.shot)
        assert sorted(tmp_path.rglob("*")) == there

    def test_chunks_that_were_moved_are_told_where_the_shot_is(self, runs: Runs, tmp_path: Path):
        copies = copied(runs, tmp_path / "a" / "b" / "c")
        with pytest.raises(PhysGraphError, match=r"shot\.usdc"):
            stitch(copies, tmp_path / "joined.usdc")
        done = run("stitch", copies[0].parent, "-o", tmp_path / "joined.usdc", "--shot", runs.shot)
        assert done.exit_code == 0, done.stderr
        assert faults(tmp_path / "joined.usdc", runs.shot) == []
        assert all(np.array_equal(points(tmp_path / "joined.usdc", t), points(runs.joined, t)) for t in TIMES)


def copied(runs: Runs, folder: Path) -> list[Path]:
    """The chunks, copied into a folder."""
    return [Path(shutil.copytree(chunk, folder / chunk.name)) for chunk in runs.chunks]


def test_the_old_name_of_the_option_works_and_no_help_shows_it(tmp_path: Path):
    shot, out = cloth_shot(tmp_path / "shot.usdc"), tmp_path / "chunk"
    line = ["refine", shot, "-o", out, "--frames", "3:4", "--run-up=1", "--steps", "1", "--level", "0"]
    assert run(*line).exit_code == 0
    assert {file.name for file in out.iterdir()} == {"run.json", "1.before2.npz", "2.npz", "3.npz"}
    shown = run("refine", "--help").output
    assert "--preroll" in shown
    assert "run-up" not in shown


class TestRefused:
    @pytest.mark.parametrize(
        ("order", "message"), [((0, 2), "frames 9:16 are in no chunk"), ((1,), "frames 1:8, 17:24 are in no chunk")]
    )
    def test_a_missing_chunk_by_its_frames(self, runs: Runs, tmp_path: Path, order: tuple[int, ...], message: str):
        with pytest.raises(UsageError, match=message) as caught:
            stitch([runs.chunks[k] for k in order], tmp_path / "joined.usdc")
        assert all(str(runs.chunks[k]) in str(caught.value) for k in order)
        assert not list(tmp_path.iterdir())

    def test_a_doubled_frame_with_both_files(self, runs: Runs, tmp_path: Path):
        (twice,) = refine_chunks(runs.shot, tmp_path, [(8.0, 10.0)])
        with pytest.raises(UsageError, match="frames 8:10 are in more than one chunk") as caught:
            stitch([*runs.chunks, twice], tmp_path / "joined.usdc")
        assert all(str(file) in str(caught.value) for file in (twice, *runs.chunks[:2]))

    def test_other_options(self, runs: Runs, tmp_path: Path):
        (other,) = refine_chunks(runs.shot, tmp_path, SPANS[2:], steps=5)
        with pytest.raises(UsageError, match=r"were made with other --steps; refine one anew"):
            stitch([*runs.chunks[:2], other], tmp_path / "joined.usdc")

    def test_another_checkout(self, runs: Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr("physgraph_usd.shot.job.code_digest", lambda: "other")
        (other,) = refine_chunks(runs.shot, tmp_path, SPANS[2:])
        with pytest.raises(UsageError, match=r"were made with other code; refine one anew"):
            stitch([*runs.chunks[:2], other], tmp_path / "joined.usdc")

    def test_what_is_no_chunk(self, runs: Runs, tmp_path: Path):
        for place in (runs.one, tmp_path):
            with pytest.raises(
                UsageError, match=r"is no chunk of a shot, nor a folder of chunks; refine with --preroll"
            ):
                stitch([place], tmp_path / "joined.usdc")
        with pytest.raises(UsageError, match="is a layer's name, and a chunk is a folder"):
            refine_shot(runs.shot, tmp_path / "chunk.usdc", RefineOptions(preroll=2))

    def test_to_write_over_a_file_or_finished_frames_unasked(self, runs: Runs):
        before = runs.joined.read_bytes()
        with pytest.raises(UsageError, match="exists"):
            stitch(runs.chunks, runs.joined)
        assert runs.joined.read_bytes() == before
        there = sorted(runs.chunks[0].iterdir())
        with pytest.raises(UsageError, match="holds 8 finished frames; go on by --resume, or drop them by --overwrite"):
            refine_chunks(runs.shot, runs.chunks[0].parent, SPANS[:1])
        assert sorted(runs.chunks[0].iterdir()) == there
        with pytest.raises(UsageError, match="with other steps; refine as then"):
            refine_chunks(runs.shot, runs.chunks[0].parent, SPANS[:1], steps=5, resume=True)
        assert sorted(runs.chunks[0].iterdir()) == there

    def test_a_seam_that_moves_too_far(self, runs: Runs, tmp_path: Path):
        with pytest.raises(LayerError, match=rf"seam at \d+: <{CLOTH}> moves .* fine edges RMS.*--seam-bound"):
            stitch(runs.chunks, tmp_path / "joined.usdc", seam_bound=1e-4)
        assert not list(tmp_path.iterdir())

    def test_a_seam_of_which_nothing_is_known(self, tmp_path: Path):
        shot = cloth_shot(tmp_path / "shot.usdc")
        chunks = refine_chunks(shot, tmp_path, [(1.0, 3.0), (4.0, 6.0)], preroll=0)
        with pytest.raises(LayerError, match="nothing tells how far the seam at 4 moves"):
            stitch(chunks, tmp_path / "joined.usdc")
        assert stitch(chunks, tmp_path / "joined.usdc", seam_bound=float("inf"))[1] == []
        assert faults(tmp_path / "joined.usdc", shot) == []


def test_frames_that_failed_are_named_and_leave_their_seam_unknown(tmp_path: Path):
    shot = cloth_shot(tmp_path / "shot.usdc", broken={3.0: float("nan")})
    chunks = [tmp_path / "c1", tmp_path / "c2"]
    spans = ((1.0, 3.0), (4.0, 6.0))
    done = [refine(shot, chunk, frames=span, preroll=2) for chunk, span in zip(chunks, spans, strict=True)]
    assert [report.exit_code for report in done] == [3, 0]
    with pytest.raises(LayerError, match="nothing tells how far the seam at 4 moves"):
        stitch(chunks, tmp_path / "joined.usdc")
    assert not (tmp_path / "joined.usdc").exists()
    report, _ = stitch(chunks, tmp_path / "joined.usdc", seam_bound=float("inf"))
    assert (report.exit_code, list(report.failed)) == (3, ["3"])
    assert sample_times(tmp_path / "joined.usdc") == (1.0, 2.0, 4.0, 5.0, 6.0)
    assert list(record_of(tmp_path / "joined.usdc")["failed"]) == ["3"]


def test_part_of_a_shot_is_stitched_where_it_is_asked_for(runs: Runs, tmp_path: Path):
    with pytest.raises(UsageError, match=r"chunk17 holds the frames 17:24, of which some lie outside --frames"):
        stitch(runs.chunks, tmp_path / "joined.usdc", frames=(1.0, 16.0))
    stitch(runs.chunks[:2], tmp_path / "joined.usdc", frames=(1.0, 16.0))
    (warning,) = validate_layer(tmp_path / "joined.usdc")
    assert "8 of the shot's 24 frames" in warning.message
    assert sample_times(tmp_path / "joined.usdc") == TIMES[:16]


def test_an_interrupted_chunk_is_named_as_missing_and_goes_on(tmp_path: Path):
    """What it had finished is kept, its pre-roll too."""
    shot = cloth_shot(tmp_path / "shot.usdc")
    (first,) = refine_chunks(shot, tmp_path, [(1.0, 3.0)], preroll=2)
    out, options = tmp_path / "second", {"frames": (4.0, 6.0), "preroll": 2}
    interrupted(shot, out, after=2, **options)
    kept = {file.name: file.read_bytes() for file in out.iterdir() if file.suffix == ".npz"}
    assert {"1.before3.npz", "2.before3.npz", "3.npz", "4.npz"} <= kept.keys()
    with pytest.raises(UsageError, match=r"frames 6:6 are in no chunk; .*second .4:5.*go on by --resume"):
        stitch([first, out], tmp_path / "joined.usdc")
    assert "2 of 3 frames are kept in" in str(kept_for(out))
    refine(shot, out, resume=True, **options)
    assert kept_for(out) is None
    assert all((out / name).read_bytes() == data for name, data in kept.items())
    stitch([first, out], tmp_path / "joined.usdc", seam_bound=1.0)
    assert faults(tmp_path / "joined.usdc", shot) == []


@pytest.fixture
def odd_shot(tmp_path: Path) -> Path:
    """Sheets far apart, under a box of a model: one moves and jumps, one halts, one has few samples, one none.

    The first two are not there for a frame each.
    """
    stage = new_stage(tmp_path / "odd.usdc", metres=EDGE)
    world = stage.GetPrimAtPath("/World")
    hint = world.CreateAttribute("extentsHint", Sdf.ValueTypeNames.Float3Array)
    hint.Set(vec3(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.1]])))
    times = tuple(map(float, range(1, 9)))
    sampled = {"moves": times, "halts": times, "seldom": (1.0, 4.0), "never": ()}
    for number, (name, own) in enumerate(sampled.items()):
        sheet = add_sheet(stage, f"/World/{name}", times=own)
        UsdGeom.XformCommonAPI(sheet).SetTranslate((20.0 * number, 0.0, 0.0))
    still = UsdGeom.Mesh(stage.GetPrimAtPath("/World/halts")).GetPointsAttr()
    for time in times[1:-1]:
        still.Set(still.Get(2.0), time)
    moves = UsdGeom.Mesh(stage.GetPrimAtPath("/World/moves")).GetPointsAttr()
    for time in times[6:]:
        moves.Set(vec3(np.asarray(moves.Get(time)) + np.array([0.0, 100.0, 0.0])), time)
    for attribute, time in ((moves, 4.0), (still, 5.0)):
        stage.GetRootLayer().SetTimeSample(attribute.GetPath(), time, Sdf.ValueBlock())
    return Path(save(stage))


ODD_SPANS = [(1.0, 3.0), (4.0, 7.0), (8.0, 8.0)]


def authored(file: Path) -> dict[str, object]:
    """Default and samples of each attribute, by its path."""
    layer = Sdf.Layer.FindOrOpen(str(file))
    return {
        str(path): (
            attribute.default,
            [(time, layer.QueryTimeSample(path, time)) for time in layer.ListTimeSamplesForPath(path)],
        )
        for path in paths_in(layer)
        if path.IsPropertyPath() and (attribute := layer.GetAttributeAtPath(path))
    }


@pytest.mark.parametrize("velocities", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_attribute_is_that_of_one_run_where_frames_stand_alone(
    odd_shot: Path, tmp_path: Path, *, velocities: bool
):
    """Defaults, runs of equal frames, velocities at seams, boxes, heat maps; of garments in some chunks only, too."""
    options = ALONE | {"velocities": velocities, "heat_map": True}
    refine(odd_shot, tmp_path / "one.usdc", **options)
    _, seams = stitch(refine_chunks(odd_shot, tmp_path, ODD_SPANS, **options), tmp_path / "joined.usdc")
    assert seams == []
    assert faults(tmp_path / "joined.usdc", odd_shot) == []
    one, joined = (authored(tmp_path / name) for name in ("one.usdc", "joined.usdc"))
    assert len(one) > 40
    assert joined == one
    garments = [sorted(record_of(tmp_path / name)["garments"]) for name in ("one.usdc", "joined.usdc")]
    assert garments[0] == garments[1]


def test_a_root_shows_one_layer_over_the_shot_too_and_replaces_no_file(runs: Runs, tmp_path: Path):
    (tmp_path / "root.usda").write_text("mine")
    out: dict[str, Any] = {"out": tmp_path / "joined.usdc", "root": tmp_path / "root.usda"}
    with pytest.raises(UsageError, match=r"root\.usda exists"):
        stitch(runs.chunks, **out)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("root.usda", "mine")]
    stitch(runs.chunks, **out, overwrite=True)
    shown, asked = Usd.Stage.Open(str(tmp_path / "root.usda")), open_over(runs.shot, runs.joined)
    assert points_in(shown, CLOTH, TIMES[-1]) == points_in(asked, CLOTH, TIMES[-1])


def test_a_seam_near_the_bound_is_named_with_the_remedy():
    def line(rms: float) -> str:
        (line,) = seam_lines([Seam(9.0, CLOTH, rms, 0.2, 6)], SEAM_BOUND)
        return line

    assert line(0.044).endswith("; near the bound of 0.05 RMS, and a longer --preroll moves the seam less")
    assert line(0.02).endswith("; the bound is 0.05 RMS")


def test_a_refused_seam_is_mended_by_the_chunk_and_the_preroll_that_the_error_names(
    sample: Callable[[str], Path], tmp_path: Path
):
    """Only that chunk is refined anew; the seam then holds with a third of the bound to spare."""
    shot = sample("swatch")
    first, second = refine_chunks(shot, tmp_path, [(1.0, 12.0), (13.0, 24.0)], steps=5)
    with pytest.raises(LayerError, match="refine the chunk from 13 on with --preroll ") as refused:
        check_seams([first, second])
    preroll = int(str(refused.value).partition("--preroll ")[2].partition(",")[0])
    shutil.rmtree(second)
    assert preroll > 6
    assert refine(shot, second, frames=(13.0, 24.0), preroll=preroll, steps=5).exit_code == 0
    (seam,) = check_seams([first, second])
    assert seam.rms < 2 / 3 * SEAM_BOUND
    report, _ = stitch([first, second], tmp_path / "joined.usdc")
    assert report.exit_code == 0
    assert record_of(tmp_path / "joined.usdc")["options"]["preroll"] == preroll
    assert faults(tmp_path / "joined.usdc", shot) == []


class TestSeamsBeforeAllIsThere:
    """The first two chunks of a job tell how far a seam moves."""

    def test_a_pair_is_measured_and_nothing_is_written(self, runs: Runs, tmp_path: Path):
        there = sorted(runs.chunks[0].parent.iterdir())
        (seam,) = check_seams(runs.chunks[:2])
        _, (whole, *_) = stitch(runs.chunks, tmp_path / "joined.usdc")
        assert seam == whole
        line = ["stitch", *runs.chunks[:2], "--check-seams", "--seam-bound", 0.2 * seam.rms]
        done = run(*line)
        assert (done.exit_code, "is allowed: refine the chunk from 9 on with --preroll" in done.stderr) == (1, True), (
            done.stderr
        )
        assert sorted(runs.chunks[0].parent.iterdir()) == there

    def test_a_chunk_is_measured_beside_those_of_its_folder(self, runs: Runs, tmp_path: Path):
        """What is no chunk, or not whole yet, is left out."""
        (tmp_path / "c").mkdir()
        (tmp_path / "c" / "other.usda").write_text("#usda 1.0\n")
        first, second, third = copied(runs, tmp_path / "all")
        of: dict[str, Any] = {"shot": runs.shot}
        shutil.copytree(first, tmp_path / "c" / "first")
        assert check_seams([tmp_path / "c"], of=tmp_path / "c" / "first", **of) == []
        shutil.copytree(third, tmp_path / "c" / "third")
        assert check_seams([tmp_path / "c"], of=tmp_path / "c" / "third", **of) == []
        shutil.copytree(second, tmp_path / "c" / "second")
        assert [each.after for each in check_seams([tmp_path / "c"], of=tmp_path / "c" / "third", **of)] == [17.0]
        (tmp_path / "c" / "third" / "20.npz").unlink()
        assert [each.after for each in check_seams([tmp_path / "c"], of=tmp_path / "c" / "second", **of)] == [9.0]


def test_a_shot_that_was_edited_between_two_chunks(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """Refused; and warnings of USD itself stay off the terminal."""
    shot = cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0, 3.0, 4.0))
    chunks = refine_chunks(shot, tmp_path, [(1.0, 2.0)], preroll=2)
    layer = Sdf.Layer.FindOrOpen(str(shot))
    layer.subLayerPaths.append("gone.usda")
    layer.Save()
    chunks += refine_chunks(shot, tmp_path, [(3.0, 4.0)], preroll=2)
    with pytest.raises(UsageError, match="were made with other files of the shot"):
        stitch(chunks, tmp_path / "joined.usdc")
    again = refine_chunks(shot, tmp_path, [(1.0, 2.0)], preroll=2, overwrite=True)
    stitch([*again, chunks[1]], tmp_path / "joined.usdc")
    assert "_ReportErrors" not in capfd.readouterr().err
