"""One trip of a USD file through Blender with the add-on: `python blender_round_trip.py EXTENSIONS IN OUT EDITS`.

EDITS is JSON: custom properties to set, or to delete where null, by object or material. OUT.json gets what there was.
"""

import json
import os
import sys
from pathlib import Path

os.environ["BLENDER_USER_RESOURCES"] = os.environ["BLENDER_USER_EXTENSIONS"] = sys.argv[1]
import bpy  # pyright: ignore[reportMissingImports]  the folders come first

_, _, shot, out, edits = sys.argv
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="bl_ext.user_default.physgraph_usd")
bpy.ops.wm.usd_import(filepath=shot)
there = {item.name: dict(item.items()) for item in (*bpy.data.objects, *bpy.data.materials)}
there = {name: {key: value for key, value in item.items() if ":" in key} for name, item in there.items()}
Path(f"{out}.json").write_text(json.dumps(there))
for name, values in json.loads(edits).items():
    item = bpy.data.objects.get(name) or bpy.data.materials[name]
    for key, value in values.items():
        if value is None:
            del item[key]
        else:
            item[key] = value
bpy.ops.wm.save_as_mainfile(filepath=f"{out}.blend")
bpy.ops.wm.open_mainfile(filepath=f"{out}.blend")
bpy.ops.wm.usd_export(filepath=out, export_animation=True)
bpy.ops.preferences.addon_disable(module="bl_ext.user_default.physgraph_usd")
