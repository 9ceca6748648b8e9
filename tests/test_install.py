"""README's commands that install: run as they are printed, in environments that hold nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_docs import ROOT, blocks

(BLOCK,) = (block for block in blocks(ROOT / "README.md") if block.why and "test_install" in block.why)
MAKES, *WAYS = (line.partition("    #")[0].strip() for line in BLOCK.code.splitlines())
"""The command that makes an environment, then commands of which one is enough."""
USES = """
physgraph-usd sample swatch -o shots
physgraph-usd refine shots/swatch.usdc -o fine.usdc --level 1 --frames 1:2
physgraph-usd preview fine.usdc -o fine.png
"""
SECONDS = 1500


def shell(folder: Path, *lines: str) -> subprocess.CompletedProcess[str]:
    """Run commands in a shell that knows this interpreter, outside its environment, and ends at the first failure."""
    path = os.pathsep.join([str(Path(sys.base_prefix) / "bin"), os.environ["PATH"]])
    gone = ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME")
    env = {name: value for name, value in os.environ.items() if name not in gone} | {"PATH": path}
    line = ["bash", "-c", "\n".join(["set -e", *lines])]
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=SECONDS)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the checkout without what is made in one."""
    left = shutil.ignore_patterns(".*", "build", "dist", "out", "__pycache__", "films", "benchmarks", "tests")
    return Path(shutil.copytree(ROOT, tmp_path / "checkout", ignore=left))


@pytest.mark.slow
@pytest.mark.timeout(2 * SECONDS)
@pytest.mark.skipif(sys.platform == "win32", reason="commands for a POSIX shell")
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.split()[0] if "uv" not in way else "uv")
def test_the_command_works_after_each_way_to_install(checkout: Path, way: str):
    made = shell(checkout, MAKES)
    assert made.returncode == 0, made.stderr
    needs, _, last = way.rpartition(" && ")
    (enter,) = (each for each in MAKES.split(" && ") if each.startswith(". "))
    ahead = [enter, needs or "true"]
    # The last requirement is of the project itself: what else is asked for is there for everyone, or for no one.
    probe = [*last.replace("install", "install --dry-run", 1).split(" '")[:1], "torch hatchling"]
    reached = shell(checkout, *ahead, " ".join(probe))
    if reached.returncode:
        pytest.skip("no index with these packages can be reached")
    done = shell(checkout, enter, way, USES)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (checkout / "fine.png").is_file()


def test_there_are_two_ways_and_both_install_the_checkout():
    assert len(WAYS) == 2
    assert all("'.[usd,preview]'" in way for way in WAYS)
