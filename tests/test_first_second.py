"""A command loads its libraries late: names, files and folders are checked before, and only a solve takes torch."""

import subprocess
import sys
from pathlib import Path

import pytest

from physgraph_usd.lab.samples import write_sample

SOLVER = {"torch", "warp", "trimesh"}
LIBRARIES = {*SOLVER, "numpy", "scipy", "pxr.Sdf", "pxr.Usd"}
RUN = """
import sys
from physgraph_usd.cli import main
try:
    main(sys.argv[1:], prog_name="physgraph-usd")
except SystemExit as end:
    code = end.code
print("MODULES", code, *sys.modules)
"""


def loaded_by(*words: str, folder: Path) -> tuple[int, set[str], str]:
    """Exit code of a command, the modules that it loaded, and its last line on standard error."""
    done = subprocess.run([sys.executable, "-c", RUN, *words], capture_output=True, text=True, check=True, cwd=folder)
    code, *modules = done.stdout.rpartition("MODULES ")[2].split()
    return int(code), set(modules), done.stderr.strip().rpartition("\n")[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample sleeve."""
    folder = tmp_path_factory.mktemp("shots")
    write_sample("sleeve", folder)
    return folder


@pytest.mark.parametrize("command", ["--help", "--version", "refine --help", "inspect --help"])
def test_help_and_version_load_no_library(folder: Path, command: str):
    code, modules, _ = loaded_by(*command.split(), folder=folder)
    assert (code, modules & LIBRARIES) == (0, set())


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("refin", "No such command 'refin'"),
        ("refine sleeve.usdc -o out.usdc --stepps 3", "No such option"),
        ("refine sleeve.usdc -o out.usdc --contact of", "'--contact'"),
        ("refine sleeve.usdc -o out.usdc --integrator physgrap", "known integrators: physgraph, quasi-newton"),
        ("refine sleeve.usdc -o out.usdc --device cdua", "known: cpu, cuda, auto"),
        ("refine sleve.usdc -o out.usdc", "no such file: sleve.usdc"),
        ("refine sleeve.usdc -o outt/out.usdc", "outt does not exist"),
        ("inspect sleve.usdc", "no such file: sleve.usdc"),
        ("validate sleve.usdc", "no such file: sleve.usdc"),
        ("preview sleve.usdc -o out.png", "no such file: sleve.usdc"),
        ("tag sleve.usdc -o out.usda", "no such file: sleve.usdc"),
        ("tune sleve.usdc", "no such file: sleve.usdc"),
        ("chart sleve.usdc -o chart", "no such file: sleve.usdc"),
    ],
)
def test_a_wrong_name_is_refused_before_any_library_is_loaded(folder: Path, command: str, message: str):
    code, modules, line = loaded_by(*command.split(), folder=folder)
    assert message in line
    assert (code, modules & LIBRARIES) == (2, set())
    assert [file.name for file in folder.iterdir()] == ["sleeve.usdc"]


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("inspect sleeve.usdc", 0),
        ("inspect sleeve.usdc --json", 0),
        ("inspect sleeve.usdc --garment /World/Coat", 2),
        ("refine sleeve.usdc -o out.usdc --garment /World/Coat", 2),
    ],
)
def test_reading_a_stage_needs_no_solver(folder: Path, command: str, code: int):
    status, modules, _ = loaded_by(*command.split(), folder=folder)
    assert (status, modules & SOLVER) == (code, set())
