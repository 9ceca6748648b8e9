"""Reading and writing with the oldest version of USD that the package allows, and one between.

Tests of other files also expect that all of USD's validators run; 25.5.1 lists 22 whose libraries it leaves out.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("24.5", "25.5.1")
FILES = (
    "bodies",
    "cage",
    "odd_stages",
    "overs",
    "reader",
    "schema",
    "skinning",
    "subsets",
    "targets",
    "validate",
    "writer",
)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("version", VERSIONS)
def test_stages_are_read_and_written_alike(version: str, tmp_path: Path):
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(tmp_path / "usd")]
    if subprocess.run([*install, f"usd-core=={version}"], check=False, capture_output=True).returncode:
        pytest.skip(f"no usd-core {version} to install")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path / "usd"), str(ROOT)))}
    show = [sys.executable, "-c", "from pxr import Usd; print(*Usd.GetVersion())"]
    shown = subprocess.run(show, env=environment, check=True, capture_output=True, text=True)
    assert shown.stdout.split()[1:] == version.split(".")[:2]
    tests = [str(ROOT / "tests" / f"test_{name}.py") for name in FILES]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, env=environment, cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
