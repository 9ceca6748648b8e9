#!/usr/bin/env bash
# Library: warp-lang 1.19.0 on the CPU (module option fuse_fp)
#
# Expected: fuse_fp, True by default, is documented as "Enable floating-point contraction (FMA fusion) during
# compilation", for modules of any device. On a processor with FMA instructions a * b + c is then rounded once, and
# fuse_fp=False rounds twice.
#
# Seen: on the CPU both round twice: no fused multiply-add is made for kernels written in Python. With a = b = 1 + 2^-12
# and c = -(1 + 2^-11) the exact result is 2^-24:
#
#   fuse_fp=True:   0.0
#   fuse_fp=False:  0.0
#   fuse_fp=True, cpu_compiler_flags="-march=native -ffp-contract=fast":  5.960464477539063e-08
#
# Why it matters: element kernels of cloth are mostly multiply-adds, so a core runs them slower than it could; and whoever
# sets fuse_fp=False so that a CPU and a card round alike changes the card alone.
#
# Workaround: the flags in the third line, which are a module option too; the first of them is Warp's default, which they
# replace. Results then differ in the last bits.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
grep -qw fma /proc/cpuinfo || { echo "this processor has no FMA instructions"; exit 0; }
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$tmp/cache"
cat >"$tmp/fused.py" <<'PY'
import sys

import warp as wp

wp.config.quiet = True
wp.set_device("cpu")


def multiply_add(a: wp.array(dtype=float), b: wp.array(dtype=float), c: wp.array(dtype=float), d: wp.array(dtype=float)):
    i = wp.tid()
    d[i] = a[i] * b[i] + c[i]


def result(**options) -> float:
    module = wp.Module(f"fused_{len(options)}_{options['fuse_fp']}")
    module.options.update(options)
    kernel = wp.Kernel(func=multiply_add, key="multiply_add", module=module)
    given = [wp.array([each], dtype=float) for each in (1.0 + 2.0**-12, 1.0 + 2.0**-12, -1.0 - 2.0**-11, 0.0)]
    wp.launch(kernel, 1, inputs=given)
    return float(given[-1].numpy()[0])


flag = "-march=native -ffp-contract=fast"
seen = [result(fuse_fp=True), result(fuse_fp=False), result(fuse_fp=True, cpu_compiler_flags=flag)]
print("fuse_fp=True:  ", seen[0])
print("fuse_fp=False: ", seen[1])
print(f'fuse_fp=True, cpu_compiler_flags="{flag}": ', seen[2])
sys.exit(seen != [0.0, 0.0, 2.0**-24])
PY
"$tmp/venv/bin/python" "$tmp/fused.py"
