"""The package as it is imported and as it is shipped."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import physgraph_usd
from physgraph_usd.solver.fabric import PRESETS

ROOT = Path(__file__).resolve().parents[1]
MADE_BY_RUNS = {"build/"}
HEAVY = {"torch", "warp", "numpy", "scipy", "trimesh"}


def modules_after(code: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; sys.stdout.write(' '.join(sys.modules))"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return set(done.stdout.split())


def test_importing_is_light_and_reads_no_stage() -> None:
    assert not {*HEAVY, "pxr.Usd"} & modules_after("import physgraph_usd")


def test_importing_registers_the_schemas() -> None:
    code = (
        "import physgraph_usd\nfrom pxr import Usd\n"
        "assert Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('PhysGraphGarmentAPI')"
    )
    assert "pxr.Usd" in modules_after(code)


def test_the_solver_solves_its_pages_example_without_usd() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    code = page.partition("```python\n")[2].partition("```")[0].replace("range(1, 13)", "range(12, 13)")
    assert "range(12, 13)" in code
    check = "assert fine.shape == (2401, 3) and 0.28 < np.linalg.norm(fine, axis=1).min() < 0.3\n"
    check += "assert sheet.pin.sum() == 9 and np.linalg.norm((fine[:169] - cage)[away < 0.08], axis=1).max() < 1e-6"
    assert "warp" in modules_after(f"import sys; sys.modules['pxr'] = None\n{code}\n{check}")


def test_public_names_are_there_and_an_unknown_one_lists_them() -> None:
    for name in physgraph_usd.__all__:
        assert getattr(physgraph_usd, name) is not None
        assert name in dir(physgraph_usd)
    with pytest.raises(AttributeError, match=r"'refine'.*refine_shot"):
        _ = physgraph_usd.refine


def _build(folder: Path, into: Path) -> None:
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", into], check=True, cwd=folder)


def _names(wheel: Path) -> list[str]:
    return sorted(zipfile.ZipFile(wheel).namelist())


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wheel and the source distribution."""
    folder = tmp_path_factory.mktemp("built")
    _build(ROOT, folder)
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, source


def test_wheel_carries_schemas_weights_and_licence(built: tuple[Path, Path]) -> None:
    wheel, _ = built
    names = _names(wheel)
    assert wheel.name.startswith(f"physgraph_usd-{physgraph_usd.__version__}-py3-none-any")
    data = ("schemas/plugInfo.json", "schemas/generatedSchema.usda", "weights/README.md", "shot/report.schema.json")
    swatches = (f"studio/swatches/{name}.webp" for name in PRESETS)
    for name in (*data, *swatches, "cli/refine.py"):
        assert f"physgraph_usd/{name}" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "schemas/"))]
    metadata = zipfile.ZipFile(wheel).read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert "with coarse animated garments goes in" in metadata
    assert not re.findall(r"\]\((?!https?:)", metadata), "links and pictures that lead nowhere on a package index"


def test_the_source_distribution_and_an_images_files_make_the_same_wheel(
    built: tuple[Path, Path], tmp_path: Path
) -> None:
    """What `.dockerignore` lets through is enough to build the wheel."""
    wheel, source = built
    with tarfile.open(source) as file:
        file.extractall(tmp_path / "source", filter="data")
    (unpacked,) = (tmp_path / "source").iterdir()
    let_through = re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(encoding="utf-8"), re.MULTILINE)
    context = tmp_path / "context"
    for name in let_through:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        context.mkdir(exist_ok=True)
        copy(ROOT / name, context / name)
    for number, folder in enumerate((unpacked, context)):
        _build(folder, tmp_path / str(number))
        (again,) = (tmp_path / str(number)).glob("*.whl")
        assert _names(again) == _names(wheel)


def test_package_indexes_take_the_distributions(built: tuple[Path, Path]) -> None:
    pytest.importorskip("twine", reason="needs twine, which checks what package indexes ask for")
    done = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *built], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("PASSED") == 2


def test_constraints_are_one_version_of_each_requirement_within_its_bounds() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = [
        *project["dependencies"],
        *(line for name in ("usd", "preview", "chart", "farm", "tune") for line in extras[name]),
    ]
    wanted = {requirement.name: requirement for requirement in map(Requirement, lines)}
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pins = dict(re.findall(r"^([\w-]+)==(\S+)$", text, re.MULTILINE))
    assert pins.keys() == wanted.keys() | {"dask"}
    assert all(requirement.specifier.contains(pins[name]) for name, requirement in wanted.items())
    for name in ("torch", "warp-lang", "usd-core"):
        assert any(each.operator == "<" for each in wanted[name].specifier)


def test_contributing_names_each_module_and_none_that_is_not_there() -> None:
    """Its tree holds what is in the package's folder; every file that it names is there."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    package = ROOT / "physgraph_usd"
    tree = text.partition("physgraph_usd/\n")[2].partition("```")[0]
    there = {path.name for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert not {name for name in there if not name.startswith("__") and name not in tree}
    named = re.findall(r"(?<![\w./<>*-])((?:[\w-]+/)*\w[\w-]*\.(?:py|toml|md)|(?:[\w-]+/)+)(?![\w<*])", text)
    assert len(named) > 50
    found = {name for name in named if (ROOT / name).exists() or next(package.rglob(name.rstrip("/")), None)}
    assert not sorted({*named} - found - MADE_BY_RUNS)
