"""README's commands that install, and the image's steps: run as they are printed, in environments that hold nothing."""

import json
import os
import re
import shlex
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


def steps_of_the_image(root: Path) -> list[str]:
    """The Dockerfile's steps as a shell's lines in a checkout, with the image's folders below a folder."""
    text = (ROOT / "plugins" / "docker" / "Dockerfile").read_text(encoding="utf-8")
    lines = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ").splitlines()
    found = list[str]()
    for word, _, rest in (line.partition(" ") for line in lines if line):
        here = re.sub(r"(?<![\w/.])/(?=(venv|src|var|shots)\b)", f"{root}/", rest)
        if word == "COPY":
            seen = (line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!"))
            here = f"mkdir {root}/src && cp -r {' '.join(seen)} {root}/src" if rest == ". /src" else "true"
        elif word == "ENTRYPOINT":
            here = f'{shlex.join(json.loads(rest))} "$@"'
        found.append({"FROM": "true", "ARG": f"export {here}", "ENV": f"export {here}"}.get(word, here))
        found[-1] = f"mkdir -p {here} && cd {here}" if word == "WORKDIR" else found[-1]
    return found


@pytest.mark.slow
@pytest.mark.timeout(2 * SECONDS)
@pytest.mark.skipif(sys.platform == "win32", reason="commands for a POSIX shell")
def test_the_steps_of_the_image_end_in_a_command_that_refines(checkout: Path, tmp_path: Path):
    """A shell stands in for the builder, and this Python for the image's."""
    base = [f"python3 -m venv {tmp_path}/base", f"export PATH={tmp_path}/base/bin:$PATH"]
    *steps, run = steps_of_the_image(tmp_path)
    assert any("-c" in step and "constraints.txt" in step for step in steps)
    index = shell(checkout, *base, "pip install uv", "uv pip install --no-cache --dry-run --torch-backend cpu torch")
    if index.returncode:  # The index of the smaller builds cannot be reached: the package index has others.
        steps = [step.replace('--torch-backend "$TORCH"', "") for step in steps]
    words = ["sample swatch -o .", "refine swatch.usdc -o fine.usdc --level 1 --frames 1:2"]
    done = shell(checkout, *base, *steps, *(line for each in words for line in (f"set -- {each}", run)))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "shots" / "fine.usdc").is_file()
