"""The steps of `make` that install: what they print, and what they ask uv and pip for, with stand-ins for both."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from test_docs import ROOT

pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="needs make")
NOISE = "error: Failed to fetch: `https://example.org/whl/cpu/torch/`"
PYTHON = f"""#!{sys.executable}
import os, sys
with open("asked", "a") as file:
    file.write(" ".join(["pip", *sys.argv[1:]]) + "\\n")
if sys.argv[3:5] == ["config", "get"]:
    print(os.environ.get("CONFIGURED", ""))
"""
UV = f"""#!{sys.executable}
import os, sys
with open("asked", "a") as file:
    file.write(" ".join(["uv", *sys.argv[1:]]) + "\\n")
if os.environ.get("UNREACHED"):
    sys.exit({NOISE!r})
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the Makefile and an environment in which pip and uv only write down what they are asked for."""
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    (tmp_path / ".venv" / ".python").touch()
    for name, text in (("python", PYTHON), ("uv", UV)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return tmp_path


def make(checkout: Path, *words: str, **env: str) -> tuple[list[str], list[str]]:
    """Lines that `make` prints for the step that installs torch, and the calls of uv."""
    known = {
        name: value for name, value in os.environ.items() if not name.startswith(("PIP_", "UV_", "MAKE", "MFLAGS"))
    }
    line = ["make", ".venv/.torch", *words]
    done = subprocess.run(line, cwd=checkout, env=known | env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (checkout / ".venv" / ".torch").exists()
    asked = (checkout / "asked").read_text().splitlines() if (checkout / "asked").exists() else []
    return done.stdout.splitlines(), [line for line in asked if line.startswith("uv")]


def test_one_line_where_the_index_of_torch_is_reached(checkout: Path) -> None:
    said, asked = make(checkout)
    assert said == ["installing the cpu build of torch from torch's own index"]
    assert len(asked) == 1
    assert "--torch-backend cpu" in asked[0]
    assert "--default-index" not in asked[0]


def test_a_second_line_says_what_the_other_build_costs_and_no_error_is_shown(checkout: Path) -> None:
    said, _ = make(checkout, UNREACHED="1")
    assert len(said) == 2
    assert "installing torch from pip's index, on Linux 5.6 GB instead of 1.8" in said[1]
    assert NOISE in (checkout / ".venv" / "uv.log").read_text()
    assert ".venv/uv.log" in said[1]


def test_the_build_of_pip_is_taken_at_once_when_asked_for(checkout: Path) -> None:
    assert make(checkout, "TORCH=pip", UNREACHED="1") == (["installing torch from pip's index"], [])


@pytest.mark.parametrize("how", ["PIP_INDEX_URL", "CONFIGURED"])
def test_a_mirror_that_pip_is_set_to_use_is_asked(checkout: Path, how: str) -> None:
    """By the environment variable, and by pip's configuration."""
    _, asked = make(checkout, **{how: "https://mirror.example.org/simple"})
    assert "--default-index https://mirror.example.org/simple" in asked[0]


def test_the_add_on_for_blender_is_a_zip_with_the_manifest_at_the_top(tmp_path: Path) -> None:
    place = tmp_path / "made" / "addon.zip"
    line = ["make", "blender", f"ADDON={place}", f"PYTHON={sys.executable}", "SOLVER=/studio/physgraph-usd"]
    alone = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False, env=alone)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{place}\n", "")
    folder = ROOT / "plugins" / "blender"
    there = {file.name for file in folder.iterdir() if file.is_file()}
    made = zipfile.ZipFile(place)
    assert {*made.namelist()} == there | {"solver.txt"}
    assert made.read("solver.txt") == b"/studio/physgraph-usd\n"
    assert "blender_manifest.toml" in there


def test_the_newest_releases_go_into_a_folder_of_their_own() -> None:
    line = ["make", "--dry-run", "newest"]
    printed = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    installs = [line for line in printed.splitlines() if "-m pip install" in line or "uv pip install" in line]
    assert installs
    assert all(".venv-newest/bin" in line and "--upgrade" in line for line in installs)
    assert ".venv/bin" not in printed
    assert ".venv-newest/bin/pytest" in printed
