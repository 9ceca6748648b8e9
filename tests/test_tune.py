"""Tuning: values tried on one frame, soon or as `refine` solves it, and saved as `tag` does."""

import gc
import shlex
import threading
import time as clock
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from cloth import frame_of, rms, sheet
from meshes import grid
from pxr import Usd, UsdGeom
from shots import CLOTH, EDGE, cloth_shot, run
from stages import add_subset

from physgraph_usd.errors import PhysGraphError, SchemaError, UsageError
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.solver.frame.refiner import Refiner
from physgraph_usd.solver.scene import Garment, Scene
from physgraph_usd.studio.brush import SMOOTH, Brush, Stroke, circle, hit
from physgraph_usd.studio.loop import SolveLoop, Watcher
from physgraph_usd.studio.maps import HIGH, LOW, MEASURED, MIDDLE, stretches
from physgraph_usd.studio.notes import Notes
from physgraph_usd.studio.session import Shown, TuneSession
from physgraph_usd.studio.setting import History, Setting
from physgraph_usd.studio.takes import FRESH, MOST_SETTINGS, STALE
from physgraph_usd.usd.read.reader import Shot, open_shot
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
    assert shown.garments[0].points is not None
    return shown.garments[0].points


def test_a_value_is_solved_from_where_the_cloth_was(session: TuneSession):
    before = session.settle()
    session.set_value(CLOTH, "guide:stiffness", 100.0)
    after = session.solve()
    assert (before.settled, after.settled) == (True, False)
    assert after.garments[0].telemetry["start"] == "warm"
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
    own = session.solver.refiner
    settled = session.settle()
    exact = own.fork(replace(session.solver._settings, temporal="warm"))
    state = exact.solve(session.shot.frame(session.time))
    known = state.garments[0].points
    assert known is not None
    assert np.linalg.norm(known - points(settled), axis=1).max() < 0.1 * EDGE / 4
    assert settled.settled
    assert np.abs(points(settled) - points(rough)).max() > 1e-7


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
    done = run(*words[1:])
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


class Log(Watcher):
    """What a loop tells; the first solve waits until it is let go."""

    def __init__(self) -> None:
        self.shown: list[Shown] = []
        self.errors: list[str] = []
        self.rounds = self.solves = 0
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

    def solved(self) -> None:
        self.solves += 1

    def fail(self, error: PhysGraphError) -> None:
        self.errors.append(str(error))


def test_changes_during_a_solve_are_solved_once_and_then_settled(session: TuneSession):
    log = Log()
    loop = SolveLoop(session, log, rest_seconds=0.05)
    loop.start()
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


def test_undo_and_redo_bring_back_values_maps_and_levels(session: TuneSession):
    session.set_value(CLOTH, "bendStiffness", STIFF)
    session.set_level(CLOTH, 1)
    session.paint(CLOTH, "bendScale", np.full_like(session.painted(CLOTH, "bendScale"), 3.0))
    session.set_contact(False)
    said = []
    while session.history.undone_next:
        said.append(session.history.undone_next)
        session.undo()
    assert said == ["contact off", "Bending Stiffness Scale", "Subdivisions", "Bending Stiffness"]
    assert session.setting.values == {}
    assert session.painted(CLOTH, "bendScale").max() == 1.0
    for _ in said:
        session.redo()
    assert session.value(CLOTH, "bendStiffness") == pytest.approx(STIFF)
    assert session.painted(CLOTH, "bendScale").max() == 3.0
    assert (session.setting.levels, session.setting.contact) == ((1,), False)
    assert points(session.solve()).shape[0] == session.refinements[0][-1].mesh.vertex_count
    session.undo()
    session.set_value(CLOTH, "density", 0.4)
    assert session.history.redone_next == ""


def test_undo_brings_back_the_cloth_of_the_step_and_goes_on_from_there(session: TuneSession):
    first = session.settle()
    session.set_value(CLOTH, "guide:stiffness", 20.0)
    second = session.settle()
    assert not np.array_equal(points(first), points(second))
    session.undo()
    assert session.solve() is first
    session.redo()
    assert session.solve() is second
    session.undo()
    session.set_value(CLOTH, "guide:stiffness", 20.0)
    assert session.solve() is not second
    assert np.linalg.norm(points(session.settle()) - points(second), axis=1).max() < 0.01
    for k in range(MOST_SETTINGS):
        session.set_value(CLOTH, "density", 0.2 + 0.1 * k)
        session.settle()
    assert len(session._steps._kept) == MOST_SETTINGS


def test_a_drag_is_one_step_of_undo():
    now = [0.0]
    history = History(Setting((1,)), seconds=lambda: now[0])
    for time in (1.0, 1.5, 2.0, 9.0):
        now[0] = time
        history.put(Setting((1,)), "Density", joins=True)
    history.put(Setting((1,)), "Pin")
    history.put(Setting((1,)), "Pin")
    steps = []
    while history.undone_next:
        steps.append(history.undone_next)
        history.go(-1)
    assert steps == ["Pin", "Pin", "Density", "Density"]


def test_a_value_is_taken_from_the_shot_again(session: TuneSession):
    first = session.value(CLOTH, "density")
    session.set_value(CLOTH, "density", 0.9)
    session.set_value(CLOTH, "rest:weftEase", 3.0)
    session.reset(CLOTH, "density")
    assert session.value(CLOTH, "density") == first
    assert session.value(CLOTH, "rest:weftEase") == 3.0
    session.set_as_authored(CLOTH)
    assert session.value(CLOTH, "rest:weftEase") == 0.0


def test_a_and_b_are_exchanged_with_their_cloth(session: TuneSession):
    a = points(session.settle())
    session.keep()
    session.set_value(CLOTH, "guide:stiffness", 100.0)
    b = points(session.settle())
    session.swap()
    assert rms(points(session.settle()) - a) < 0.2 * rms(b - a)
    assert session.value(CLOTH, "guide:stiffness") == 2000.0
    assert session.kept_shown is not None
    assert np.array_equal(points(session.kept_shown), b)
    session.set_time(session.codes[1] + 4e-4)
    assert session.kept_shown is None
    assert session.go_on(None)
    assert session.kept_shown is not None
    assert session.kept_shown.frame.time == session.times[1]
    assert not session.go_on(None)


def test_a_is_kept_when_it_is_settled(session: TuneSession):
    session.keep()
    assert session.kept_shown is not None
    assert session.kept_shown.settled
    session.set_time(session.times[1])
    assert session.go_on(None, lambda: True)
    assert session.kept_shown is None
    assert session.go_on(None)
    assert session.kept_shown is not None
    assert session.kept_shown.settled


def test_takes_of_few_settings_are_kept(session: TuneSession):
    """Each held the levels and factors of its solver."""
    span, solvers = (session.codes[0], session.codes[0]), list[weakref.ref[object]]()
    for k in range(MOST_SETTINGS + 3):
        session.paint(CLOTH, "bendScale", np.full_like(session.painted(CLOTH, "bendScale"), k + 1.0))
        assert session.go_on(span)
        solvers.append(weakref.ref(session.solver.refiner._cloth))
    gc.collect()
    assert sum(each() is not None for each in solvers) <= MOST_SETTINGS
    session.undo()
    assert session.takes.fresh(session.codes[0], session.setting) is not None


def test_a_painted_map_is_solved_and_saved_as_a_primvar(session: TuneSession, tmp_path: Path):
    before = points(session.settle())
    held = session.painted(CLOTH, "pin")
    assert held.max() == 0.0
    held = np.where(np.arange(len(held)) < len(held) // 2, 1.0, 0.0)
    session.paint(CLOTH, "pin", held)
    after = points(session.settle())
    cage = session.shot.frame(session.time).garments[0].points
    assert np.abs(after[: len(cage)] - cage)[held == 1.0].max() < 1e-6
    assert np.abs(before[: len(cage)] - cage)[held == 1.0].max() > 1e-4
    session.save()
    with closing(open_shot(str(session.out))) as saved:
        assert np.array_equal(saved.scene.garments[0].pin, held)
    with closing(TuneSession(session.out, out=tmp_path / "again.usda")) as again:
        assert np.array_equal(again.painted(CLOTH, "pin"), held)


def test_what_is_painted_outside_its_limits_changes_nothing(session: TuneSession):
    with pytest.raises(SchemaError, match="pin"):
        session.paint(CLOTH, "pin", np.full_like(session.painted(CLOTH, "pin"), -1.0))
    with pytest.raises(UsageError, match="known maps"):
        session.paint(CLOTH, "weight", session.painted(CLOTH, "pin"))
    assert session.setting.painted == {}


def test_the_range_is_solved_as_refine_solves_it(session: TuneSession, shot: Path):
    span = (session.codes[0], session.codes[-1])
    while session.go_on(span):
        pass
    assert session.takes.states(session.codes, session.setting) == [FRESH] * len(session.codes)
    with closing(open_shot(str(shot), garments=[CLOTH])) as opened:
        refiner = Refiner(opened.scene, RefineOptions().solve_settings(), levels=session.setting.levels)
        states = list(refiner.refine(opened.frame(time) for time in session.codes))
    session.set_time(session.codes[-1])
    last = states[-1].garments[0].points
    assert last is not None
    assert np.abs(points(session.solve()) - last).max() < 1e-6
    session.set_value(CLOTH, "bendStiffness", STIFF)
    assert session.takes.states(session.codes, session.setting) == [STALE] * len(session.codes)
    assert session.go_on(span)
    assert session.takes.states(session.codes, session.setting) == [FRESH] + [STALE] * (len(session.codes) - 1)
    session.undo()
    assert session.takes.fresh(session.codes[0], session.setting) is not None


def test_a_loop_plays_the_range_round_and_goes_on_with_changes(session: TuneSession):
    log = Log()
    log.go.set()
    loop = SolveLoop(session, log, rest_seconds=0.01)
    loop.start()

    def play(_: TuneSession) -> None:
        loop.span, loop.playing = (session.codes[0], session.codes[2]), True

    loop.ask(play)
    wait_for(lambda: len(log.shown) > 8)
    loop.ask(lambda own: own.set_value(CLOTH, "bendStiffness", STIFF))
    seen = len(log.shown)
    wait_for(lambda: len(log.shown) > seen + 4)
    loop.ask(lambda _: setattr(loop, "playing", False))
    loop.close()
    times = [each.frame.time for each in log.shown[-4:]]
    assert set(times) == set(session.codes[:3])
    assert session.value(CLOTH, "bendStiffness") == pytest.approx(STIFF)
    assert log.errors == []


def wait_for(happened: Callable[[], bool], seconds: float = 180.0) -> None:
    end = clock.monotonic() + seconds
    while not happened():
        assert clock.monotonic() < end
        clock.sleep(0.01)


def test_strains_are_of_the_stretched_cloth():
    """A flat sheet, stretched by a tenth along its width and pressed together by a twentieth along its height."""
    mesh, rest = sheet(6, 5)
    scene = Scene((Garment.of(CLOTH, mesh.indices.reshape(-1, 3), rest),), np.array([0.0, -9.81, 0.0]))
    refiner = Refiner(scene, RefineOptions().solve_settings(), levels=[1])
    flat = refiner.group_of((0,)).levels[-1].rest.double().numpy()
    found = stretches(refiner, frame_of(rest), 0, flat * [1.1, 0.95, 1.0])
    assert np.sort(found[:, :2], axis=1) == pytest.approx(np.array([[-5.0, 10.0]] * len(found)), abs=0.01)
    assert found[:, 2] == pytest.approx(np.full(len(found), -5.0), abs=0.01)
    colors = MEASURED["strain along weft"][0].colors(np.array([-9.0, 0.0, 9.0]))
    assert colors[:, :3].tolist() == [LOW.tolist(), MIDDLE.tolist(), HIGH.tolist()]


def test_a_brush_paints_where_it_touches_and_on_the_other_side():
    mesh, rest = grid(9, 9)
    stroke = Stroke(CLOTH, "pin", np.zeros(len(rest)))
    where = {"mesh": mesh, "rest": rest, "right": np.array([1.0, 0.0, 0.0])}
    at = hit(rest[10] + [0, 0, 1.0], np.array([0.0, 0.0, -1.0]), rest, mesh.triangulate(rest).triangles)
    assert at is not None
    assert at == pytest.approx(rest[10])
    brush = Brush(radius=0.15 * np.ptp(rest[:, 0]), value=1.0, strength=1.0, mirrored=True)
    stroke.touch(brush, at, rest, **where)
    mirror = int(np.linalg.norm(rest - [np.ptp(rest[:, 0]) - rest[10, 0], rest[10, 1], 0.0], axis=1).argmin())
    assert stroke.values[10] == pytest.approx(1.0)
    assert stroke.values[mirror] == pytest.approx(1.0)
    assert (stroke.values > 0).sum() <= 10
    peak = stroke.values.max()
    stroke.touch(replace(brush, mode=SMOOTH), at, rest, **where)
    assert stroke.values.max() < peak
    assert hit(rest[10] + [0, 0, 1.0], np.array([0.0, 0.0, 1.0]), rest, mesh.triangulate(rest).triangles) is None


def test_notes_are_read_again_and_no_other_file_is_taken_for_them(tmp_path: Path):
    layer = tmp_path / "a.tuned.usda"
    notes = Notes(layer)
    notes.presets["mine"] = {"bendStiffness": 2e-5}
    notes.save({"time": 3.0})
    again = Notes(layer)
    assert (again.presets, again.looked) == ({"mine": {"bendStiffness": 2e-5}}, {"time": 3.0})
    again.path.write_text('{"kind": "something else"}')
    with pytest.raises(UsageError, match="move it away"):
        Notes(layer)
    again.path.write_text("not json")
    with pytest.raises(UsageError, match="cannot be read"):
        Notes(layer)


def test_subsets_of_another_fabric_follow_their_garment_and_are_saved_so(tmp_path: Path):
    stage = Usd.Stage.Open(str(cloth_shot(tmp_path / "sheet.usda", size=(8, 6))))
    add_subset(stage, "trim", np.arange(8), bendStiffness=1e-4)
    stage.Save()
    with closing(TuneSession(tmp_path / "sheet.usda", garments=[CLOTH])) as session:
        (times,) = {scale for scale in bends(session.shot) if scale != 1.0}
        session.set_value(CLOTH, "bendStiffness", STIFF)
        assert bends(session.shot) == {1.0, times}
        with closing(open_shot(session.save())) as saved:
            assert saved.frame(1.0).garments[0].fabric.bend == pytest.approx(STIFF)
            assert sorted(bends(saved)) == pytest.approx(sorted({1.0, times}))


def bends(shot: Shot) -> set[float]:
    """Multiples of the garment's bending on its faces."""
    scale = shot.scene.garments[0].fabric_scale
    assert scale is not None
    return {float(each) for each in scale[:, 1]}


def test_the_ring_of_a_brush_is_closed_and_lies_on_the_cloth_at_the_brushs_radius():
    mesh, points = grid(20, 20)
    points = points * [1.0, 1.0, 0.0] + np.sin(6.0 * points[:, :1]) * [0.0, 0.0, 0.05]
    at, radius = points[len(points) // 2], 0.31 * np.ptp(points[:, 0])
    segments = circle(points, mesh.triangulate(points).triangles, at, radius)
    assert np.linalg.norm(segments - at, axis=2) == pytest.approx(radius, rel=0.02)
    _, times = np.unique(segments.reshape(-1, 3).round(9), axis=0, return_counts=True)
    assert len(segments) > 20
    assert (times == 2).all()
