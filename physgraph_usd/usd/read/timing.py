"""Compares samples of garments and bodies: USD holds a prim still outside the prim's samples."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...errors import counted, named_time
from ..instances import mover
from ..stage import GarmentSource, Notice
from ..times import SAME_TIME, is_among, transform_chain
from .bodies import ColliderReader, authored_points
from .skinning import Bake


def timing_notices(
    garments: Sequence[tuple[Usd.Prim, GarmentSource]],
    bodies: Sequence[tuple[ColliderReader, Sequence[int]]],
    bake: Bake,
) -> list[Notice]:
    """One notice for each prim with mismatched sample times.

    Args:
        garments: Mesh prims and their sources.
        bodies: Readers of bodies, and for each the numbers of the garments in contact.
        bake: Baked skinning.
    """
    rates_of: dict[Sdf.Path, list[str]] = {prim.GetPath(): _rates(prim, bake) for prim, _ in garments}
    for body, felt_by in bodies:
        faults = [fault for number in felt_by for fault in _misses(body, garments[number][1], bake)]
        rates_of[body.prim.GetPath()] = [*faults[:1], *_rates(body.prim, bake)]
    return [Notice(str(path), None, "; ".join(faults)) for path, faults in rates_of.items() if faults]


def _misses(reader: ColliderReader, garment: GarmentSource, bake: Bake) -> Iterator[str]:
    """Faults of a body's sample times compared with a garment's, in words."""
    body = reader.prim
    body_times = bake.motion(mover(body.GetStage(), body.GetPath(), garment.path)).times
    cloth, every = garment.times, tuple(sorted([*garment.times, *garment.left_out]))
    if not cloth and UsdGeom.PointBased(body) and UsdGeom.PointBased(body).GetPointsAttr().Get() is None and body_times:
        first = named_time(body_times[0])
        yield f"has no points by default, at which still garments are read; its sample at {first} is used"
    if len(body_times) < 2 or not cloth:
        return
    first, last = ([named_time(times[end]) for times in (body_times, every)] for end in (0, -1))
    spans = f"its samples run from {first[0]} to {last[0]}, those of <{garment.path}> from {first[1]} to {last[1]}"
    late, early = body_times[0] - cloth[0] > SAME_TIME, cloth[-1] - body_times[-1] > SAME_TIME
    still = " and ".join([f"before {first[0]}"] * late + [f"after {last[0]}"] * early)
    stillness = f"; it stands still {still}" if still else "; its poses are interpolated"
    remedy = f"; export its samples at the time codes from {named_time(cloth[0])} to {named_time(cloth[-1])}"
    unsolved = [time for time in body_times if cloth[0] < time < cloth[-1] and not is_among(time, cloth)]
    if not any(is_among(time, every) for time in body_times):
        yield f"{spans}, and share no time{stillness}{remedy}"
    elif still:
        yield f"{spans}{stillness}{remedy}"
    elif any(_is_off_line(reader, time, cloth) for time in unsolved):
        message = f"has {counted(len(unsolved), 'sample')} at time codes at which <{garment.path}> is not solved"
        yield f"{message}, the first at {named_time(unsolved[0])}; sample the garment there, too"


def _is_off_line(body: ColliderReader, time: float, cloth: Sequence[float]) -> bool:
    """Whether a body leaves the straight line between the two solved time codes around a time code, by `within`."""
    number = bisect_left(cloth, time)
    before, after = cloth[number - 1], cloth[number]
    first, middle, last = (authored_points(body, code) for code in (before, time, after))
    if not len(middle) == len(first) == len(last):
        return True
    share = (time - before) / (after - before)
    away = np.linalg.norm(middle - (1.0 - share) * first - share * last, axis=1)
    return not bool((away <= body.within).all())


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
    attributes = [prim.GetAttribute("points")] if UsdGeom.PointBased(prim) else []
    attributes += [op.GetAttr() for transform in transform_chain(prim) for op in transform.GetOrderedXformOps()]
    attributes += animation.GetAuthoredAttributes() if animation else []
    for attribute in attributes:
        for spec in attribute.GetPropertyStack():
            if spec.layer.ListTimeSamplesForPath(spec.path):
                yield spec.layer
