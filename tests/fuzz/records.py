"""Records that lie, and links where files are written: what says that it is ours and is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pxr import Sdf, UsdUtils

from physgraph_usd.shot.options import RefineOptions
from physgraph_usd.shot.refine import refine_shot

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


def _stitched(draft: Draft) -> None:
    """A result and its animation in one layer, as the shot, under it or where the run writes."""
    fine = draft.folder / "out.usdc"
    refine_shot(draft.shot, fine, RefineOptions(level=1, steps=2))
    both = Sdf.Layer.CreateAnonymous(".usda")
    both.TransferContent(Sdf.Layer.FindOrOpen(str(fine)))
    UsdUtils.StitchLayers(both, Sdf.Layer.FindOrOpen(str(draft.shot)))
    fine.unlink()
    how = draft.pick(["shot", "below", "target"])
    if how == "shot":
        both.Export(str(draft.shot))
    else:
        name = "out.usdc" if how == "target" else "both.usda"
        both.Export(str(draft.folder / name))
        draft.shot.write_text(f"#usda 1.0\n(subLayers = [@./{name}@])\n")
        Sdf.Layer.FindOrOpen(str(draft.shot)).Reload(True)
    draft.options["overwrite"] = True
    draft.said.append(f"a result is stitched to the animation: {how}")


def _links(draft: Draft) -> None:
    """Links where the run writes, to a file of the artist's, to the shot or to nothing; and frames of somebody else."""
    mine, folder = draft.folder / "mine.txt", draft.folder / "out.usdc.frames"
    mine.write_text("mine")
    leads: Path = draft.pick([mine, draft.shot, draft.folder / "nothing"])
    where = draft.pick(["out.usdc", "out.root.usda", "report.json", "run.lock", "run.json", "0.npz", "folder", "other"])
    if where in {"run.lock", "run.json", "0.npz"}:
        folder.mkdir()
        (folder / where).symlink_to(leads)
    elif where == "folder":
        folder.symlink_to(draft.folder)
    elif where == "other":
        folder.mkdir()
        (folder / "run.json").write_text("{}")
        (folder / "notes.npz").write_text("mine")
    else:
        (draft.folder / where).symlink_to(leads)
        draft.options |= {"root": draft.folder / "out.root.usda"} if "root" in where else {}
        draft.options |= {"report": draft.folder / "report.json"} if "report" in where else {}
    draft.options["overwrite"] = draft.chance(0.7)
    draft.said.append(f"{where} is a link to {leads.name}")


KINDS = (
    Kind("ours: forged record", _forged, ALL),
    Kind("ours: stitched", _stitched, ("plain", "several", "bodies")),
    Kind("ours: links", _links, ("plain", "still")),
)
