"""Compares samples of garments and their bodies: USD holds a prim still outside its samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pxr import Sdf, Usd, UsdGeom

from ..stage import GarmentSource, Notice
from ..times import SAME_TIME, garment_times, merge, transform_chain, transform_times
from .instances import instance_times
from .skinning import Bake


def timing_notices(
    garments: Sequence[tuple[Usd.Prim, GarmentSource]], bodies: Sequence[tuple[Usd.Prim, Sequence[int]]], bake: Bake
) -> list[Notice]:
    """One notice for each prim with mismatched sample times.

    Args:
        garments: Mesh prims and their sources.
        bodies: Prims of bodies, and for each the numbers of the garments in contact.
        bake: Baked skinning.
    """
    found: dict[Sdf.Path, list[str]] = {prim.GetPath(): _rates(prim, bake) for prim, _ in garments}
    for prim, felt_by in bodies:
        faults = [fault for number in felt_by for fault in _misses(prim, garments[number][1], bake)]
        found[prim.GetPath()] = [*faults[:1], *_rates(prim, bake)]
    return [Notice(str(path), None, "; ".join(faults)) for path, faults in found.items() if faults]


def _misses(body: Usd.Prim, garment: GarmentSource, bake: Bake) -> Iterator[str]:
    """Faults of a body's sample times compared with a garment's, in words."""
    own, cloth = _own_times(body, bake), garment.times
    if not cloth and UsdGeom.Mesh(body) and UsdGeom.Mesh(body).GetPointsAttr().Get() is None and own:
        yield f"has no points by default, at which still garments are read; its sample at {own[0]:g} is used"
    if len(own) < 2 or not cloth:
        return
    spans = f"its samples run from {own[0]:g} to {own[-1]:g}, those of <{garment.path}> from {cloth[0]:g} to"
    spans = f"{spans} {cloth[-1]:g}"
    late, early = own[0] - cloth[0] > SAME_TIME, cloth[-1] - own[-1] > SAME_TIME
    still = " and ".join([f"before {own[0]:g}"] * late + [f"after {own[-1]:g}"] * early)
    held = f"; it stands still {still}" if still else "; its poses are interpolated"
    if len(merge([*own, *cloth])) == len(own) + len(cloth):
        yield f"{spans}, and share no time{held}"
    elif still:
        yield f"{spans}{held}"


def _own_times(prim: Usd.Prim, bake: Bake) -> tuple[float, ...]:
    """All authored time codes of a body; a skinned body has its skeleton's."""
    skinned = bake.skinned.get(prim.GetPath())
    if skinned:
        return merge([*skinned.times, *transform_times(prim)])
    if UsdGeom.PointInstancer(prim):
        return instance_times(prim)
    return garment_times(prim) if UsdGeom.Mesh(prim) else merge(transform_times(prim))


def _rates(prim: Usd.Prim, bake: Bake) -> list[str]:
    """A sentence for each layer with samples of a prim and a rate different from the stage's."""
    stage = prim.GetStage()
    root, rate = stage.GetRootLayer(), stage.GetTimeCodesPerSecond()
    layers = dict.fromkeys(layer for layer in _layers(prim, bake) if layer.timeCodesPerSecond != rate)
    return [f"{_rate_of(layer)}, {_rate_of(root)}: USD moves its samples in time to fit" for layer in layers]


def _rate_of(layer: Sdf.Layer) -> str:
    authored = layer.HasTimeCodesPerSecond() or layer.HasFramesPerSecond()
    rate = f"{layer.timeCodesPerSecond:g} time codes per second"
    return f"@{layer.GetDisplayName()}@ has {rate if authored else f'no rate, which counts as {rate}'}"


def _layers(prim: Usd.Prim, bake: Bake) -> Iterator[Sdf.Layer]:
    """Layers with samples of a prim's points, transforms and skeletal animation."""
    skinned = bake.skinned.get(prim.GetPath())
    animation = prim.GetStage().GetPrimAtPath(skinned.animation) if skinned and skinned.animation else None
    attributes = [prim.GetAttribute("points")] if UsdGeom.Mesh(prim) else []
    attributes += [op.GetAttr() for transform in transform_chain(prim) for op in transform.GetOrderedXformOps()]
    attributes += animation.GetAuthoredAttributes() if animation else []
    for attribute in attributes:
        for spec in attribute.GetPropertyStack():
            if spec.layer.ListTimeSamplesForPath(spec.path):
                yield spec.layer
