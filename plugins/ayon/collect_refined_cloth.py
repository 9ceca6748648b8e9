"""An AYON collector: one instance of refined cloth where the stage has garments. Tested under pyblish, not in AYON.

The host's integration sets the stage before it, in ``context.data["usdStage"]``; else the file of the scene is opened
where it is a USD file. AYON sets the class's attributes from the studio's settings, whose half is `settings`.
"""

from __future__ import annotations

from typing import Any, ClassVar

import pyblish.api
from pxr import Usd

import physgraph_usd as pg

FAMILY = "physgraph.cloth"
OF_THE_CONTEXT = ("folderPath", "task", "frameStart", "frameEnd", "fps")
"""What AYON's integrator wants of each instance, and its context has."""


class CollectRefinedCloth(pyblish.api.ContextPlugin):
    """Make one instance of the stage, with the options to refine it with."""

    order = pyblish.api.CollectorOrder + 0.4
    label = "Collect Refined Cloth"
    settings_category = "physgraph"
    enabled = True
    product_name = "usdCloth"
    garments: ClassVar[list[str]] = []
    colliders: ClassVar[list[str]] = []
    level = ""

    def process(self, context: Any) -> None:
        """Find the garments as `inspect_shot` does."""
        stage = _stage_of(context)
        if stage is None:
            self.log.info('no stage: the host\'s integration sets context.data["usdStage"]')
            return
        level = {} if self.level == "" else {"level": -1 if self.level == "auto" else int(self.level)}
        options = {"garments": tuple(self.garments), "colliders": tuple(self.colliders)} | level
        found = pg.inspect_shot(stage, **options)
        garments = [garment["path"] for garment in found.get("garments", ())]
        if not garments:
            self.log.info("nothing to refine on the stage: %s", found.get("problem"))
            return
        instance = context.create_instance(self.product_name, family=FAMILY, families=[FAMILY, "usd"])
        instance.data.update({name: context.data[name] for name in OF_THE_CONTEXT if name in context.data})
        instance.data.update(productType="usd", productName=self.product_name, variant="Cloth", publish=True)
        instance.data.update(usdStage=stage, physgraphOptions=options, garments=garments)


def _stage_of(context: Any) -> Usd.Stage | None:
    """The stage that the host's integration set, or that of the scene's own file."""
    file = str(context.data.get("currentFile") or "")
    stage = context.data.get("usdStage")
    return Usd.Stage.Open(file) if stage is None and Usd.Stage.IsSupportedFile(file) else stage
