"""Pyblish plug-ins: collect the stage's garments, validate that they can be refined, extract the refined layer.

    pyblish.api.register_plugin_path(".../plugins/pyblish")

The host leaves the open stage in ``context.data["usdStage"]``, or its file in ``context.data["currentFile"]``; options
for `physgraph_usd.RefineOptions` may lie in ``context.data["physgraphOptions"]``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, ClassVar

import pyblish.api
from publish_hook import publish
from pxr import Usd

import physgraph_usd as pg

FAMILY = "physgraph.cloth"


class CollectGarments(pyblish.api.ContextPlugin):
    """Make one instance of the stage, if it has garments."""

    order = pyblish.api.CollectorOrder + 0.4
    label = "Collect Garments"

    def process(self, context: Any) -> None:
        """Find the garments as `inspect_shot` does."""
        stage = context.data.get("usdStage") or context.data.get("currentFile")
        if stage is None:
            self.log.info("there is no stage: set usdStage or currentFile")
            return
        found = pg.inspect_shot(stage, **context.data.get("physgraphOptions", {}))
        tagged = [mesh["path"] for mesh in found.get("meshes", ()) if mesh["garment"]]
        garments = [garment["path"] for garment in found.get("garments", ())] or tagged
        if not garments:
            self.log.info("no garment on the stage: %s", found.get("problem"))
            return
        instance = context.create_instance("cloth", family=FAMILY, families=[FAMILY], garments=garments)
        instance.data.update(stage=stage, problem=found.get("problem"), warnings=found["warnings"])


class ValidateGarments(pyblish.api.InstancePlugin):
    """Refuse garments that cannot be refined, with the prim, the time code and the remedy."""

    order = pyblish.api.ValidatorOrder
    label = "Validate Garments"
    families: ClassVar[list[str]] = [FAMILY]

    def process(self, instance: Any) -> None:
        """Fail with what `inspect_shot` found; its warnings go to the log."""
        for warning in instance.data["warnings"]:
            self.log.warning(warning)
        if instance.data["problem"]:
            raise pg.StageError(instance.data["problem"])


class ExtractRefinedCloth(pyblish.api.InstancePlugin):
    """Write the refined layer into the staging folder, ``instance.data["stagingDir"]``."""

    order = pyblish.api.ExtractorOrder
    label = "Extract Refined Cloth"
    families: ClassVar[list[str]] = [FAMILY]

    def process(self, instance: Any) -> None:
        """Refine; a failed frame or an invalid layer fails the publish."""
        options = pg.RefineOptions(**instance.context.data.get("physgraphOptions", {}))
        folder = Path(instance.data.get("stagingDir") or tempfile.mkdtemp())
        for warning in publish(_opened(instance.data["stage"]), folder / "cloth.usdc", options):
            self.log.warning(warning)
        instance.data.setdefault("files", []).append(str(folder / "cloth.usdc"))


def _opened(stage: Any) -> Any:
    """A stage; a file is opened."""
    return stage if isinstance(stage, Usd.Stage) else Usd.Stage.Open(str(stage))
