"""The pictures of samples in docs: coarse, and refined with more and more forces.

    python -m benchmarks.pictures docs/pictures [NAME...]

Refines some frames up to the time code that is drawn, at level 2. For samples about contact it prints what each panel
says: free vertices deeper than 0.1 mm in the body, edges through faces of cloth and body, and of cloth and cloth, all
measured by what the report measures with. The coarse panel's are those of the upsampled cage. The T-shirt is drawn by
`preview`. Trims are drawn on the refined cloth twice: as they lie on the subdivided input, and bound to the cloth.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from benchmarks.rows import say
from physgraph_usd.lab.samples import write_sample
from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.page.drawing import BACKGROUND, Surface, View, draw, encode_color, fit_view
from physgraph_usd.shot.page.preview import label, preview
from physgraph_usd.shot.refine import refine_shot
from physgraph_usd.shot.solve import prepare_device
from physgraph_usd.solver.contact.bodies import FrameBodies
from physgraph_usd.solver.contact.broad_phase import Bodies
from physgraph_usd.solver.contact.cloth import ClothContact
from physgraph_usd.solver.contact.frame import FrameContact
from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.level import build_levels, refine_garments
from physgraph_usd.solver.scene import recentred
from physgraph_usd.usd.read.meshes import DrawnMesh, DrawnStage
from physgraph_usd.usd.read.reader import open_shot

LEVEL, PREROLL = 2, 6
"""Subdivisions, and frames solved before the one drawn."""
PANEL, BAND, COLORS = (540, 420), 50, 144
"""A panel's size, the height of its label [pixels], and colours in a picture."""
FORMS = {
    "Elastic forces only": RefineOptions(contact="off", self_contact="off"),
    "With the body": RefineOptions(self_contact="off"),
    "With the body and itself": RefineOptions(),
}
"""Titles and options of the refined panels."""
NO_BODY = {
    "Elastic forces only": FORMS["Elastic forces only"],
    "With the other sheet and itself": RefineOptions(),
}
FINER = 3
"""Samples per pixel along each axis of a section."""
MARKS = ((0.0, (0.40, 0.40, 0.39)), (0.5, (0.80, 0.50, 0.04)), (1.0, (0.75, 0.02, 0.02)))
"""Linear colours of the heat map by value."""
DEEPEST = 8.0
"""Depth that the heat map shows in its last colour [mm]."""


@dataclass(frozen=True)
class Shown:
    """What of a sample is drawn.

    Attributes:
        time: Time code.
        middle: Middle of what must be seen [m].
        size: Its extent along each axis [m].
        camera: Azimuth and elevation [degrees].
        forms: The refined panels.
        heat: Numbers of the panels that a second picture shows as heat maps.
        section: Draw the section at the middle's z instead of the view.
    """

    time: float
    middle: tuple[float, float, float]
    size: tuple[float, float, float]
    camera: tuple[float, float]
    forms: dict[str, RefineOptions]
    heat: tuple[int, ...] = ()
    section: bool = False


SHOWN = {
    "block": Shown(12.0, (0.02, 0.25, 0.0), (0.36, 0.22, 0.3), (40.0, 22.0), FORMS, heat=(1, 3)),
    "torus": Shown(20.0, (0.0, -0.05, 0.0), (0.30, 0.18, 0.28), (25.0, 30.0), FORMS),
    "armpit": Shown(15.0, (0.205, 0.27, 0.0), (0.06, 0.30, 0.0), (0.0, 0.0), FORMS, section=True),
    "layers": Shown(8.0, (0.02, 0.97, 0.05), (0.30, 0.26, 0.2), (30.0, 8.0), FORMS),
    "hood": Shown(12.0, (0.0, 0.11, -0.06), (0.24, 0.22, 0.2), (150.0, 8.0), FORMS),
    "crossing": Shown(6.0, (0.0, 0.84, 0.0), (0.3, 0.28, 0.2), (78.0, 2.0), NO_BODY),
}
"""The pictures of contact by sample."""
PREVIEWED = {"tshirt": (24.0, 36.0)}
"""First frame and the one drawn by `preview`, by sample."""
TRIMS = Shown(
    34.0,
    (-0.05, 0.08, 0.08),
    (0.22, 0.2, 0.15),
    (-22.0, 13.0),
    {
        "Trims on the subdivided input": RefineOptions(steps=0, contact="off", self_contact="off"),
        "Trims bound to the refined cloth": RefineOptions(),
    },
)
"""The picture of the sample `trims`."""


def main() -> None:
    """Draw the pictures."""
    prepare_device("cpu")
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or [*SHOWN, *PREVIEWED, "trims"]:
        with tempfile.TemporaryDirectory() as folder:
            if name in PREVIEWED:
                say(str(previewed(name, Path(folder), out / f"{name}.png")))
            elif name == "trims":
                say(str(trims(Path(folder), out / "trims.png")))
            else:
                say(str(picture(name, SHOWN[name], Path(folder), out / f"contact_{name}.png")))


def previewed(name: str, folder: Path, out: Path) -> Path:
    """Refine a sample and draw it beside its cage."""
    shot, layer = write_sample(name, folder), folder / "refined.usdc"
    refine_shot(shot, layer, RefineOptions(frames=PREVIEWED[name]))
    return preview(layer, out, times=[PREVIEWED[name][1]], size=(1280, 640), overwrite=True)


def trims(folder: Path, out: Path) -> Path:
    """Draw buttons and piping on the refined render mesh, following the subdivided input and the refined cloth."""
    shot, panels = write_sample("trims", folder), []
    for number, options in enumerate(TRIMS.forms.values()):
        layer = folder / f"{number}.usdc"
        first = TRIMS.time - (PREROLL if options.steps else 0)
        refine_shot(shot, layer, replace(options, frames=(first, TRIMS.time), level=LEVEL))
        stage = DrawnStage(shot, layer)
        stage.bake((TRIMS.time,))
        found = stage.meshes(TRIMS.time, cages=[path for path in stage.paths() if not path.endswith("/Form")])
        panels.append({mesh.path.rpartition("/")[2]: mesh for mesh in found})
    refined = panels[-1]
    drawn = [[refined["Form"], refined["Render"], each["Buttons"], each["Piping"]] for each in panels]
    away = np.linalg.norm(panels[0]["Piping"].points - refined["Piping"].points, axis=1).max()
    _save(out, _draw(drawn, TRIMS), [*TRIMS.forms], notes=[[f"piping up to {1e3 * away:.0f} mm off the cloth"], []])
    return out


def picture(name: str, shown: Shown, folder: Path, out: Path) -> Path:
    """Refine a sample in each form and draw it.

    Args:
        name: The sample.
        shown: What of it is drawn.
        folder: For the shot and the layers.
        out: The picture.

    Returns:
        The picture.
    """
    shot = write_sample(name, folder)
    layers = [folder / f"{i}.usdc" for i in range(len(shown.forms))]
    for layer, options in zip(layers, shown.forms.values(), strict=True):
        frames = (max(shown.time - PREROLL, 1.0), shown.time)
        refine_shot(shot, layer, replace(options, frames=frames, level=LEVEL, heat_map=True))
    meshes = [DrawnStage(shot).meshes(shown.time)]
    meshes += [DrawnStage(shot, layer).meshes(shown.time) for layer in layers]
    titles = ["Coarse input", *shown.forms]
    notes = [_said(each) for each in measured(shot, shown.time, meshes[1:])]
    for title, note in zip(titles, notes, strict=True):
        say(f"{name} {shown.time:g}, {title}: {', '.join(note)}")
    drawn = _draw(meshes, shown)
    if shown.section:
        wider = PANEL[0] / PANEL[1] * shown.size[1] / shown.size[0]
        titles = [f"{each}: section, {wider:.1f} times as wide" for each in titles]
    _save(out, drawn, titles, notes=notes)
    if shown.heat:
        heated = [meshes[0], *(_heated(layers[place - 1], meshes[place], shown.time) for place in shown.heat)]
        drawn = _draw(heated, shown)[1:]
        _save(
            out.with_name("contact_heat.png"),
            drawn,
            [f"{titles[each]}: the heat map" for each in shown.heat],
            notes=[notes[each] for each in shown.heat],
        )
    return out


def measured(shot: Path, time: float, refined: Sequence[Sequence[DrawnMesh]]) -> list[dict[str, int]]:
    """What is in bodies and what crosses, in the upsampled cage and in each of some results.

    Args:
        shot: The shot, in metres, Y up.
        time: The time code.
        refined: The meshes of each result.
    """
    opened = open_shot(str(shot))
    scene, frame = opened.scene, opened.frame(time)
    opened.close()
    chains = refine_garments(scene.garments, [LEVEL] * len(scene.garments))
    levels = build_levels([recentred(g) for g in scene.garments], chains, dtype=torch.float32, device="cpu")
    bodies = Bodies(scene.colliders, device="cpu", threads=1)
    bodies.pose(frame.colliders)
    every = range(len(scene.colliders))
    parts = list(zip(scene.garments, frame.garments, strict=True))
    touching = bodies.touching(every, [[f.offset if i in g.colliders else None for i in every] for g, f in parts])
    world = np.concatenate([each.points for each in frame.garments])
    origin, settings = world.mean(axis=0), ContactSettings()
    coarse = torch.as_tensor(world - origin, dtype=torch.float32)
    edge = float(levels[0].spacing.mean())
    touched = FrameBodies.begin(touching, coarse, edge=edge, origin=origin, settings=settings) if touching else None
    contact = FrameContact(
        levels,
        coarse,
        bodies=touched,
        cloth=ClothContact(levels, scene.garments),
        thickness=[f.fabric.thickness for f in frame.garments],
        settings=settings,
    )
    found: list[dict[str, int]] = []
    for meshes in refined:
        points = {mesh.path: mesh.points for mesh in meshes}
        x = np.concatenate([points[garment.path] for garment in scene.garments]) - origin
        said = contact.measure(torch.as_tensor(x, dtype=torch.float32))[0]
        found += [_sums(said, when) for when in (("before", "after") if not found else ("after",))]
    return found


def _sums(said: dict[str, Any], when: str) -> dict[str, int]:
    """The figures of a panel, summed over bodies; those of bodies are left out where there are none."""
    bodies, cloth = said.get("bodies"), said.get("cloth")
    sums: dict[str, int] = {} if bodies is None else {"inside": 0, "pinched": 0, "body": 0}
    for values in (bodies or {}).values():
        for name, key in (("inside", "inside"), ("pinched", "pinched"), ("body", "crossings")):
            sums[name] += values[when][key]
    return sums | {"cloth": cloth[when]["crossings"] if cloth else 0}


def _said(sums: dict[str, int]) -> list[str]:
    """The small print of a panel."""
    lines = []
    if "inside" in sums:
        pinched = f" and {sums['pinched']:,} pinched" if sums["pinched"] else ""
        lines.append(f"{sums['inside']:,} vertices inside the body{pinched}")
        lines.append(f"{sums['body']:,} crossings of cloth and body")
    return [*lines, f"{sums['cloth']:,} crossings of cloth and cloth"]


def _heated(layer: Path, meshes: Sequence[DrawnMesh], time: float) -> list[DrawnMesh | Surface]:
    """The meshes in the colours of their heat maps, where they have one."""
    from pxr import Usd, UsdGeom  # noqa: PLC0415

    stage = Usd.Stage.Open(str(layer))
    out: list[DrawnMesh | Surface] = []
    for mesh in meshes:
        prim = stage.GetPrimAtPath(mesh.path)
        if prim:
            known = UsdGeom.PrimvarsAPI(prim)
            maps = [known.GetPrimvar(f"physgraph:{name}").Get(time) for name in ("penetration", "crossing")]
            depth, crossing = (np.zeros(len(mesh.points)) if each is None else np.asarray(each) for each in maps)
            value = np.maximum(depth / DEEPEST, crossing)[mesh.triangles].max(axis=1).clip(0.0, 1.0)
            at, colors = zip(*MARKS, strict=True)
            shaded = np.stack([np.interp(value, at, channel) for channel in np.array(colors).T], axis=1)
            out.append(Surface(mesh.points, mesh.triangles, shaded))
        else:
            out.append(mesh)
    return out


def _draw(panels: Sequence[Sequence[DrawnMesh | Surface]], shown: Shown) -> list[np.ndarray]:
    """The pixels of each panel."""
    if shown.section:
        return [_section(meshes, shown) for meshes in panels]  # A slit of millimetres: across is drawn larger than up.
    view, floor = _view(shown), min(float(mesh.points[:, 1].min()) for mesh in panels[0]) - 0.02
    return [draw(meshes, view, size=PANEL, floor=floor) for meshes in panels]


def _section(meshes: Sequence[DrawnMesh | Surface], shown: Shown) -> np.ndarray:
    """Lines in which meshes meet the plane through the middle, across and up each filling the panel."""
    size = np.array(PANEL) * FINER
    sheet = Image.new("RGB", tuple(size.tolist()), encode_color(tuple(BACKGROUND)))
    pen = ImageDraw.Draw(sheet)
    low, extent = np.array(shown.middle) - 0.5 * np.array(shown.size), np.array(shown.size)
    for mesh in meshes:
        corners = mesh.points[mesh.triangles] - (low[0], low[1], shown.middle[2])
        above = corners[:, :, 2] > 0.0
        for color, triangle, side in zip(mesh.colors, corners, above, strict=True):
            if side.any() and not side.all():
                ends = _ends(triangle, side) / extent[:2] * size
                place = [(float(x), float(size[1] - y)) for x, y in ends]
                pen.line(place, fill=encode_color(tuple(0.6 * color)), width=2 * FINER)
    return np.asarray(sheet.resize(PANEL, Image.Resampling.BOX))


def _ends(triangle: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Where two sides of a triangle pass through z = 0, shape (2, 2)."""
    alone = int(np.flatnonzero(above == (above.sum() == 1))[0])
    ends = []
    for other in {0, 1, 2} - {alone}:
        part = triangle[alone, 2] / (triangle[alone, 2] - triangle[other, 2])
        ends.append(triangle[alone, :2] + part * (triangle[other, :2] - triangle[alone, :2]))
    return np.array(ends)


def _view(shown: Shown) -> View:
    """A camera that sees a box."""
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    box = np.array(shown.middle) + corners * shown.size
    return fit_view(box, PANEL[0] / PANEL[1], azimuth=shown.camera[0], elevation=shown.camera[1])


def _save(out: Path, drawn: Sequence[np.ndarray], titles: Sequence[str], *, notes: Sequence[Sequence[str]]) -> None:
    """Write panels in rows of two, each below its label."""
    rows, (width, height) = -(-len(drawn) // 2), (PANEL[0], PANEL[1] + BAND)
    sheet = Image.new("RGB", (2 * width, rows * height), "white")
    pen = ImageDraw.Draw(sheet)
    for place, pixels in enumerate(drawn):
        left, top = place % 2 * width, place // 2 * height
        sheet.paste(Image.fromarray(pixels), (left, top + BAND))
        label(pen, (left, top), height, lines=[titles[place], ", ".join(notes[place])])
    sheet.quantize(COLORS, kmeans=4, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()
