"""What each garment is kept apart from, by ``physgraph:contact:exclude``: a hand in a pocket, a belt under a loop."""

from __future__ import annotations

from collections.abc import Sequence

from pxr import Sdf, Usd, UsdGeom

from ...errors import StageError
from ..stage import Notice
from .find import find_paths, targets_of

EXCLUDE = "physgraph:contact:exclude"


def read_apart(stage: Usd.Stage, garments: Sequence[Usd.Prim]) -> tuple[list[dict[Sdf.Path, str]], list[Notice]]:
    """Read what garments are kept apart from.

    Two garments are apart when either says so. A garment is never apart from itself: that is selfCollision's.

    Args:
        stage: The stage.
        garments: The garments.

    Returns:
        For each garment, the gprims that it does not touch, each with what says so; and a notice for each target that
        is not there.
    """
    found, notices = [], []
    for prim in garments:
        own, odd = _named(stage, prim)
        found.append(own)
        notices += odd
    numbers = {prim.GetPath(): index for index, prim in enumerate(garments)}
    for (place, _), own in zip(numbers.items(), found, strict=True):
        own.pop(place, None)
        for path in [path for path in own if path in numbers]:
            found[numbers[path]].setdefault(place, own[path])
    return found, notices


def _named(stage: Usd.Stage, prim: Usd.Prim) -> tuple[dict[Sdf.Path, str], list[Notice]]:
    """Gprims at and below the targets of one garment, and by which target."""
    found: dict[Sdf.Path, str] = {}
    notices = []
    said = f"<{prim.GetPath()}>.{EXCLUDE}"
    for target in targets_of(prim, EXCLUDE):
        try:
            paths = find_paths(stage, str(target), UsdGeom.Gprim)
        except StageError as error:
            notices.append(Notice(str(prim.GetPath()), None, f"{EXCLUDE} excludes nothing by <{target}>: {error}"))
            continue
        for path in paths:
            found.setdefault(path, said if path == target else f"{said} = <{target}>")
    return found, notices
