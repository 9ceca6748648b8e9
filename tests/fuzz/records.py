"""Records that lie: what says that it is ours and is not."""

from typing import Any

from pxr import Sdf

from .damage import NAN, ODD_INTS, WORDS
from .files import ALL
from .mutant import Draft, Kind

_ENTRIES = ("garments", "shot", "variants", "left_out", "failed", "chunks", "contents", "options", "inputs")


def _values(draft: Draft) -> Any:
    """Something that layer data holds."""
    return draft.pick(["", "/World/cloth", draft.pick(WORDS), draft.pick(ODD_INTS[:4]), NAN, True, {}, {"a": 1}])


def _forged(draft: Draft) -> None:
    """A record of ours, with any entries, in a layer that we did not write."""
    layer = Sdf.Layer.FindOrOpen(str(draft.pick(draft.files())))
    record: Any = {name: _values(draft) for name in _ENTRIES if draft.chance(0.6)}
    layer.customLayerData = {"physgraph": draft.pick([record, record, record, 1, "x", NAN])}
    layer.Save()
    draft.said.append(f"{layer.GetDisplayName()}: record {record}")


KINDS = (Kind("ours: forged record", _forged, ALL),)
