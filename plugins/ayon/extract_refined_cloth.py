"""An AYON extractor: the refined cloth of an open stage as a representation. Tested under pyblish, with a
stand-in for ayon-core, which is not on PyPI.

Put it and the collector beside the publish plug-ins of the host's add-on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from ayon_core.pipeline import publish
from publish_hook import publish as refine_into

import physgraph_usd as pg


class ExtractRefinedCloth(publish.Extractor):
    """Refine the instance's stage into its staging folder."""

    label = "Extract Refined Cloth"
    families: ClassVar[list[str]] = ["physgraph.cloth"]

    def process(self, instance: Any) -> None:
        """Refine and add the layer to the representations."""
        options = pg.RefineOptions(**instance.data.get("physgraphOptions", {}))
        folder = Path(self.staging_dir(instance))
        for warning in refine_into(instance.data["usdStage"], folder / "cloth.usdc", options):
            self.log.warning(warning)
        made = {"name": "usd", "ext": "usdc", "files": "cloth.usdc", "stagingDir": str(folder)}
        instance.data.setdefault("representations", []).append(made)
