"""Lists the files of a shot, and checks output paths: never over an input, never two results in one file."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdUtils

from ..errors import StageError, UsageError
from .provenance import is_only_ours, read_record
from .stage import USD_ERRORS, is_sound, quiet

LAYER_SUFFIXES = (".usd", ".usda", ".usdc")
"""Suffixes of written layers."""
_UDIM = "<UDIM>"

Target = tuple[str, Path]
"""A result's description, and its file."""


def files_of(shot: str | Path | Usd.Stage) -> set[Path]:
    """Every file of a shot, given as a file or an open stage, including files of unselected variants.

    The files are sublayers, references, payloads, value clips and assets such as textures, through all layers. Refined
    layers and their dependencies are left out: results are not read and may be overwritten. If USD cannot open the
    shot's file, the file itself is the only entry.

    Raises:
        StageError: A file is a pipe; USD would wait for ever.
    """
    files: set[Path] = set()
    if isinstance(shot, Usd.Stage):
        waiting = [layer.realPath for layer in shot.GetUsedLayers() if layer.realPath]
    else:
        waiting = [str(shot)]
    with quiet():
        while waiting:
            file = Path(Ar.SplitPackageRelativePathOuter(waiting.pop())[0])
            if file.is_fifo():
                raise StageError(f"{file} is no file: it is a pipe, which has no end")
            if file not in files and not (files and _is_result(file)):
                files.add(file)
                waiting += _named_in(file)
    return files


def _layer_of(file: Path) -> Sdf.Layer | None:
    """The layer in a file; None if USD cannot read the file."""
    try:
        layer = Sdf.Layer.FindOrOpen(str(file)) if Usd.Stage.IsSupportedFile(str(file)) and file.is_file() else None
        return layer if layer is not None and is_sound(layer) else None
    except (*USD_ERRORS, UnicodeDecodeError):
        return None


def _is_result(file: Path) -> bool:
    layer = _layer_of(file)
    if layer is None or not (read_record(layer) or {}).get("garments"):
        return False
    return is_only_ours(layer)


def _named_in(file: Path) -> Iterator[str]:
    """Files named by a layer, selected or not, as absolute paths."""
    layer = _layer_of(file)
    if layer is None:
        return
    try:
        names = list(chain(*UsdUtils.ExtractExternalReferences(str(file))))
    except USD_ERRORS:  # The file is damaged; the stage's reader reports the damage.
        return
    for name in names:
        path = Sdf.ComputeAssetPathRelativeToLayer(layer, name)
        if _UDIM in path:
            yield from glob.glob(glob.escape(path).replace(_UDIM, "[0-9]*"))
        else:
            yield str(Ar.GetResolver().Resolve(path)) or path


def check_targets(targets: Sequence[Target], inputs: Iterable[Path]) -> None:
    """Refuse (UsageError) to write over an input, or two results into one file; links are resolved."""
    read = {_identity(file): file for file in inputs}
    written: dict[object, str] = {}
    for result, path in targets:
        key = _identity(path)
        if key in read:
            same = "" if path == read[key] else f" ({read[key]})"
            raise UsageError(f"{result} {path} is part of the shot{same}; inputs are never edited, choose another name")
        if key in written:
            raise UsageError(f"{result} {path} is also {written[key]}; give each a name of its own")
        written[key] = result


def _identity(path: Path) -> object:
    """A key equal for two paths to the same file, whether the file exists or not."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # ValueError: a name with a null byte, in a damaged file.
        absolute = path.absolute()
        return (_identity(absolute.parent), absolute.name) if absolute.parent != absolute else absolute
    return status.st_dev, status.st_ino


def check_suffix(kind: str, path: Path, suffixes: Sequence[str]) -> None:
    """Refuse (UsageError) a file name with an unknown suffix."""
    if path.suffix not in suffixes:
        suffix = f"the suffix '{path.suffix}'" if path.suffix else "no suffix"
        raise UsageError(f"{kind} {path} has {suffix}; known suffixes: {', '.join(suffixes)}")
