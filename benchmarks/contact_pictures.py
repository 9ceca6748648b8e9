"""The pictures of docs/contact.md: each sample about contact as its coarse input, and refined with more and more forces.

    python -m benchmarks.contact_pictures docs/pictures [NAME...]

Refines some frames up to the time code that is drawn, at level 2, and prints what each panel says: free vertices
deeper than 0.1 mm in the body, edges through faces of cloth and body, and of cloth and cloth, all measured by what the
report measures with. The coarse panel's are those of the upsampled cage.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from benchmarks.sleeve import say
from physgraph_usd.contact.bodies import FrameBodies
from physgraph_usd.contact.broad_phase import Bodies
from physgraph_usd.contact.cloth import ClothContact
from physgraph_usd.contact.frame import FrameContact
from physgraph_usd.contact.settings import ContactSettings
from physgraph_usd.level import build_levels, refine_garments
from physgraph_usd.options import RefineOptions
from physgraph_usd.preview import label, surface_of
from physgraph_usd.raycast import View, draw, fit_view
from physgraph_usd.samples import write_sample
from physgraph_usd.scene import recentred
from physgraph_usd.shot import prepare_device, refine_shot
from physgraph_usd.usd.meshes import DrawnMesh, DrawnStage, refined_in
from physgraph_usd.usd.reader import open_shot

LEVEL, RUN_UP, PANEL = 2, 6, (560, 480)
"""Subdivisions, frames solved before the one drawn, and a panel's size [pixels]."""
FORMS = {
    "Elastic forces only": {"contact": "off", "self_contact": "off"},
    "With the body": {"self_contact": "off"},
    "With the body and itself": {},
}
"""Titles and options of the refined panels."""
NO_BODY = {"Elastic forces only": FORMS["Elastic forces only"], "With the other sheet and itself": {}}
MARKS = ((0.0, (0.62, 0.62, 0.60)), (0.5, (0.90, 0.62, 0.10)), (1.0, (0.75, 0.04, 0.03)))
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
        heat: Title of the panel that is drawn once more, as a heat map; none when empty.
    """

    time: float
    middle: tuple[float, float, float]
    size: tuple[float, float, float]
    camera: tuple[float, float]
    forms: dict[str, dict[str, str]]
    heat: str = ""


SHOWN = {
    "block": Shown(12.0, (0.02, 0.24, 0.0), (0.44, 0.30, 0.4), (40.0, 22.0), FORMS),
    "torus": Shown(20.0, (0.0, -0.05, 0.0), (0.34, 0.24, 0.34), (25.0, 30.0), FORMS),
    "armpit": Shown(15.0, (0.22, 0.33, 0.02), (0.24, 0.26, 0.2), (20.0, 0.0), FORMS),
    "layers": Shown(8.0, (0.02, 0.97, 0.05), (0.30, 0.26, 0.2), (30.0, 8.0), FORMS),
    "hood": Shown(12.0, (0.0, 0.15, -0.03), (0.30, 0.32, 0.3), (130.0, 12.0), FORMS),
    "crossing": Shown(6.0, (0.0, 0.86, 0.0), (0.4, 0.4, 0.3), (70.0, 5.0), NO_BODY, "With the other sheet and itself"),
}
"""The pictures by sample."""


def main() -> None:
    """Draw the pictures."""
    prepare_device("cpu")
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or SHOWN:
        with tempfile.TemporaryDirectory() as folder:
            say(str(picture(name, SHOWN[name], Path(folder), out / f"contact_{name}.png")))


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
        frames = (max(shown.time - RUN_UP, 1.0), shown.time)
        refine_shot(shot, layer, RefineOptions(frames=frames, level=LEVEL, heat_map=True, **options))
    garments = refined_in(layers[0])
    meshes = [DrawnStage(shot).meshes(shown.time)]
    meshes += [DrawnStage(shot, layer).meshes(shown.time) for layer in layers]
    titles = ["Coarse input", *shown.forms]
    notes = [_said(each) for each in measured(shot, shown.time, meshes[1:])]
    if shown.heat:
        which = titles.index(shown.heat)
        titles.append("What --heat-map writes for it")
        meshes.append(_heated(layers[which - 1], meshes[which], shown.time))
        notes.append(notes[which])
    for title, note in zip(titles, notes, strict=True):
        say(f"{name} {shown.time:g}, {title}: {', '.join(note)}")
    drawn = [_panel(each, garments, shown, lined=not place) for place, each in enumerate(meshes)]
    _save(out, drawn, titles, notes=notes)
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
    bodies = Bodies(scene.colliders, device="cpu", lanes=1)
    bodies.pose(frame.colliders)
    every = range(len(scene.colliders))
    parts = list(zip(scene.garments, frame.garments, strict=True))
    touching = bodies.touching(every, [[f.offset if i in g.colliders else None for i in every] for g, f in parts])
    world = np.concatenate([each.points for each in frame.garments])
    origin, settings = world.mean(axis=0), ContactSettings()
    coarse = torch.as_tensor(world - origin, dtype=torch.float32)
    touched = FrameBodies.begin(levels, touching, coarse, origin=origin, settings=settings) if touching else None
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


def _sums(said: dict[str, object], when: str) -> dict[str, int]:
    """The figures of a panel, summed over bodies; those of bodies are left out where there are none."""
    bodies, cloth = said.get("bodies"), said.get("cloth")
    assert isinstance(bodies, dict | None) and isinstance(cloth, dict | None)
    sums = {} if bodies is None else dict.fromkeys(("inside", "pinched", "body"), 0)
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


def _heated(layer: Path, meshes: Sequence[DrawnMesh], time: float) -> list[DrawnMesh]:
    """The meshes in the colours of their heat maps, where they have one."""
    from pxr import Usd, UsdGeom  # noqa: PLC0415

    stage = Usd.Stage.Open(str(layer))
    out = []
    for mesh in meshes:
        known = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(mesh.path))
        maps = [known.GetPrimvar(f"physgraph:{name}").Get(time) for name in ("penetration", "crossing")]
        if any(each is not None for each in maps):
            depth, crossing = (np.zeros(len(mesh.points)) if each is None else np.asarray(each) for each in maps)
            value = np.maximum(depth / DEEPEST, crossing)[mesh.triangles].max(axis=1).clip(0.0, 1.0)
            at, colors = zip(*MARKS, strict=True)
            shaded = np.stack([np.interp(value, at, channel) for channel in np.array(colors).T], axis=1)
            mesh = replace(mesh, colors=shaded)  # noqa: PLW2901
        out.append(mesh)
    return out


def _panel(meshes: Sequence[DrawnMesh], garments: Sequence[str], shown: Shown, *, lined: bool) -> np.ndarray:
    """One panel's pixels."""
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    box = np.array(shown.middle) + corners * shown.size
    view = fit_view(box, PANEL[0] / PANEL[1], azimuth=shown.camera[0], elevation=shown.camera[1])
    floor = min(float(mesh.points[:, 1].min()) for mesh in meshes) - 0.02
    return draw(_surfaces(meshes, garments, view, lined=lined), view, size=PANEL, floor=floor)


def _surfaces(meshes: Sequence[DrawnMesh], garments: Sequence[str], view: View, *, lined: bool) -> list:
    """The meshes ready to draw."""
    del view
    return [surface_of(mesh, lined=lined and mesh.path in garments) for mesh in meshes]


def _save(out: Path, drawn: Sequence[np.ndarray], titles: Sequence[str], *, notes: Sequence[Sequence[str]]) -> None:
    """Write panels in rows of two, labelled."""
    rows = -(-len(drawn) // 2)
    sheet = Image.new("RGB", (2 * PANEL[0], rows * PANEL[1]), "white")
    pen = ImageDraw.Draw(sheet)
    for place, pixels in enumerate(drawn):
        corner = (place % 2 * PANEL[0], place // 2 * PANEL[1])
        sheet.paste(Image.fromarray(pixels), corner)
        label(pen, corner, PANEL[1], lines=[titles[place], *notes[place]])
    sheet.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()
