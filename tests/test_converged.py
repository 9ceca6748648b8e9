"""The judge of rest: a cheap row, kept runs, and what identifies them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="the judge reads stages with usd-core")

from click.testing import CliRunner
from shots import cloth_shot

from benchmarks import converged
from benchmarks.converged import CONVERGED_NAMES, Run, beside, key_of, main, reference_of, result_table, run_tasks
from benchmarks.judge_shot import Job
from benchmarks.versions import HERE, Task
from physgraph_usd.lab.samples import SAMPLES


@pytest.fixture
def cheap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sheet in the place of the sample of a swatch, and one converged run of few steps."""
    monkeypatch.setattr(converged, "job_of", lambda *_: Job(str(cloth_shot(tmp_path / "sheet.usda"))))
    monkeypatch.setitem(converged.CONVERGED, "steps", 40)
    monkeypatch.setattr(converged, "INTEGRATORS", ("quasi-newton",))
    monkeypatch.setattr(converged, "CONVERGED_NAMES", CONVERGED_NAMES[:1])


@pytest.mark.usefixtures("cheap")
def test_a_cheap_row_is_judged_and_its_converged_run_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    kept = tmp_path / "kept"
    asked = ["--shot", "swatch", "--level", "1", "--frames", "4", "--rest-steps", "40", "--keep", str(kept)]
    result = CliRunner().invoke(main, asked)
    assert result.exit_code == 0, result.output
    converged_row, own = [line for line in result.output.splitlines() if line.startswith("| swatch")]
    assert converged_row.startswith(f"| swatch | {CONVERGED_NAMES[0]} |")
    assert own.count(" - ") == 0, "every figure is there"
    files = sorted(kept.iterdir())
    assert [file.suffix for file in files] == [".json", ".npz"]
    made = []
    monkeypatch.setattr(converged, "run_all", lambda tasks, *_, **__: iter(made.extend(tasks) or ()))
    task = Task("swatch", CONVERGED_NAMES[0], HERE, "", converged_job(tmp_path))
    [run] = run_tasks([task], kept, place=tmp_path, jobs=1, limit=1.0)
    assert not made
    assert run.positions == files[1]
    assert (run.figures["warm"] or 0.0) > 0.0


def converged_job(folder: Path) -> Job:
    """The converged run of the cheap row."""
    solve = converged.CONVERGED | {"integrator": "quasi-newton"}
    return Job(str(cloth_shot(folder / "sheet.usda")), level=1, count=4, solve=solve)


def test_kept_runs_are_known_by_content_and_not_by_place_or_by_what_is_measured(tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda")
    (tmp_path / "other").mkdir()
    copy = tmp_path / "other" / "sheet.usda"
    copy.write_bytes(shot.read_bytes())
    job = Job(str(shot), count=4)
    same = replace(job, shot=str(copy), rest=2, rest_steps=9, positions="elsewhere.npz", device="cuda")
    assert key_of(same) == key_of(job)
    others = [replace(job, count=5), replace(job, level=1), replace(job, ripple=0.2), replace(job, garments=("/a",))]
    assert len({key_of(each) for each in (job, *others)}) == 1 + len(others)
    copy.write_text(shot.read_text("utf-8") + "\n# changed\n", "utf-8")
    assert key_of(same) != key_of(job)


def folded(degrees: float, frames: int) -> np.ndarray:
    """Two triangles that meet at an angle, in some frames."""
    angle = np.radians(degrees)
    return np.tile([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -np.cos(angle), np.sin(angle)]], (frames, 1, 1))


def test_runs_beside_a_converged_run(tmp_path: Path):
    runs = []
    for version, degrees in ((CONVERGED_NAMES[0], 40.0), ("default", 30.0)):
        file = tmp_path / f"{version}.npz"
        points = folded(degrees, 4)
        points[-1, :, 2] += 1e-3 * (version == "default")
        np.savez(file, points=points, triangles=np.array([[0, 1, 2], [1, 0, 3]]))
        runs.append(Run("sheet", version, 0.0, file, {"warm": 1000.0}))
    assert reference_of(runs[0], runs) is None
    assert reference_of(runs[1], runs) is runs[0]
    found = beside(runs[1], runs[0])
    assert found["folding"] == pytest.approx(0.75)
    assert found["angle90"] == pytest.approx(10.0, rel=1e-6)
    assert found["second"] > 0.5
    assert beside(runs[0], None) == {}
    failed = Run("sheet", "older", 0.0, tmp_path / "none.npz", error="ValueError: no")
    assert beside(failed, runs[0]) == {}
    text = result_table([runs[0], replace(runs[1], figures={"warm": 500.0, **found}), failed])
    assert "sheet, older, ripple 0%: ValueError: no" in text
    assert "| sheet | default | 0.50 | - |" in text


def test_default_shots_are_samples_or_real():
    assert all(row.is_real or row.source in SAMPLES for row in converged.SHOTS)
