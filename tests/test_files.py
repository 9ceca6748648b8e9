"""What a shot is made of is never written, no link is followed, and nothing goes that was not asked for."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdUtils
from shots import cloth_shot, refine, run
from stages import clip_shot, save

from physgraph_usd.usd.files import files_of

SMALL = ("--level", "1", "--steps", "2")
PARTS = ("sub", "under", "reference", "payload", "chosen", "other", "deep", "inactive")


def asset(path: Path) -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Asset").GetPrim())
    stage.Save()
    return stage


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """A shot with every arc that USD has, two variants of which one is selected, value clips and textures."""
    shot = Path(clip_shot(tmp_path))
    stages = {name: asset(tmp_path / f"{name}.usda") for name in PARTS}
    stages["sub"].GetRootLayer().subLayerPaths.append("./under.usda")
    stages["other"].GetDefaultPrim().GetReferences().AddReference("./deep.usda")
    for name in ("sub", "other"):
        stages[name].Save()
    for name in ("cloth.png", "udim.1001.png", "udim.1002.png"):
        (tmp_path / name).write_bytes(b"picture")
    (tmp_path / "broken.usda").write_text("no layer")
    stage = Usd.Stage.Open(str(shot))
    stage.GetRootLayer().subLayerPaths.append("./sub.usda")
    prim = stage.DefinePrim("/World/set")
    prim.GetReferences().AddReference("./reference.usda")
    prim.GetPayloads().AddPayload("./payload.usda")
    variants = prim.GetVariantSets().AddVariantSet("look")
    for name in ("broken", "other", "chosen"):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            prim.GetReferences().AddReference(f"./{name}.usda")
    for name in ("cloth", "udim.<UDIM>"):
        attribute = prim.CreateAttribute(name.partition(".")[0], Sdf.ValueTypeNames.Asset)
        attribute.Set(f"./{name}.png")
    off = stage.DefinePrim("/World/off")
    off.GetReferences().AddReference("./inactive.usda")
    off.SetActive(False)
    return Path(save(stage))


def contents(folder: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
@pytest.mark.parametrize("pipe", ["shot.usda", "below.usda"])
@pytest.mark.parametrize("command", ["refine", "inspect"])
def test_a_pipe_among_them_is_named_in_place_of_a_wait(tmp_path: Path, command: str, pipe: str) -> None:
    (tmp_path / "shot.usda").write_text("#usda 1.0\n(\n    subLayers = [@./below.usda@]\n)\n")
    (tmp_path / pipe).unlink(missing_ok=True)
    os.mkfifo(tmp_path / pipe)
    done = run(command, tmp_path / "shot.usda", *(("-o", tmp_path / "o.usdc") if command == "refine" else ()))
    assert (done.exit_code, f"{pipe} is no file: it is a pipe" in done.stderr) == (1, True)


def test_every_file_of_a_shot_is_found(shot: Path) -> None:
    assert {file.name for file in files_of(shot)} == {file.name for file in shot.parent.iterdir()}


@pytest.mark.parametrize(
    ("name", "option"), [("under", "-o"), ("deep", "--root"), ("inactive", "-o"), ("broken", "-o")]
)
def test_refine_writes_none_of_them(shot: Path, name: str, option: str) -> None:
    before = contents(shot.parent)
    targets = {"-o": shot.parent / "fine.usdc"} | {option: shot.parent / f"{name}.usda"}
    result = run("refine", shot, *(w for pair in targets.items() for w in pair), "--overwrite", *SMALL)
    assert (result.exit_code, "part of the shot" in result.stderr) == (2, True), result.stderr
    assert contents(shot.parent) == before


@pytest.mark.parametrize("how", ["symbolic", "hard", "relative", "folder"])
def test_links_and_detours_lead_to_the_same_file(
    shot: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, link = contents(shot.parent), tmp_path / "links" / "link.usda"
    link.parent.mkdir()
    if how == "symbolic":
        link.symlink_to(shot)
    elif how == "hard":
        os.link(shot, link)
    elif how == "folder":
        (link.parent / "way").symlink_to(tmp_path)
        link = link.parent / "way" / "shot.usda"
    else:
        monkeypatch.chdir(link.parent)
        link = Path("../links/../shot.usda")
    result = run("refine", shot, "-o", tmp_path / "fine.usdc", "--root", link, "--overwrite", *SMALL)
    assert (result.exit_code, "part of the shot" in result.stderr) == (2, True), result.stderr
    assert {name: value for name, value in before.items() if name != "links"} == {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in tmp_path.iterdir() if file.is_file()
    }


@pytest.mark.parametrize(
    "targets", [("-o", "fine.usda", "--root", "fine.usda"), ("-o", "a/fine.usdc", "--root", "b/fine.usdc")]
)
def test_two_results_are_not_one_file(tmp_path: Path, targets: tuple[str, ...]) -> None:
    shot = cloth_shot(tmp_path / "shot.usdc")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to(tmp_path / "a")
    before = sorted(tmp_path.rglob("*"))
    words = [word if word.startswith("-") else str(tmp_path / word) for word in targets]
    result = run("refine", shot, *words, "--overwrite", *SMALL)
    assert (result.exit_code, "the root" in result.stderr) == (2, True), result.stderr
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("workers", ["2"])
def test_no_result_of_a_batch_is_an_input_of_any_of_its_shots(tmp_path: Path, workers: str) -> None:
    """A root of each, over the shots themselves, or over what another shot refers to."""
    shots = [cloth_shot(tmp_path / f"{name}.usda") for name in ("a", "b")]
    (tmp_path / "set").mkdir()
    asset(tmp_path / "set" / "a.usda")
    stage = Usd.Stage.Open(str(shots[1]))
    stage.DefinePrim("/World/set").GetReferences().AddReference("./set/a.usda")
    stage.Save()
    before = {file: file.read_bytes() for file in tmp_path.rglob("*.usda")}
    for roots in (tmp_path, tmp_path / "set"):
        line = ("refine", *shots, "-o", tmp_path / "out", "--root", roots, "--overwrite", "--workers", workers)
        result = run(*line, *SMALL)
        assert (result.exit_code, "a.usda is part of the shot" in result.stderr) == (2, True), result.stderr
    assert {file: file.read_bytes() for file in tmp_path.rglob("*.usd*")} == before
    assert not (tmp_path / "out").exists()


TAG = ("--garment", "/World/cloth", "--overwrite")


@pytest.mark.parametrize(
    ("command", "name", "more"),
    [("tag", "clip.1.usda", TAG), ("tag", "deep.usda", TAG), ("preview", "cloth.png", ())],
)
def test_nor_do_tag_and_preview(shot: Path, command: str, name: str, more: tuple[str, ...]) -> None:
    pytest.importorskip("PIL")
    before = contents(shot.parent)
    result = run(command, shot, "-o", shot.parent / name, *more)
    assert (result.exit_code, "part of the shot" in result.stderr) == (2, True), result.stderr
    assert contents(shot.parent) == before


def test_sample_and_chart_write_over_nothing_unasked(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    mine = [tmp_path / name for name in ("swatch.usdc", "chart.png", "chart.json")]
    for file in mine:
        file.write_text("mine")
    assert run("sample", "swatch", "-o", tmp_path).exit_code == 2
    shot = cloth_shot(tmp_path / "shot.usdc")
    result = run("chart", shot, "-o", tmp_path, "--short")
    assert (result.exit_code, "chart.png exists" in result.stderr) == (2, True), result.stderr
    assert [file.read_text() for file in mine] == ["mine"] * 3
    assert run("sample", "swatch", "-o", tmp_path, "--overwrite").exit_code == 0


def test_a_refined_layer_under_the_shot_may_be_refined_anew(tmp_path: Path) -> None:
    """The root that shows it is what an artist goes on with; what is refined is left out of what is read."""
    shot, out, root = cloth_shot(tmp_path / "shot.usdc"), tmp_path / "fine.usdc", tmp_path / "root.usda"
    refine(shot, out, root=root)
    assert refine(root, out, overwrite=True, level=2).exit_code == 0


@pytest.fixture
def stitched(tmp_path: Path) -> Path:
    """A result with the animation that it was made from in one layer, as others join them, and the result's record."""
    shot, out, both = (
        cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0)),
        tmp_path / "fine.usdc",
        tmp_path / "both.usda",
    )
    refine(shot, out)
    layer = Sdf.Layer.CreateNew(str(both))
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(out)))
    UsdUtils.StitchLayers(layer, Sdf.Layer.FindOrOpen(str(shot)))
    layer.Save()
    return both


@pytest.mark.parametrize("command", ["inspect", "over"])
def test_a_layer_that_others_stitched_to_a_result_is_refused_by_name(stitched: Path, command: str) -> None:
    top = stitched.with_name("top.usda")
    top.write_text("#usda 1.0\n(subLayers = [@./both.usda@])\n")
    shot = top if command == "over" else stitched
    write = () if command == "inspect" else ("-o", stitched.with_name("again.usdc"))
    result = run("inspect" if command == "inspect" else "refine", shot, "--garment", "/World/cloth", *write)
    assert result.exit_code == 1
    assert "</World/cloth> is refined already in both.usda, which holds other things as well" in result.output
    assert "refine the shot that it was made from, ./shot.usda" in result.output


def test_a_result_alone_is_no_shot(stitched: Path) -> None:
    result = run("refine", stitched.with_name("fine.usdc"), "-o", stitched.with_name("again.usdc"))
    assert (result.exit_code, "is a refined layer and no shot" in result.output) == (1, True), result.output


@pytest.mark.parametrize("how", ["sublayer", "prim", "attribute", "sample", "layer data"])
def test_a_result_with_anything_else_in_it_is_part_of_the_shot(stitched: Path, how: str) -> None:
    out, below, root = (stitched.with_name(name) for name in ("fine.usdc", "below.usda", "root.usda"))
    below.write_text("#usda 1.0\n")
    root.write_text("#usda 1.0\n(subLayers = [@./fine.usdc@, @./shot.usda@])\n")
    layer = Sdf.Layer.FindOrOpen(str(out))
    cloth = layer.GetPrimAtPath("/World/cloth")
    if how == "sublayer":
        layer.subLayerPaths.append("./below.usda")
    elif how == "prim":
        Sdf.CreatePrimInLayer(layer, "/World/light")
    elif how == "attribute":
        Sdf.AttributeSpec(cloth, "primvars:age", Sdf.ValueTypeNames.Float).default = 1.0
    elif how == "sample":
        layer.SetTimeSample("/World/cloth.points", 77.0, layer.QueryTimeSample("/World/cloth.points", 1.0))
    else:
        layer.customLayerData = dict(layer.customLayerData) | {"pipeline": "mine"}
    layer.Save()
    for target in (out, below) if how == "sublayer" else (out,):
        result = run("tag", root, "-o", target, "--garment", "/World/cloth", "--overwrite")
        assert (result.exit_code, "part of the shot" in result.output) == (2, True), result.output


def test_the_record_names_value_clips(tmp_path: Path) -> None:
    refine(Path(clip_shot(tmp_path)), tmp_path / "fine.usdc")
    record = Sdf.Layer.FindOrOpen(str(tmp_path / "fine.usdc")).customLayerData["physgraph"]
    assert {"./clip.0.usda", "./clip.1.usda", "./clip.2.usda", "./shot.usda"} <= set(record["inputs"])


@pytest.fixture
def small(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "shot.usda", times=(1.0, 2.0), size=(3, 3))


def locked(folder: Path) -> tuple[Path, tuple[object, ...]]:
    (folder / "fine.usdc.frames").mkdir()
    return folder / "fine.usdc.frames" / "run.lock", ()


OPTIONS: dict[str, Callable[[Path], tuple[Path, tuple[object, ...]]]] = {
    "lock": locked,
    "layer": lambda folder: (folder / "fine.usdc", ("--overwrite",)),
    "log": lambda folder: (folder / "run.log", ("--log-file", folder / "run.log")),
    "report": lambda folder: (folder / "run.json", ("--report", folder / "run.json", "--overwrite")),
    "page": lambda folder: (folder / "page" / "report.html", ("--report", folder / "page", "--overwrite")),
    "summary": lambda folder: (folder / "all.json", ("--summary", folder / "all.json", "--overwrite")),
    "root": lambda folder: (folder / "root.usda", ("--root", folder / "root.usda", "--overwrite")),
}


@pytest.mark.parametrize("what", OPTIONS)
@pytest.mark.parametrize("leads", ["to a file", "nowhere"])
def test_no_link_is_written_through(small: Path, tmp_path: Path, what: str, leads: str):
    link, options = OPTIONS[what](tmp_path)
    mine = tmp_path / "mine.txt"
    if leads == "to a file":
        mine.write_text("mine")
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(mine)
    result = run("refine", small, "-o", tmp_path / "fine.usdc", *options, *SMALL)
    assert result.exit_code == 2, result.output
    assert f"{link} is a link to {mine}; name that, or remove the link" in result.stderr
    assert link.is_symlink()
    assert (mine.read_text() if mine.exists() else None) == ("mine" if leads == "to a file" else None)


@pytest.mark.parametrize("name", ["notes.txt", "cache.npz", "1.npz.bak", "sub"])
@pytest.mark.parametrize("sign", ["run.json", "run.lock"])
def test_a_folder_with_files_that_are_not_ours_is_left(small: Path, tmp_path: Path, name: str, sign: str):
    folder = tmp_path / "fine.usdc.frames"
    (folder / "sub").mkdir(parents=True)
    for file in (folder / sign, folder / "0.npz"):
        file.write_text("{}")
    if name != "sub":
        (folder / "sub").rmdir()
        (folder / name).write_text("mine")
    before = {file.name: None if file.is_dir() else file.read_bytes() for file in folder.iterdir()}
    result = run("refine", small, "-o", tmp_path / "fine.usdc", "--overwrite", *SMALL)
    assert (result.exit_code, f"{name} is not a file of ours" in result.stderr) == (2, True), result.output
    assert {file.name: None if file.is_dir() else file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_a_picture_is_replaced_only_where_that_is_allowed(small: Path, tmp_path: Path, name: str):
    pytest.importorskip("PIL", reason="previews are written with Pillow")
    picture, mine = tmp_path / name, tmp_path / "mine"
    line = ("preview", small, "-o", picture, "--size", "64x32")
    picture.write_text("mine")
    refused = run(*line)
    assert (refused.exit_code, "exists" in refused.stderr) == (2, True), refused.output
    assert picture.read_text() == "mine"
    assert run(*line, "--overwrite").exit_code == 0
    drawn = picture.read_bytes()
    assert drawn[:3] in (b"\x89PN", b"GIF")
    picture.unlink()
    picture.symlink_to(mine)
    assert "is a link" in run(*line, "--overwrite").stderr
    assert not mine.exists()
    assert {file.name for file in tmp_path.iterdir()} == {"shot.usda", name}
