#!/usr/bin/env bash
# Library: usd-core 25.5.1 (UsdValidation), beside 25.8
#
# Expected: a validator that the registry of an installed package lists can be loaded, and a context of all of them
# validates a stage.
#
# Seen: the wheels of 25.2 to 25.5.1 hold the descriptions of the validators and not their libraries. The registry lists
# 24, and loading 22 of them raises an error; so does the first Validate of a context of all, whatever the stage is.
#
#   usd-core 25.5.1: 24 validators listed, 22 cannot be loaded; a context of all of them raises an error
#   usd-core 25.8:   24 validators listed, 0 cannot be loaded; a context of all of them finds 0 errors
#
# Why it matters: a publish step that validates with what the registry lists refuses every stage with these versions, or,
# if it swallows the errors, checks almost nothing of skins, subsets and stage metadata.
#
# Workaround: 25.8 or later; before, load validators one by one and say which did not load.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
cat > "$tmp/count.py" <<'PY'
import sys

from pxr import Tf, Usd, UsdGeom, UsdValidation

registry = UsdValidation.ValidationRegistry()
listed = registry.GetAllValidatorMetadata()
broken = 0
for metadata in listed:
    try:
        registry.GetOrLoadValidatorByName(metadata.name)
    except Tf.ErrorException:
        broken += 1
stage = Usd.Stage.CreateInMemory()
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
UsdGeom.SetStageMetersPerUnit(stage, 1)
stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
try:
    names = [metadata.name for metadata in listed if not metadata.isSuite]
    errors = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names)).Validate(stage)
    words = f"finds {len(errors)} errors"
except Tf.ErrorException:
    words = "raises an error"
text = f"{len(listed)} validators listed, {broken} cannot be loaded; a context of all of them {words}"
print(text)
sys.exit(text != sys.argv[1])
PY
check() {
    python3 -m venv "$tmp/$1"
    "$tmp/$1/bin/pip" install -q "usd-core==$1"
    printf 'usd-core %s: ' "$1"
    "$tmp/$1/bin/python" "$tmp/count.py" "$2" 2>/dev/null
}
check 25.5.1 "24 validators listed, 22 cannot be loaded; a context of all of them raises an error"
check 25.8 "24 validators listed, 0 cannot be loaded; a context of all of them finds 0 errors"
