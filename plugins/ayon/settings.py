"""The server's half of the AYON add-on ``physgraph``: what a studio sets. Not tested: ayon-server is not on PyPI.

The names below ``publish`` are those of the plug-ins, and their fields are the plug-ins' attributes.
"""

from __future__ import annotations

from ayon_server.settings import BaseSettingsModel, SettingsField


class CollectRefinedClothModel(BaseSettingsModel):
    """What the collector makes instances with."""

    enabled: bool = SettingsField(True, title="Enabled")
    product_name: str = SettingsField("usdCloth", title="Product name")
    garments: list[str] = SettingsField(default_factory=list, title="Garments; none takes those that are tagged")
    colliders: list[str] = SettingsField(default_factory=list, title="Bodies; none takes those that are tagged")
    level: str = SettingsField("", title="Subdivisions, or auto; none takes each garment's own")


class PublishModel(BaseSettingsModel):
    """Settings of the publish plug-ins."""

    CollectRefinedCloth: CollectRefinedClothModel = SettingsField(default_factory=CollectRefinedClothModel)


class PhysGraphSettings(BaseSettingsModel):
    """Settings of the add-on."""

    publish: PublishModel = SettingsField(default_factory=PublishModel)
