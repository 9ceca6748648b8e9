"""The console command: what is printed where, which code it leaves with, and that the installed one starts."""

import json
import os
import pickle
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import pytest
import torch
from frame_solvers import as_named
from jsonschema import Draft202012Validator
from pxr import Sdf, Usd, UsdGeom
from shots import CLOTH, TIMES, cloth_shot, command, run

from physgraph_usd import cli, errors
from physgraph_usd.cli import inspected
from physgraph_usd.shot import summary
from physgraph_usd.shot.report import RefineReport

Sample = Callable[[str], Path]
SMALL = ("--frames", "1:2", "--level", "1")


class TestInstalled:
    @pytest.fixture
    def script(self) -> Path:
        try:
            distribution("physgraph-usd")
        except PackageNotFoundError:
            pytest.skip("physgraph-usd is not installed in this environment; make test installs it")
        return Path(sysconfig.get_path("scripts")) / "physgraph-usd"

    def test_refines_and_says_a_warning_once(self, script: Path, tmp_path: Path) -> None:
        shot = cloth_shot(tmp_path / "part.usda", times=(1.0, 2.0), broken={2.0: float("nan")})
        command = [script, "refine", shot, "-o", tmp_path / "fine.usdc", *SMALL]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 3, done.stderr
        assert Path(done.stdout.strip()) == tmp_path / "fine.usdc"
        assert (tmp_path / "fine.usdc").is_file()
        said = done.stderr.splitlines()
        assert len(said) == len(set(said))
        assert torch.cuda.is_available() or "CUDA" not in done.stderr, "a card that is not there"
        assert sum("no sample is written at time code 2" in line for line in said) == 1

    def test_help_answers_at_once(self, script: Path) -> None:
        """In processor time, which other programs on the machine change little."""
        seconds = []
        for _ in range(5):
            start = sum(os.times()[2:4])
            subprocess.run([script, "--help"], capture_output=True, check=True)
            seconds.append(sum(os.times()[2:4]) - start)
        assert min(seconds) < 0.5


@pytest.mark.parametrize("command", sorted(cli.main.commands))
def test_every_command_explains_itself(command: str) -> None:
    result = run(command, "--help")
    assert result.exit_code == 0
    assert f"Usage: main {command}" in result.output


class TestRefine:
    @pytest.mark.parametrize(("paths", "code"), [("relative", 1), ("absolute", 0)])
    def test_a_moved_layer_finds_its_shot_by_absolute_paths(
        self, sample: Sample, tmp_path: Path, paths: str, code: int
    ) -> None:
        written, moved = tmp_path / "written", tmp_path / "some" / "where" / "else"
        written.mkdir()
        out, root = written / "fine.usdc", written / "fine.usda"
        args = ("--asset-paths", paths, "--root", root, *SMALL)
        assert run("refine", sample("swatch"), "-o", out, *args).exit_code == 0
        assert run("validate", out).exit_code == 0
        moved.parent.mkdir(parents=True)
        written.rename(moved)
        result = run("validate", moved / "fine.usdc")
        assert result.exit_code == code
        assert ("the shot that its record names is not at" in result.stdout) == bool(code)
        assert str(sample("swatch")) in (moved / "fine.usda").read_text() if paths == "absolute" else True

    def test_progress_in_lines_when_asked(self, sample: Sample, tmp_path: Path) -> None:
        result = run("refine", sample("swatch"), "-o", tmp_path / "fine.usdc", "--progress", *SMALL)
        lines = [line for line in result.stderr.splitlines() if "frames" in line]
        assert [line.split()[0] for line in lines] == ["50%", "100%"]
        assert lines[0].endswith("1 of 2 frames")

    @pytest.mark.parametrize("more", [(), ("--dry-run",)])
    @pytest.mark.parametrize("option", ["-o", "--root", "--report"])
    def test_a_suffix_that_is_none_of_ours_is_refused_by_name(
        self, sample: Sample, tmp_path: Path, option: str, more: tuple[str, ...]
    ) -> None:
        named = {"-o": tmp_path / "fine.usdc"} | {option: tmp_path / "x.abc"}
        result = run("refine", sample("swatch"), *(word for pair in named.items() for word in pair), *more, *SMALL)
        assert (result.exit_code, "'.abc'; known: ." in result.stderr) == (2, True), result.stderr
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("option", ["--report", "--root"])
    def test_what_cannot_be_written_is_refused_before_the_work(
        self, sample: Sample, tmp_path: Path, option: str
    ) -> None:
        (tmp_path / "file").write_text("mine")
        for place in (tmp_path / "file", Path("/proc/nowhere")):
            named = (
                "-o",
                tmp_path / "fine.usdc",
                option,
                place / "x" / ("a.json" if option == "--report" else "a.usda"),
            )
            result = run("refine", sample("swatch"), *named, "--progress", *SMALL)
            assert result.exit_code in (1, 2)
            assert result.stderr.startswith("error: cannot write"), result.stderr
        assert [file.name for file in tmp_path.iterdir()] == ["file"]


class TestStreams:
    """What a caller of the command reads: stdout and stderr of whole processes, ends included."""

    @pytest.fixture
    def shot(self, tmp_path: Path) -> Path:
        """A shot whose second sample fails, with a warning."""
        return cloth_shot(tmp_path / "part.usda", times=(1.0, 2.0, 3.0, 4.0), broken={2.0: float("nan")})

    @pytest.mark.parametrize("workers", ["1", pytest.param("2", marks=pytest.mark.slow)])
    def test_quiet_prints_the_path_and_nothing_else(self, shot: Path, tmp_path: Path, workers: str) -> None:
        out = tmp_path / "fine.usdc"
        done = command("refine", shot, "-o", out, "--level", "1", "--workers", workers, "--quiet")
        assert (done.returncode, done.stdout, done.stderr) == (3, f"{out}\n", "")
        again = command("refine", shot, "-o", out, "--level", "1", "--quiet")
        assert (again.returncode, again.stdout) == (2, "")
        assert again.stderr.startswith(f"error: {out} exists")

    def test_without_a_terminal_there_is_no_bar_and_stderr_has_the_warnings(self, shot: Path, tmp_path: Path) -> None:
        done = command("refine", shot, "-o", tmp_path / "fine.usdc", "--level", "1")
        assert done.stdout == f"{tmp_path / 'fine.usdc'}\n"
        assert done.stderr.splitlines()
        assert all(line.startswith("warning: ") for line in done.stderr.splitlines()), done.stderr

    def test_json_is_a_summary_of_all_shots_by_its_schema(self, shot: Path, tmp_path: Path) -> None:
        good = cloth_shot(tmp_path / "good.usda", times=(1.0,))
        done = command("refine", shot, good, "-o", tmp_path / "out", "--level", "0", "--json", "--quiet")
        plain = json.loads(done.stdout)
        Draft202012Validator(json.loads(summary.SCHEMA.read_text("utf-8"))).validate(plain)
        assert done.returncode == plain["exit_code"] == 3
        assert [(row["state"], Path(row["layer"]).is_file()) for row in plain["shots"]] == [
            ("in part", True),
            ("done", True),
        ]

    def test_json_of_a_failed_shot_has_its_error(self, tmp_path: Path) -> None:
        shot = cloth_shot(tmp_path / "torn.usda", times=(1.0,), broken={1.0: float("nan")})
        done = command("refine", shot, "-o", tmp_path / "fine.usdc", "--level", "0", "--json")
        (row,) = json.loads(done.stdout)["shots"]
        assert (done.returncode, row["state"]) == (1, "failed")
        assert done.stderr.splitlines()[-1] == f"error: {row['error']}"

    @pytest.mark.parametrize("more", ["--verbose", "--progress", "--openjd"])
    def test_quiet_excludes_what_prints_more(self, sample: Sample, tmp_path: Path, more: str) -> None:
        result = run("refine", sample("swatch"), "-o", tmp_path / "fine.usdc", "--quiet", more)
        assert (result.exit_code, f"--quiet and {more} exclude each other" in result.stderr) == (2, True)


class TestSeveralShots:
    @pytest.fixture
    def jobs(self, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Path, Any]]:
        """What refine_shots is asked for; it does nothing here."""
        asked: list[tuple[str, Path, Any]] = []

        def refine_shots(jobs: list[tuple[str, Path, Any]], **_: object) -> list[RefineReport]:
            asked.extend(jobs)
            return [RefineReport(shot, out, {}) for shot, out, _ in jobs]

        monkeypatch.setattr("physgraph_usd.shot.refine.refine_shots", refine_shots)
        return asked

    def test_equal_names_are_refused(self, jobs: list[tuple[str, Path, Any]], tmp_path: Path) -> None:
        result = run("refine", "a/shot.usda", "b/shot.usda", "-o", tmp_path / "out")
        assert (result.exit_code, jobs) == (2, [])
        assert "shot.refined.usdc" in result.stderr

    @pytest.mark.parametrize(("first", "code"), [(errors.StageError("torn"), 1), (errors.UsageError("absent"), 2)])
    def test_all_failed_is_no_part(self, monkeypatch: pytest.MonkeyPatch, first: errors.PhysGraphError, code: int):
        """1, and 2 where each was told what is not there."""
        ends = [first, errors.UsageError("absent too")]
        monkeypatch.setattr("physgraph_usd.shot.refine.refine_shots", lambda *_, **__: ends)
        assert run("refine", "a.usda", "b.usda", "-o", "out").exit_code == code

    def test_one_that_dies_leaves_the_others(self, tmp_path: Path) -> None:
        from physgraph_usd.shot.options import RefineOptions
        from physgraph_usd.shot.refine import refine_shots

        ends = {
            "dies": "a worker process died; if memory ran out, use fewer --workers",
            "is ended": "a worker process died",
            "raises": "unexpected ValueError: a bug",
            "torn": "</World/cloth> at time code 5: torn",
            "exhausted": "out of memory; a lower --level or fewer --workers needs less",
            "returns": "returns",
        }
        jobs = [(name, tmp_path / f"{name}.usdc", RefineOptions()) for name in ends]
        for found, end in zip(refine_shots(jobs, workers=2, refine=as_named), ends.values(), strict=True):
            assert end in str(found)


def kinds(root: type[errors.PhysGraphError]) -> list[type[errors.PhysGraphError]]:
    return [root, *(kind for each in root.__subclasses__() for kind in kinds(each))]


class TestErrors:
    @pytest.mark.parametrize("kind", kinds(errors.PhysGraphError))
    def test_every_error_travels_between_processes(self, kind: type[errors.PhysGraphError]) -> None:
        error = kind("</A>", "is torn")
        there = pickle.loads(pickle.dumps(error))
        assert (type(there), str(there), vars(there)) == (kind, str(error), vars(error))

    @pytest.mark.parametrize(
        "args",
        [
            ("refine", "a.usda"),
            ("refine", "-o", "a.usdc"),
            ("refine", "a.usda", "-o", "b.usdc", "--frames", "5:1"),
            ("refine", "a.usda", "-o", "b.usdc", "--frames", "nan"),
            ("refine", "a.usda", "-o", "b.usdc", "--level", "fine"),
            ("preview", "a.usdc", "-o", "b.png", "--size", "0x3"),
            ("sample", "trousers", "-o", "x"),
            ("unknown",),
        ],
    )
    def test_wrong_usage_is_2(self, args: tuple[str, ...]) -> None:
        result = run(*args)
        assert (result.exit_code, result.stdout) == (2, "")
        assert "rror: " in result.stderr

    @pytest.mark.parametrize("command", ["refine", "inspect", "tag", "validate", "preview", "chart"])
    def test_missing_file_is_2(self, command: str, tmp_path: Path) -> None:
        out = {"inspect": (), "validate": (), "preview": ("-o", tmp_path / "x.png")}.get(
            command, ("-o", tmp_path / "x.usdc")
        )
        garment = ("--garment", "/A") if command == "tag" else ()
        result = run(command, tmp_path / "missing.usda", *out, *garment)
        assert (result.exit_code, result.stdout) == (2, "")
        assert result.stderr == f"error: no such file: {tmp_path / 'missing.usda'}\n"
        assert not list(tmp_path.iterdir())

    def test_missing_package_is_named(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        for module in ("stopped", "page.frames", "page.preview"):
            monkeypatch.delitem(sys.modules, f"physgraph_usd.shot.{module}", raising=False)
        monkeypatch.setitem(sys.modules, "PIL", None)
        layer = tmp_path / "a.usdc"
        layer.touch()
        result = run("preview", layer, "-o", tmp_path / "x.png")
        assert result.exit_code == 1
        assert "pip install pillow" in result.stderr


class TestOtherCommands:
    def test_inspect_begins_with_the_garments_and_ends_with_the_command(self, sample: Sample) -> None:
        text, data = run("inspect", sample("swatch")), run("inspect", sample("swatch"), "--json")
        assert (text.exit_code, data.exit_code) == (0, 0)
        found, lines = json.loads(data.stdout), text.stdout.splitlines()
        (garment,) = found["garments"]
        assert lines[0] == f"shot: {sample('swatch')}, 24 frames, 1 to 24, 1 unit is 1 m"
        assert lines[1:2] == ["garments:"]
        points, fine = f"{garment['points']:,} vertices", f"{garment['fine_points']:,} at level {garment['level']}"
        assert lines[2].startswith(f"  {garment['path']}: {points} become {fine}, ")
        assert lines[-1] == f"command: {found['command']}"
        assert len(lines) < 20

    def test_inspect_prints_every_value_on_request(self, sample: Sample) -> None:
        """What the summary leaves out, so that nothing is in the JSON alone."""
        brief, full = (run("inspect", sample("swatch"), *more).stdout for more in ((), ("--details",)))
        found = json.loads(run("inspect", sample("swatch"), "--json").stdout)
        assert full.startswith(brief)
        rest = full[len(brief) :]
        assert "times: 1, 2, 3, ..., 24 (24 in all)" in rest
        for name in {*found, *found["garments"][0], *found["garments"][0]["fabric"]} - {*inspected.PRINTED_IN_FULL}:
            assert f"{name}:" in rest, name

    def test_inspect_names_problems_and_warnings_above_the_command(self, tmp_path: Path) -> None:
        """Of cloth with a face that is there twice, and with a misspelt value."""
        stage = Usd.Stage.Open(str(cloth_shot(tmp_path / "shot.usda")))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH))
        counts, indices = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
        counts.Set([*counts.Get(), 4])
        indices.Set([*indices.Get(), *indices.Get()[:4]])
        mesh.GetPrim().CreateAttribute("physgraph:material:bendStifness", Sdf.ValueTypeNames.Float).Set(1e-5)
        stage.GetRootLayer().Export(str(tmp_path / "faulty.usda"))
        data = json.loads(run("inspect", tmp_path / "faulty.usda", "--json").stdout)
        lines = run("inspect", tmp_path / "faulty.usda").stdout.splitlines()
        defects, warnings = data["defects"][CLOTH], data["warnings"]
        first, second, command = (
            lines.index(each) for each in ("problems:", "warnings:", f"command: {data['command']}")
        )
        assert defects
        assert lines[first + 1 : second] == [f"  {CLOTH}: {each}" for each in defects]
        assert any("bendStifness" in each for each in warnings)
        assert lines[second + 1 : second + 1 + len(warnings)] == [f"  {each}" for each in warnings]
        assert command == len(lines) - 1

    def test_inspect_lists_the_meshes_of_a_shot_without_garments(self, tmp_path: Path) -> None:
        stage = Usd.Stage.Open(str(cloth_shot(tmp_path / "shot.usda")))
        stage.GetPrimAtPath(CLOTH).RemoveAppliedSchema("PhysGraphGarmentAPI")
        stage.GetRootLayer().Export(str(tmp_path / "plain.usda"))
        lines = run("inspect", tmp_path / "plain.usda").stdout.splitlines()
        assert lines[1:3] == ["meshes:", f"  {CLOTH}: 35 vertices, open, {len(TIMES)} samples"]
        assert lines[3] == "problems:"
        assert lines[-1].endswith(f"--garment {CLOTH}")

    def test_validate_says_what_was_checked(self, sample: Sample, tmp_path: Path) -> None:
        out = tmp_path / "fine.usdc"
        assert run("refine", sample("swatch"), "-o", out, *SMALL).exit_code == 0
        done = run("validate", out)
        warning, last = done.stdout.splitlines()
        assert (done.exit_code, warning.startswith("warning")) == (0, True)
        checked = f"1 prim at 2 time codes, alone and over {sample('swatch').name}, by the rules of this package"
        assert last.startswith(f"{out} is valid, with 1 warning: {checked}")
        layer = Sdf.Layer.FindOrOpen(str(out))
        layer.framesPerSecond = layer.timeCodesPerSecond = 7.0
        layer.Save()
        broken = run("validate", out)
        assert (broken.exit_code, "is valid" in broken.stdout) == (1, False)

    @pytest.mark.parametrize("option", ["--garment", "--collider"])
    def test_a_prim_that_is_not_there_is_2(self, sample: Sample, tmp_path: Path, option: str) -> None:
        result = run("inspect", sample("swatch"), option, "/trousers", "--json")
        assert result.exit_code == 2
        found = json.loads(result.stdout)
        assert "no prim at </trousers>" in found["problem"]
        assert found["meshes"]
        done = run("refine", sample("swatch"), "-o", tmp_path / "fine.usdc", option, "/trousers", *SMALL)
        assert (done.exit_code, "no prim at </trousers>" in done.stderr) == (2, True)

    def test_what_cannot_be_refined_as_it_is_is_1(self, tmp_path: Path) -> None:
        """Nothing wrong was asked for: the stage itself names what is not there, or has a garment that is broken."""
        shot = cloth_shot(tmp_path / "shot.usda")
        stage = Usd.Stage.Open(str(shot))
        stage.GetPrimAtPath(CLOTH).CreateRelationship("physgraph:colliders").SetTargets(["/World/gone"])
        stage.Save()
        result = run("inspect", shot)
        assert (result.exit_code, f"<{CLOTH}>.physgraph:colliders: no prim at </World/gone>" in result.stdout) == (1, 1)


@pytest.mark.slow
def test_a_terminal_has_each_message_on_a_line_of_its_own(tmp_path: Path) -> None:
    """Not behind the progress bar, which a frame before has left in the line."""
    pty = pytest.importorskip("pty", reason="terminals of POSIX")
    shot = cloth_shot(tmp_path / "part.usda", times=(1.0, 2.0, 3.0), broken={2.0: float("nan")})
    ours, theirs = pty.openpty()
    line = [sys.executable, "-m", "physgraph_usd", "refine", str(shot), "-o", str(tmp_path / "fine.usdc"), *SMALL[2:]]
    said = b""
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=theirs) as process:
        os.close(theirs)
        with suppress(OSError):  # Linux reports so that nobody has the terminal open any more.
            while more := os.read(ours, 1 << 16):
                said += more
    os.close(ours)
    assert process.returncode == 3
    seen = [text.rpartition("\r\033[K")[2] for text in said.decode().replace("\r\n", "\n").split("\n")]
    (warning,) = [text for text in seen if "no sample is written" in text]
    assert warning.startswith("warning: "), said
    assert any("%" in text for text in seen)
