#!/usr/bin/env bash
# Library: usd-core 26.11 and 24.11 (Sdf)
#
# Expected: what GetInfo of a spec returns can be given to SetInfo of the same spec, as holds for customData or references.
#
# Seen: GetInfo("timeSamples") returns a dict of values by time code, and SetInfo of that very dict raises TypeError
# ("Invalid type for key"), for any keys. The names of sublayers can be read and not set back either, and reading their
# offsets raises an error.
#
#   timeSamples is read and not set back; subLayers is read and not set back; subLayerOffsets is not read; customData is
#   read and set back; references is read and set back
#
# Why it matters: a tool that keeps an attribute's samples, edits the layer and puts them back fails at the last line,
# after the samples are gone.
#
# Workaround: EraseTimeSample and SetTimeSample, one time code after the other, in an Sdf.ChangeBlock.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
cat > "$tmp/set_back.py" <<'PY'
import sys

from pxr import Sdf, Usd  # noqa: F401 (24.11 opens layers only once Usd is loaded)

layer = Sdf.Layer.CreateAnonymous(".usda")
prim = Sdf.CreatePrimInLayer(layer, "/World")
attribute = Sdf.AttributeSpec(prim, "width", Sdf.ValueTypeNames.Float)
for time in (1.0, 2.0):
    layer.SetTimeSample(attribute.path, time, 3.0 * time)
layer.subLayerPaths.append("below.usda")
prim.customData = {"source": "a"}
prim.referenceList.Prepend(Sdf.Reference("asset.usda"))
told = []
for spec, key in (
    (attribute, "timeSamples"),
    (layer.pseudoRoot, "subLayers"),
    (layer.pseudoRoot, "subLayerOffsets"),
    (prim, "customData"),
    (prim, "references"),
):
    try:
        value = spec.GetInfo(key)
    except TypeError:
        told.append(f"{key} is not read")
        continue
    try:
        spec.SetInfo(key, value)
        told.append(f"{key} is read and set back")
    except TypeError:
        told.append(f"{key} is read and not set back")
text = "; ".join(told)
print(text)
sys.exit(text != sys.argv[1])
PY
seen="timeSamples is read and not set back; subLayers is read and not set back; subLayerOffsets is not read; "
seen+="customData is read and set back; references is read and set back"
for version in 26.11 24.11; do
    python3 -m venv "$tmp/$version"
    "$tmp/$version/bin/pip" install -q "usd-core==$version"
    printf 'usd-core %s: ' "$version"
    "$tmp/$version/bin/python" "$tmp/set_back.py" "$seen"
done
