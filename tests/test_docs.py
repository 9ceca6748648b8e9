"""The pages: the site builds without a warning, and every block of code runs or says why not."""

import json
import re
import shlex
import shutil
import subprocess
import sys
import threading
from functools import partial
from glob import glob
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from typing import NamedTuple

import pytest
from browser import served
from shots import run
from stages import add_mesh, add_sheet, new_stage, save

from benchmarks.films import README as README_FILMS
from docs import tables
from physgraph_usd.cli import main
from physgraph_usd.shot.options import OPTIONS

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = tuple(f"tutorials/{name}" for name in ("first_shot", "look", "farm", "solver"))
HOW_TO = ("tune", "symptoms", "limits", "handoff", "trouble", "batch", "farm", "hooks")
REFERENCE = ("commands", "attributes", "fabrics", "presets", "swatches", "layers", "report", "api", "glossary")
EXPLANATION = ("comparison", "solver", "contact", "chart", "learned", "results")
KINDS = {"Tutorials": TUTORIALS, "How-to": HOW_TO, "Reference": REFERENCE, "Explanation": EXPLANATION}
"""Pages of the four kinds, by section of the site's menu."""
OTHERS = ("index", "gallery")
NAMES = (*OTHERS, *HOW_TO, *REFERENCE, *EXPLANATION)
PAGES = [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in NAMES)]
"""Pages with commands that run by themselves; tests/test_tutorials.py runs the tutorials."""
MOST_WORDS_OF_README = 1_000
MOST_PROGRAMS = 20
RESULTS = ROOT / "benchmarks" / "results"
MOST_BYTES_OF_A_FILM, MOST_BYTES_OF_FILMS = 1_600_000, 6_000_000
BLOCK = re.compile(
    r"(?:<!-- not run: (?P<why>[^>]+) -->\n)?^```(?P<kind>\w*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL
)


class Block(NamedTuple):
    """A block of code: its language, none for commands, its text, and why it is not run, if so."""

    kind: str
    code: str
    why: str | None


def blocks(page: Path) -> list[Block]:
    return [Block(found["kind"], found["code"], found["why"]) for found in BLOCK.finditer(page.read_text("utf-8"))]


@pytest.fixture
def folder(tmp_path: Path, page: Path) -> Path:
    """A place as the pages suppose one: shots of a coat, a folder for chunks, and the project's own folders."""
    count = 48 if page.stem == "farm" else 4
    stage = new_stage(tmp_path / "shot.usda", metres=0.05)
    add_sheet(stage, "/World/Coat", times=tuple(map(float, range(1, count + 1))), size=(3, 2))
    corners = [(0, 0, -4), (3, 0, -4), (0, 2, -4), (0, 0, -1)]
    add_mesh(stage, "/World/Body", corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], schema=None)
    shot = save(stage)
    for name in ("seq", "publish", "build"):
        (tmp_path / name).mkdir()
    for name in ("a", "b"):
        shutil.copy(shot, tmp_path / "seq" / f"{name}.usda")
    (tmp_path / "plugins").symlink_to(ROOT / "plugins")
    return tmp_path


def run_block(block: Block, names: dict[str, object]) -> None:
    """Run a block in the present folder; Python goes on with the names of the blocks before it on its page."""
    if block.kind == "python":
        exec(block.code, names)
        return
    if block.kind == "toml":
        Path("physgraph.toml").write_text(block.code, "utf-8")
    commands = "physgraph-usd inspect shot.usda" if block.kind == "toml" else block.code
    for line in filter(None, commands.splitlines()):
        name, *given = shlex.split(line, comments=True)
        if name == "mkdir":
            Path(*given).mkdir()
            continue
        assert name == "physgraph-usd"
        done = run(*(found for each in given for found in sorted(glob(each)) or [each]))
        assert done.exit_code == 0, f"{line}\n{done.output}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_runs_or_says_why_not(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(ROOT / "plugins")
    names: dict[str, object] = {}
    for block in blocks(page):
        assert block.kind in ("", "sh", "python", "toml")
        if block.why is None:
            run_block(block, names)


def test_the_blocks_are_found():
    assert len(blocks(ROOT / "README.md")) == 5
    assert len(blocks(ROOT / "docs" / "farm.md")) == 3


def words(page: Path) -> int:
    """Number of words of a page; the bars of its tables are none."""
    return sum(any(letter.isalnum() for letter in word) for word in page.read_text("utf-8").split())


def test_the_readme_is_short_and_the_changelog_too():
    assert words(ROOT / "README.md") <= MOST_WORDS_OF_README
    assert len((ROOT / "CHANGELOG.md").read_text("utf-8").splitlines()) <= 60


def test_every_page_is_of_one_kind_and_the_menu_keeps_the_kinds_apart():
    names = [*NAMES, *TUTORIALS]
    assert len({*names}) == len(names)
    found = (ROOT / "docs").rglob("*.md")
    assert {*names} == {file.relative_to(ROOT / "docs").with_suffix("").as_posix() for file in found}
    menu = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    for kind, pages in KINDS.items():
        section = menu.partition(f"  - {kind}:\n")[2].partition("\n  - ")[0]
        listed = re.findall(r": ([\w/]+)\.md$", section, re.MULTILINE)
        assert [name for name in listed if not name.startswith("notebooks/")] == [*pages], kind


def test_every_benchmark_is_named_by_a_page_and_every_name_is_a_benchmarks():
    """A program whose figures no page shows goes, and so does a figure whose program is gone."""
    files = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "benchmarks").glob("*/__main__.py")]
    programs = {
        file.parent.name if file.stem == "__main__" else file.stem
        for file in files
        if 'if __name__ == "__main__":' in file.read_text("utf-8")
    } - {"newton_cloth", "judge_shot"}  # `fidelity` and `versions` run them, in processes of their own.
    text = "".join(page.read_text("utf-8") for page in (*PAGES, ROOT / "CONTRIBUTING.md"))
    assert set(re.findall(r"python -m benchmarks\.(\w+)", text)) == programs
    assert len(programs) <= MOST_PROGRAMS


def test_every_result_is_listed_with_the_command_that_writes_it():
    page = (ROOT / "docs" / "results.md").read_text("utf-8")
    listed = re.findall(r"^\| `([\w.]+)` \|.*\| `python [^`]+` \|$", page, re.MULTILINE)
    assert sorted(listed) == sorted(file.name for file in RESULTS.iterdir() if file.suffix != ".webp")


@pytest.mark.parametrize("name", ["symptoms", "trouble"])
def test_advice_names_what_there_is(name: str):
    """Every option in code marks is one of the commands', every attribute one of the schemas'."""
    said = " ".join(re.findall(r"`([^`\n]+)`", (ROOT / "docs" / f"{name}.md").read_text("utf-8")))
    known = [each for command in main.commands.values() for each in command.params]
    options = {option for each in known for option in (*each.opts, *each.secondary_opts)}
    attributes = (ROOT / "docs" / "attributes.md").read_text("utf-8")
    assert set(re.findall(r"(?<!\S)--[a-z-]+", said)) <= options
    asked = re.findall(r"(?:primvars:)?physgraph:[\w:]+", said)
    asked += [f"physgraph:material:{short}" for short in re.findall(r"--set (\w+)=", said)]
    assert asked or name != "symptoms"
    for attribute in asked:
        assert f"| `{attribute}` |" in attributes


def test_tables_are_those_of_the_code_and_of_the_films():
    for page in tables.PAGES:
        assert tables.page_with_table(page) == page.read_text("utf-8"), "run python -m docs.tables"


def test_the_gallery_has_its_films_and_they_are_short():
    page = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    films = {ROOT / "docs" / name for name in re.findall(r'(?:src|poster)="([^"]+)"', page)}
    assert {each.stem for each in films} == {*json.loads(tables.FIGURES.read_text("utf-8"))}
    films |= set((ROOT / "docs" / "films").glob("*.webp"))
    sizes = {film: film.stat().st_size for film in films}
    assert max(sizes.values()) <= MOST_BYTES_OF_A_FILM
    assert sum(sizes.values()) <= MOST_BYTES_OF_FILMS


def test_make_draws_the_films_with_commands_that_there_are():
    line = ["make", "--dry-run", "films", "SHOTS=shots"]
    printed = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    modules = re.findall(r"python -m ((?:benchmarks|docs)\.\w+)", printed)
    assert modules == ["benchmarks.films", "docs.tables", "benchmarks.tune"]
    assert all(map(find_spec, modules))


@pytest.mark.parametrize("name", README_FILMS)
@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_first_films_have_the_figures_of_the_record(name: str, page: str):
    recorded, text = json.loads(tables.FIGURES.read_text("utf-8"))[name], (ROOT / page).read_text("utf-8")
    _, shown, after = text.partition(f"films/{name}.webp")
    assert shown
    assert f"{recorded['cage']:,} vertices to {recorded['fine']:,}" in " ".join(after.split("![")[0].split())


@pytest.mark.parametrize("notebook", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda each: each.stem)
def test_notebooks_run(notebook: Path, monkeypatch: pytest.MonkeyPatch):
    """The cells run in order in one namespace, in under a minute of processor time; their own assertions judge."""
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = [each for each in json.loads(notebook.read_text("utf-8"))["cells"] if each["cell_type"] == "code"]
    names: dict[str, object] = {}
    began = process_time()
    for cell in cells:
        exec("".join(cell["source"]), names)
    assert process_time() - began < 60.0
    assert len(cells) >= 4
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without a warning: dead links, missing pictures and pages that are in no menu are warnings."""
    place = tmp_path_factory.mktemp("site")
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(place)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "not included in the" not in done.stderr
    return place


def test_the_site_has_its_pages(site: Path):
    assert (site / "index.html").is_file()
    assert "data:image/png" in (site / "notebooks" / "solver.html").read_text(encoding="utf-8")
    python = (site / "api.html").read_text(encoding="utf-8")
    assert not [name for name in OPTIONS if f">{name}</span></code></td>" not in python]


@pytest.mark.browser
def test_the_site_searches_and_turns_dark_without_the_network(site: Path):
    handler = partial(QuietHandler, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with served(f"http://127.0.0.1:{server.server_port}/") as page:
                page.get_by_placeholder("Search").click()
                page.keyboard.type("denim")
                page.locator(".md-search-result__item", has_text="denim").first.wait_for()
                page.keyboard.press("Escape")
                assert page.locator("body").get_attribute("data-md-color-scheme") == "default"
                page.locator("label[title=Dark]").click()
                page.locator("body[data-md-color-scheme=slate]").wait_for()
        finally:
            server.shutdown()


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves files without a line for each."""

    def log_message(self, format: str, *args: object) -> None:
        """Write nothing."""
