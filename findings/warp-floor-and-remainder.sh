#!/usr/bin/env bash
# Library: warp-lang 1.19.0 (integer // and % in kernels)
#
# Expected: kernels are written in Python, where (a // b) * b + a % b is a for all integers; C, which rounds towards
# zero, keeps that rule too.
#
# Seen: in a kernel // rounds down as in Python, and % is the remainder of C, which belongs to rounding towards zero.
# Below zero the two do not fit together, in floats as in integers:
#
#   a = -1, b = 3:  a // b is -1, a % b is -1, together -4
#   a = -7, b = 3:  a // b is -3, a % b is -1, together -10
#   a =  7, b = 3:  a // b is 2, a % b is 1, together 7
#
# Why it matters: cells of a grid over cloth are found by // and wrapped, or looked up within a block, by %. Correct
# Python moved into a kernel works for garments on the positive side of the origin, and on the other side it reads
# negative offsets, before the start of an array.
#
# Workaround: use ((a % b) + b) % b, or a - (a // b) * b, for the remainder within a cell.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$tmp/cache"
cat >"$tmp/divide.py" <<'PY'
import sys

import warp as wp

wp.set_device("cpu")


@wp.kernel
def divide(a: wp.array(dtype=int), b: int, down: wp.array(dtype=int), rest: wp.array(dtype=int)):
    i = wp.tid()
    down[i] = a[i] // b
    rest[i] = a[i] % b


values = [-1, -7, 7]
down, rest = wp.zeros(3, dtype=int), wp.zeros(3, dtype=int)
wp.launch(divide, 3, inputs=[wp.array(values, dtype=int), 3, down, rest])
seen = [(int(d), int(r), int(d) * 3 + int(r)) for d, r in zip(down.numpy(), rest.numpy())]
for a, (quotient, remainder, together) in zip(values, seen):
    print(f"a = {a:2}, b = 3:  a // b is {quotient}, a % b is {remainder}, together {together}")
sys.exit(seen != [(-1, -1, -4), (-3, -1, -10), (2, 1, 7)])
PY
"$tmp/venv/bin/python" "$tmp/divide.py"
