"""Tuning: values tried on one frame, soon or as `refine` solves it, and saved as `tag` does."""

from __future__ import annotations

import gc
import io
import shlex
import threading
import weakref
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="shots are read with usd-core")

from browser import served
from click.testing import CliRunner
from cloth import rms
from pxr import Usd, UsdGeom
from shots import CLOTH, EDGE, cloth_shot

from physgraph_usd.cli import main
from physgraph_usd.errors import PhysGraphError, UsageError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.studio.loop import SolveLoop
from physgraph_usd.studio.session import Shown, TuneSession
from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.write.tag import tag

STIFF = 3e-4


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return cloth_shot(tmp_path / "sheet.usda", size=(8, 6))


@pytest.fixture
def session(shot: Path) -> Iterator[TuneSession]:
    with closing(TuneSession(shot, garments=[CLOTH])) as made:
        yield made


def points(shown: Shown) -> np.ndarray:
    assert shown.points[0] is not None
    return shown.points[0]


def test_a_value_is_solved_from_where_the_cloth_was(session: TuneSession):
    before = session.settle()
    session.set_value(CLOTH, "guide:stiffness", 100.0)
    after = session.solve()
    assert (before.settled, after.settled) == (True, False)
    assert after.telemetry[0]["start"] == "warm"
    assert np.abs(points(after) - points(before)).max() > 1e-5
    assert session.solve() is after


@pytest.mark.parametrize("contact", [False, True])
def test_a_settled_frame_is_what_refine_gives_from_the_same_state(session: TuneSession, contact: bool):
    """Within a tenth of a fine edge: by its own factor, not the lent one of the rough solve."""
    session.set_contact(contact)
    session.set_level(CLOTH, 2)
    session.settle()
    session.set_value(CLOTH, "bendStiffness", STIFF)
    session.set_value(CLOTH, "guide:stiffness", 100.0)
    rough = session.solve()
    own = session._solver._refiner
    settled = session.settle()
    exact = own.fork(replace(session._solver._settings, temporal="warm"))
    state = exact.solve(session.shot.frame(session.time))
    (known,) = state.points
    assert known is not None
    assert np.linalg.norm(known - points(settled), axis=1).max() < 0.1 * EDGE / 4
    assert settled.settled
    assert np.abs(points(settled) - points(rough)).max() > 1e-7


def test_a_rough_solve_shows_each_round_and_ends_near_the_settled_cloth(session: TuneSession):
    session.set_level(CLOTH, 2)
    start = points(session.settle())
    session.set_value(CLOTH, "guide:stiffness", 100.0)
    seen: list[np.ndarray] = []
    rough = points(session.solve(lambda found: seen.append(found[CLOTH])))
    settled = points(session.settle())
    assert len(seen) >= 1
    assert np.abs(seen[-1] - rough).max() < 1e-6
    assert rms(rough - settled) < 0.3 * rms(start - settled)


def test_a_first_frame_is_settled_at_once_and_matches_refine(session: TuneSession, shot: Path):
    shown = session.solve()
    assert shown.settled
    assert session.settle() is shown
    with closing(open_shot(str(shot), garments=[CLOTH])) as opened:
        settings = RefineOptions().solve_settings()
        (known,) = Refiner(opened.scene, settings, levels=session.levels).solve(opened.frame(1.0)).points
    assert known is not None
    assert np.abs(known - points(shown)).max() < 1e-7


def test_old_materials_are_forgotten(session: TuneSession):
    """Each one kept a Cholesky factor."""
    session.settle()
    (group,) = session._solver._refiner.groups
    kept: list[weakref.ref[object]] = []
    for k in range(4):
        session.set_value(CLOTH, "bendStiffness", STIFF * (k + 1))
        session.solve()
        session.settle()
        ((*_, finest),) = group._forces.values()
        kept.append(weakref.ref(finest))
        del finest
    gc.collect()
    assert [each() is None for each in kept] == [True, True, True, False]


def test_a_settling_that_is_cancelled_goes_on_from_there(session: TuneSession):
    session.settle()
    session.set_value(CLOTH, "bendStiffness", STIFF)
    session.solve()
    steps = count()
    cancelled = session.settle(cancelled=lambda: next(steps) >= 2)
    assert not cancelled.settled
    assert session.solve() is cancelled
    assert session.settle().settled
    assert session.settle() is session.solve()


def test_the_command_refines_the_whole_shot(session: TuneSession, tmp_path: Path):
    session.set_value(CLOTH, "bendStiffness", STIFF)
    session.save()
    words = shlex.split(session.command)
    done = CliRunner().invoke(main, words[1:])
    assert done.exit_code == 0, done.output
    stage = Usd.Stage.Open(words[words.index("-o") + 1])
    assert UsdGeom.Mesh(stage.GetPrimAtPath(CLOTH)).GetPointsAttr().GetNumTimeSamples() == len(session.times)


def test_a_preset_takes_the_place_of_the_last_ones_values(session: TuneSession):
    session.set_value(CLOTH, "rest:weftEase", 2.0)
    session.set_preset(CLOTH, "denim")
    assert session.value(CLOTH, "weftStretchStiffness") == 226.0
    session.set_preset(CLOTH, "jersey")
    assert session.value(CLOTH, "weftStretchStiffness") is None
    assert session.value(CLOTH, "shearStiffness") is None
    assert session.value(CLOTH, "rest:weftEase") == pytest.approx(2.0)


def test_save_writes_what_tag_writes(session: TuneSession, shot: Path, tmp_path: Path):
    before = shot.read_bytes()
    session.set_preset(CLOTH, "silk")
    session.save()
    tagged = tag(shot, tmp_path / "tagged.usda", garments=[CLOTH], preset="silk")
    assert session.out.read_text() == tagged.read_text()
    assert shot.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["sheet.tuned.usda", "sheet.usda", "tagged.usda"]


def test_only_its_own_file_is_replaced(session: TuneSession, shot: Path):
    session.save()
    session.set_value(CLOTH, "thickness", 0.002)
    session.save()
    assert "thickness = 0.002" in session.out.read_text()
    with pytest.raises(UsageError, match="exists"):
        TuneSession(shot, garments=[CLOTH])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda own: own.set_value(CLOTH, "bend", 1.0), "known values: rest:weftEase"),
        (lambda own: own.set_value("/World/x", "bendStiffness", 1.0), "no garment </World/x>"),
        (lambda own: own.set_value(CLOTH, "density", -1.0), "density is -1"),
        (lambda own: own.set_preset(CLOTH, "steel"), "known presets: cotton"),
        (lambda own: own.set_level(CLOTH, 9), "refine:level is 9"),
        (lambda own: own.set_level(CLOTH, -1), "0 or more"),
        (lambda own: own.set_time(2.5), "no sample at time code 2.5"),
    ],
)
def test_what_cannot_be_used_changes_nothing(session: TuneSession, change, said: str):
    shown = session.solve()
    with pytest.raises(UsageError, match=said):
        change(session)
    assert session.solve() is shown


class Log:
    """What a loop tells; the first solve waits until it is let go."""

    def __init__(self) -> None:
        self.shown: list[Shown] = []
        self.errors: list[str] = []
        self.rounds = 0
        self.go, self.settled = threading.Event(), threading.Event()

    def busy(self, what: str) -> None:
        if "settling" not in what:
            self.go.wait(20.0)

    def seen(self, points: object) -> None:
        self.rounds += 1

    def show(self, shown: Shown) -> None:
        self.shown.append(shown)
        if shown.settled:
            self.settled.set()

    def fail(self, error: PhysGraphError) -> None:
        self.errors.append(str(error))


def test_changes_during_a_solve_are_solved_once_and_then_settled(session: TuneSession):
    log = Log()
    loop = SolveLoop(session, log, rest_seconds=0.05)
    loop.ask(lambda own: own.set_value(CLOTH, "density", -1.0))
    for k in range(10):
        loop.ask(lambda own, k=k: own.set_value(CLOTH, "bendStiffness", STIFF * (k + 1)))
    log.go.set()
    assert log.settled.wait(30.0)
    loop.close()
    assert session.value(CLOTH, "bendStiffness") == pytest.approx(10 * STIFF)
    assert len(log.shown) <= 3
    assert log.shown[-1].settled
    assert log.rounds >= 2
    assert len(log.errors) == 1


@pytest.mark.browser
def test_the_page_in_a_browser(tmp_path: Path):
    pytest.importorskip("viser", reason="the page is served with viser")
    image = pytest.importorskip("PIL.Image", reason="screenshots are compared with pillow")
    from physgraph_usd.studio.page import TunePage

    shot = cloth_shot(tmp_path / "sheet.usda", size=(8, 6))
    session = TuneSession(shot, garments=[CLOTH])
    page = TunePage(session, port=8200)
    with closing(session), closing(page), served(page.url) as shown:

        def picture() -> np.ndarray:
            shown.wait_for_timeout(500)
            whole = image.open(io.BytesIO(shown.screenshot()))
            return np.asarray(whole.convert("RGB"), float)[250:, :1000]

        settled = shown.get_by_text("settled: as refine solves it")
        settled.wait_for(timeout=30000)
        before, at_first = picture(), points(session.solve())
        row = shown.locator(".value", has_text="Guide Stiffness")
        slider = row.locator("xpath=../following-sibling::div[1]").get_by_role("slider")
        box = slider.bounding_box()
        shown.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        shown.mouse.down()
        shown.mouse.move(box["x"] - 100, box["y"] + box["height"] / 2, steps=5)
        shown.mouse.up()
        shown.get_by_text("N/m³").first.wait_for()
        shown.wait_for_function("!document.querySelector('#state').textContent.startsWith('settled')")
        settled.wait_for(timeout=30000)
        tuned = session.value(CLOTH, "guide:stiffness")
        assert tuned is not None
        assert tuned < 1500.0
        assert np.abs(picture() - before).mean() > 0.1
        assert np.abs(points(session.solve()) - at_first).max() > 1e-4
        shown.get_by_role("button", name="Save layer").click()
        shown.get_by_text("saved into").wait_for()
        stage = Usd.Stage.Open(str(session.out))
        assert stage.GetPrimAtPath(CLOTH).GetAttribute("physgraph:guide:stiffness").Get() == tuned
