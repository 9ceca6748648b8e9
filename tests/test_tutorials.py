"""The tutorials: their commands and code run in order in an empty folder, and print what the pages show."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest
from shots import run
from test_docs import ROOT, TUTORIALS, Block, blocks

pytest.importorskip("PIL", reason="pictures are drawn with pillow")
PICTURES = ROOT / "docs" / "pictures"
MOST_BYTES_OF_A_PICTURE = 150_000


def without_numbers(text: str) -> str:
    """A line in which every number is the same: figures such as times differ between machines."""
    return re.sub(r"-?\d[\d.e+-]*", "#", " ".join(text.split()))


def printed_by(block: Block, names: dict[str, object]) -> str:
    """Run a block in the present folder and return what it printed."""
    if block.kind == "python":
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(block.code, names)
        return printed.getvalue()
    outputs = []
    for line in block.code.splitlines():
        name, *given = shlex.split(line, comments=True)
        if name == "mkdir":
            Path(*given).mkdir()
            continue
        assert name == "physgraph-usd"
        done = run(*given)
        assert done.exit_code == 0, f"{line}\n{done.output}"
        outputs.append(done.output)
    return "\n".join(outputs)


@pytest.mark.slow
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_runs_as_printed(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    printed: set[str] = set()
    for block in blocks(ROOT / "docs" / f"{name}.md"):
        assert block.kind in ("", "python", "text")
        if block.kind == "text":
            missing = [line for line in block.code.splitlines() if without_numbers(line) not in printed]
            assert not missing, f"{missing} not in what the block before it printed"
        elif block.why is None:
            printed = {*map(without_numbers, printed_by(block, names).splitlines())}


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_has_a_picture(name: str):
    page = (ROOT / "docs" / f"{name}.md").read_text("utf-8")
    assert re.search(r"\(\.\./pictures/tutorial_\w+\.jpg\)", page)


def test_the_pictures_of_tutorials_are_small():
    for picture in PICTURES.glob("tutorial_*"):
        assert picture.stat().st_size <= MOST_BYTES_OF_A_PICTURE, picture.name


def test_numbers_are_left_out_of_the_comparison():
    assert without_numbers("  seam at 21: moves 0.0347") == without_numbers("seam at 41: moves 4.36e-02")
    assert without_numbers("seam at 21") != without_numbers("seam of 21")
