"""The variant selections that a layer was made under.

What a refined layer authors at a garment's own path is a local opinion, and local opinions are stronger than variants:
whatever is selected over the layer, it shows the garment of the selections that were in force when it was made.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ..check.rules import Problem
from ..lookup import bound_materials, with_ancestors
from ..provenance import mute_refined, read_record
from ..view import StageView

_CLOTH = ("faceVertexCounts", "faceVertexIndices", "points")


def selections(prims: Iterable[Usd.Prim]) -> tuple[str, ...]:
    """Variant selections in force on prims, above them and on their materials.

    Args:
        prims: Garments, colliders, skeletons: whatever the result depends on.

    Returns:
        Paths such as ``/World/coat{fit=loose}``, sorted; a set with nothing selected has an empty selection.
    """
    found = set()
    for prim in prims:
        for each in (other for start in (prim, *bound_materials(prim)) for other in with_ancestors(start)):
            sets = each.GetVariantSets()
            path = each.GetPath()
            found |= {path.AppendVariantSelection(name, sets.GetVariantSelection(name)) for name in sets.GetNames()}
    return tuple(sorted(str(path) for path in found))


def recorded(layer: Sdf.Layer) -> list[Sdf.Path]:
    """The selections that a layer's record names."""
    return [Sdf.Path(text) for text in (read_record(layer) or {}).get("variants", ())]


def same_variants(layer: Sdf.Layer, shot: StageView, garments: Sequence[str]) -> Iterator[Problem]:
    """The shot selects what the layer was made under; another selection's cloth must be refined by itself.

    Args:
        layer: The refined layer.
        shot: The shot.
        garments: Paths of the coarse meshes.

    Yields:
        An error where the shot's own cloth is another one now, else a warning.
    """
    wanted = recorded(layer)
    mask = Usd.StagePopulationMask([*garments, *dict.fromkeys(path.GetPrimPath() for path in wanted)])
    now = _coarse(shot, mask, ()) if wanted else None
    changed = {path: _selected(now, path) for path in wanted if now and _selected(now, path) != path}
    then = _coarse(shot, mask, tuple(changed)) if changed else None
    others = [path for path in garments if then and now and _cloth(now, path) != _cloth(then, path)]
    for path, selected in changed.items():
        said = f"was refined with {_words(path)} and shows that; the shot has {_words(selected)} now"
        if others:
            differ = (
                f", where {', '.join(f'<{other}>' for other in others)} is another mesh; refine it into its own layer"
            )
            yield Problem("error", str(path.GetPrimPath()), None, said + differ, "")
        else:
            yield Problem("warning", str(path.GetPrimPath()), None, f"{said}; the garments' meshes are the same", "")


def _coarse(shot: StageView, mask: Usd.StagePopulationMask, wanted: Sequence[Sdf.Path]) -> Usd.Stage:
    """A shot without refined layers, with variants selected."""
    selected = Sdf.Layer.CreateAnonymous("selections.usda")
    for path in wanted:
        name, selection = path.GetVariantSelection()
        Sdf.CreatePrimInLayer(selected, path.GetPrimPath()).variantSelections[name] = selection
    stage = shot.open(over=[selected], mask=mask)
    mute_refined(stage)
    return stage


def _selected(stage: Usd.Stage, path: Sdf.Path) -> Sdf.Path:
    """A selection's path with what a stage selects in its place."""
    name, _ = path.GetVariantSelection()
    prim = stage.GetPrimAtPath(path.GetPrimPath())
    return path.GetPrimPath().AppendVariantSelection(
        name, prim.GetVariantSet(name).GetVariantSelection() if prim else ""
    )


def _words(path: Sdf.Path) -> str:
    """A selection as in ``fit=loose``."""
    name, selection = path.GetVariantSelection()
    return f"{name}={selection or 'nothing'}"


def _cloth(stage: Usd.Stage, path: str) -> list[bytes | None]:
    """Topology and points of a mesh, at the default and at its first, middle and last sample, to be compared."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    if not mesh:
        return []
    times = mesh.GetPointsAttr().GetTimeSamples()
    codes = [
        Usd.TimeCode.Default(),
        *(Usd.TimeCode(t) for t in {*times[:1], *times[len(times) // 2 :][:1], *times[-1:]}),
    ]
    values = [mesh.GetPrim().GetAttribute(name).Get(code) for name in _CLOTH for code in codes]
    return [None if value is None else np.asarray(value).tobytes() for value in values]
