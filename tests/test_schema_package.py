"""The schemas as a package of their own, in a bare USD and beside the whole package."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("pxr", reason="schemas are loaded with usd-core")
pytest.importorskip("hatchling", reason="the wheel is built with hatchling")

from physgraph_usd.version import __version__

ROOT = Path(__file__).parents[1]
LOOK = """
import sys
from pxr import Usd
registry = Usd.SchemaRegistry()
for name in ("PhysGraphGarmentAPI", "PhysGraphColliderAPI", "PhysGraphMaterialAPI"):
    assert registry.FindAppliedAPIPrimDefinition(name), name
garment = registry.FindAppliedAPIPrimDefinition("PhysGraphGarmentAPI")
assert garment.GetPropertyMetadata("physgraph:material:bendStiffness", "displayName") == "Bending Stiffness"
assert "torch" not in sys.modules
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh folder with what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, check=True, cwd=ROOT / "schemas", capture_output=True)
    (wheel,) = folder.glob("physgraph_usd_schemas-*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "target")
    return folder / "target"


@pytest.mark.parametrize(
    ("imports", "by_environment"),
    [
        ("", True),
        ("import physgraph_usd_schemas", False),
        ("import physgraph_usd_schemas, physgraph_usd", False),
        ("import physgraph_usd, physgraph_usd_schemas", False),
        ("import physgraph_usd, physgraph_usd_schemas", True),
    ],
)
def test_usd_finds_the_schemas_once(installed: Path, tmp_path: Path, imports: str, *, by_environment: bool) -> None:
    paths = [installed, *([ROOT] if "physgraph_usd," in imports or ", physgraph_usd" in imports else [])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
    environment.pop("PXR_PLUGINPATH_NAME", None)
    if by_environment:
        environment["PXR_PLUGINPATH_NAME"] = str(installed / "physgraph_usd_schemas")
    done = subprocess.run(
        [sys.executable, "-c", imports + LOOK],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=environment,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_it_has_the_version_of_the_whole_package() -> None:
    project = tomllib.loads((ROOT / "schemas" / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == __version__
    assert project["dependencies"] == []
