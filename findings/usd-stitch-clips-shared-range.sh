#!/usr/bin/env bash
# Library: usd-core 26.11 (UsdUtils.StitchClips)
#
# Expected: two cloth caches, one with frames 1 to 3 and one with 4 to 6, are stitched into value clips that play frames
# 1 to 6. Each file holds its own samples, so where one clip ends and the next begins is known.
#
# Seen: StitchClips goes by startTimeCode and endTimeCode of the files and never by their samples. Where each file names
# the range of the whole shot, or none, it returns True and writes clips which all begin at one time. The stage
# refuses them when it opens ("Clip 1 cannot be active at time 1.000 in 'active' because clip 0 was already specified
# as active at this time", a warning on stderr) and the cloth has no points:
#
#   range of its own      True, starts [1.0, 4.0], samples [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
#   range of the shot     True, starts [1.0, 1.0], samples []
#   no range              True, starts [0.0, 0.0], samples []
#
# Why it matters: chunks of one simulation from a farm are saved from copies of one scene, so each of them carries the
# shot's range. Nothing fails until somebody looks at an empty frame.
#
# Workaround: set startTimeCode and endTimeCode of each chunk to its own first and last sample before stitching.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q usd-core==26.11
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

from pxr import Sdf, Usd, UsdGeom, UsdUtils


def chunk(name: str, frames: tuple, range_: tuple | None) -> str:
    stage = Usd.Stage.CreateNew(name)
    points = UsdGeom.Mesh.Define(stage, "/Cloth").GetPointsAttr()
    for frame in frames:
        points.Set([(frame, 0, 0)], frame)
    if range_:
        stage.SetStartTimeCode(range_[0])
        stage.SetEndTimeCode(range_[1])
    stage.Save()
    return name


seen = []
for name, ranges in (
    ("range of its own", [(1, 3), (4, 6)]),
    ("range of the shot", [(1, 6), (1, 6)]),
    ("no range", [None, None]),
):
    key = name.replace(" ", "_")
    chunks = [chunk(f"{key}_{i}.usda", frames, ranges[i]) for i, frames in enumerate([(1, 2, 3), (4, 5, 6)])]
    result = Sdf.Layer.CreateNew(f"{key}.usda")
    done = UsdUtils.StitchClips(result, chunks, "/Cloth")
    stage = Usd.Stage.Open(result)
    cloth = stage.GetPrimAtPath("/Cloth")
    starts = [start for start, _ in Usd.ClipsAPI(cloth).GetClipActive()]
    times = cloth.GetAttribute("points").GetTimeSamples()
    print(f"{name:<21} {done}, starts {starts}, samples {times}")
    seen.append((done, starts, times))
wanted = [(True, [1, 4], [1, 2, 3, 4, 5, 6]), (True, [1, 1], []), (True, [0, 0], [])]
sys.exit(seen != wanted)
PY
