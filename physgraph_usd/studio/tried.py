"""Reads a shot with an artist's setting, and saves the setting as a layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..shot.findings.untagged import AUTO, open_with_colliders
from ..usd.read.garment import read_painted
from ..usd.read.reader import Shot, open_shot
from ..usd.read.subsets import SCALED
from ..usd.schema import GARMENT
from ..usd.write.paint import painted_layer
from ..usd.write.tag import tag
from .setting import Setting


class TriedShot:
    """A shot file, read with different settings; the file is never edited.

    Attributes:
        opened: The shot as authored.
        named: Garments, colliders and targets as commands take them, by the names of `open_shot`'s options.
    """

    def __init__(
        self, shot: str | Path, *, garments: Sequence[str], colliders: Sequence[str], bind: Sequence[str]
    ) -> None:
        """Open a shot; arguments are those of `TuneSession`.

        Raises:
            StageError: The shot cannot be read.
        """
        self.opened = open_with_colliders(shot, garments=garments, colliders=colliders, bind=bind)
        _ = self.opened.targets  # Refused here, not while a picture is drawn.
        named = self.opened.colliders if AUTO in colliders else tuple(colliders)
        self.named: dict[str, Any] = {"garments": tuple(garments), "colliders": named, "bind": tuple(bind)}
        # Maps, the shot read with them, and their layer, which the stage does not keep.
        self._painted: tuple[object, Shot, object] = ({}, self.opened, None)

    def close(self) -> None:
        """Let go of the stages."""
        for shot in {id(each): each for each in (self.opened, self._painted[1])}.values():
            shot.close()

    def read(self, setting: Setting) -> Shot:
        """The shot with a setting.

        Raises:
            UsageError: A value cannot be used.
            SchemaError: A painted value is outside its limits.
        """
        texts = [
            f"{path}.{GARMENT[name].name}={value!r}"
            for path, values in setting.values.items()
            for name, value in values.items()
        ]
        return self._with_maps(setting.painted).with_values(texts)

    def painted(self, setting: Setting, index: int, name: str) -> np.ndarray:
        """A painted map of a garment, by number, on the vertices of its cage, shape (V,)."""
        source = self.opened.sources[index]
        values = setting.map_of(str(source.path), name)
        if values is None:
            prim = self.opened.stage.GetPrimAtPath(source.path)
            values = source.weld.joined(read_painted(prim, name, source.weld.apart.vertex_count)[0])
        return values

    def save(self, setting: Setting, out: Path, *, overwrite: bool) -> Path:
        """Write a layer over the shot with a setting's values and maps, as `tag` does.

        Raises:
            UsageError: The layer's name is one of the shot's files, or its suffix is unknown.
            StageError: A garment lies in an instance.
            LayerError: It cannot be written.
        """
        values = {**setting.values, **self._of_subsets(setting.values)}
        painted = self._authored(setting.painted)
        return tag(self.opened.path, out, **self._found, values=values, painted=painted, overwrite=overwrite)

    @property
    def _found(self) -> dict[str, Any]:
        """`named` with the garments that were found."""
        return self.named | {"garments": [str(source.path) for source in self.opened.sources]}

    def _of_subsets(self, values: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
        """The values of subsets of other fabrics, in proportion to their garments', by prim path."""
        found = dict[str, dict[str, float]]()
        for garment, source in ((reader.garment, reader.source) for reader in self.opened.readers):
            tried, scale = values.get(garment.path, {}), garment.fabric_scale
            if scale is not None:
                for name in filter(None, source.fabrics):
                    ratios = dict(zip(SCALED, scale[source.subsets[name][0]].tolist(), strict=True))
                    path = str(source.path.AppendChild(name))
                    found[path] = {short: tried[short] * ratios[short] for short in tried.keys() & ratios.keys()}
        return found

    def _authored(self, painted: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
        """Maps of the cages' vertices on the authored points."""
        welds = {str(source.path): source.weld for source in self.opened.sources}
        return {
            path: {name: welds[path].split(values) for name, values in maps.items()} for path, maps in painted.items()
        }

    def _with_maps(self, painted: Mapping[str, Mapping[str, np.ndarray]]) -> Shot:
        if not painted:
            return self.opened
        if self._painted[0] is not painted:
            layer = painted_layer(self.opened.stage, self._authored(painted))
            shot = open_shot(self.opened.view.open(over=[layer]), **self._found)
            self._painted = painted, shot, layer
        return self._painted[1]
