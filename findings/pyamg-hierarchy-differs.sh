#!/usr/bin/env bash
# Library: pyamg 5.4.1 (smoothed_aggregation_solver)
#
# Expected: building a multigrid hierarchy twice from one matrix, in one process and without any random option, gives the
# same hierarchy, and solving with it the same numbers.
#
# Seen: the smoother's weight comes from an estimate of the spectral radius that starts from numpy's global random
# state. So hierarchies differ, solutions agree only to the tolerance, and the caller's own random numbers move on:
#
#   smoothed_aggregation_solver: 3 distinct solutions of 3, numpy's random state moved: True
#   ruge_stuben_solver:          1 distinct solution of 3
#   smoothed_aggregation_solver, seeded before each: 1 distinct solution of 3
#
# Why it matters: solvers of cloth promise frames that repeat bit for bit, so that a farm may solve one again. With a
# preconditioner from here a frame depends on how many hierarchies were built before it.
#
# Workaround: call np.random.seed with a fixed number just before each hierarchy, and put the state back afterwards.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q pyamg==5.4.1 numpy==2.4.6 scipy==1.17.1
"$tmp/venv/bin/python" - <<'PY'
import sys

import numpy as np
import pyamg

matrix = pyamg.gallery.poisson((60, 60), format="csr")
right = np.ones(matrix.shape[0])


def distinct(build, seed: int | None = None) -> int:
    found = set()
    for _ in range(3):
        if seed is not None:
            np.random.seed(seed)
        found.add(build(matrix).solve(right, tol=1e-8).tobytes())
    return len(found)


before = np.random.get_state()[1].copy(), np.random.get_state()[2]
smoothed = distinct(pyamg.smoothed_aggregation_solver)
moved = not (np.array_equal(before[0], np.random.get_state()[1]) and before[1] == np.random.get_state()[2])
classical = distinct(pyamg.ruge_stuben_solver)
seeded = distinct(pyamg.smoothed_aggregation_solver, seed=1)
print(f"smoothed_aggregation_solver: {smoothed} distinct solutions of 3, numpy's random state moved: {moved}")
print(f"ruge_stuben_solver:          {classical} distinct solution of 3")
print(f"smoothed_aggregation_solver, seeded before each: {seeded} distinct solution of 3")
sys.exit((smoothed, moved, classical, seeded) != (3, True, 1, 1))
PY
