"""Finds time codes at which a prim has no shape, with the reason: shapes of different times are never substituted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pxr import Usd, UsdGeom

from ...errors import counted, named_time
from ..lookup import with_ancestors
from ..stage import Notice, timecode
from ..times import FrameGrid, is_animated, transform_chain
from .placement import flattened

_SHAPE = ("points", "faceVertexCounts", "faceVertexIndices", "tetVertexIndices")
_INVISIBLE = "it is invisible"
_MOST_NAMED = 3
"""Most time codes named in a notice."""


@dataclass(frozen=True)
class Samples:
    """Time codes of a garment.

    Attributes:
        times: Time codes with a shape that is visible, ascending.
        absent: All others, ascending, with the reason in words.
        hidden: Absent time codes of an invisible garment.
        own: Time codes with a shape that the garment itself has samples at, ascending.
    """

    times: tuple[float, ...] = ()
    absent: Mapping[float, str] = field(default_factory=dict)
    own: tuple[float, ...] = ()
    hidden: frozenset[float] = frozenset()

    @staticmethod
    def of(prim: Usd.Prim, times: Iterable[float], own: Iterable[float] = ()) -> Samples:
        """Sort the time codes of a garment's mesh prim, including the garment's samples."""
        times = [*times]
        hidden = hidden_at(prim, times)
        reasons = {time: _INVISIBLE if time in hidden else absence(prim, time) for time in times}
        present = tuple(time for time, reason in reasons.items() if not reason)
        absent = {time: reason for time, reason in reasons.items() if reason}
        return Samples(present, absent, tuple(time for time in own if time in present), hidden)

    def notices(self, path: str, times: Sequence[float]) -> list[Notice]:
        """Notices of the garment's absences among some time codes, one for each reason but invisibility."""
        notices = []
        for reason in dict.fromkeys(self.absent[time] for time in times if time not in self.hidden):
            named = named_times([time for time in times if self.absent[time] == reason])
            message = f"is not there at {named}: {reason}; left out, and blocked in the layer"
            notices.append(Notice(path, None, message))
        return notices


def hidden_at(prim: Usd.Prim, times: Sequence[float]) -> frozenset[float]:
    """Time codes of a garment's samples, ascending, not shown in any picture: the garment is invisible.

    Shown is also an invisible sample beside a whole frame at which the garment is visible: it interpolates between
    them. A garment that is invisible at all of them hides none: it was named to be refined all the same.
    """
    if not times or not visibility_varies(prim):
        return frozenset()
    stage, imageable = prim.GetStage(), UsdGeom.Imageable(prim)
    frames = FrameGrid.of(stage)
    spans = [*pairwise(times)]
    spans.insert(0, (min(times[0], stage.GetStartTimeCode()) - frames.length, times[0]))
    spans.append((times[-1], max(times[-1], stage.GetEndTimeCode()) + frames.length))

    def is_visible(time: float) -> bool:
        return imageable.ComputeVisibility(Usd.TimeCode(time)) != UsdGeom.Tokens.invisible

    visible = [is_visible(time) for time in times]
    beside = pairwise(any(map(is_visible, frames.inside(*span))) for span in spans)
    drawn = [is_visible or any(neighbours) for is_visible, neighbours in zip(visible, beside, strict=True)]
    return frozenset(time for time, is_shown in zip(times, drawn, strict=True) if not is_shown and any(drawn))


def visibility_varies(prim: Usd.Prim) -> bool:
    """Whether the visibility of a prim or of a prim above it may change in time."""
    shapes = map(UsdGeom.Imageable, with_ancestors(prim))
    return any(shape and shape.GetVisibilityAttr().ValueMightBeTimeVarying() for shape in shapes)


def absence(prim: Usd.Prim, time: float) -> str:
    """Why a garment's mesh has no shape at a time code, in words; "" for a mesh with a shape.

    Either a value is missing (`missing_value`), or the transform to the world scales the mesh to nothing or flat.
    """
    matrix = np.array(UsdGeom.XformCache(timecode(time)).GetLocalToWorldTransform(prim), dtype=np.float64).T
    return missing_value(prim, time) or flattened(matrix)


def missing_value(prim: Usd.Prim, time: float) -> str:
    """Name the missing part of a prim's shape or transforms at a time code; "" for none.

    A value is missing if blocked. An empty array counts as missing for a mesh not empty at all times.
    """
    code = timecode(time)
    for name in _SHAPE if UsdGeom.PointBased(prim) else ():
        attribute = prim.GetAttribute(name)
        if attribute and attribute.GetNumTimeSamples() and not (value := attribute.Get(code)):
            return f"its {name} {'have no value' if value is None else 'are empty'}"
    for transform in transform_chain(prim):
        for op in transform.GetOrderedXformOps():
            attribute = op.GetAttr()
            if is_animated(attribute) and attribute.Get(code) is None:
                return f"{attribute.GetName()} of <{transform.GetPath()}> has no value"
    return ""


def named_times(times: Sequence[float]) -> str:
    """Time codes in words, the first few of many."""
    names = [*map(named_time, times)]
    if len(names) == 1:
        return f"time code {names[0]}"
    if len(names) > _MOST_NAMED:
        return f"time codes {', '.join(names[:_MOST_NAMED])} and {counted(len(names) - _MOST_NAMED, 'other')}"
    return f"time codes {', '.join(names[:-1])} and {names[-1]}"
