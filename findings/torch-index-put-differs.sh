#!/usr/bin/env bash
# Library: torch 2.13.0 on the CPU (index_put_ with accumulate=True)
#
# Expected: float sums on one CPU with a fixed number of threads repeat bit for bit. Sums in varying order are known from
# GPUs; index_add_ and scatter_add_, which do the same work, do repeat on the CPU.
#
# Seen: index_put_ with accumulate=True adds from several threads in whatever order they come. Distinct results of 20
# runs on the same numbers, with two threads:
#
#   index_add_   1
#   scatter_add_ 1
#   index_put_   more than 1 (20 on most runs)
#
# Why it matters: forces of edges and faces are gathered at vertices this way, and `x[index] += y` does not sum at all,
# so index_put_ is what one is told to use instead. Contact amplifies the last bit into another fold, and a farm's retry
# of one frame no longer fits its neighbours.
#
# Workaround: index_add_, or torch.use_deterministic_algorithms(True), with which index_put_ repeats too.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q torch==2.13.0 numpy==2.4.6
"$tmp/venv/bin/python" - <<'PY'
import sys

import torch

torch.manual_seed(0)
torch.set_num_threads(2)
vertices, corners = 50, 400_000
index, force = torch.randint(0, vertices, (corners,)), torch.randn(corners, 3)


def distinct(gather) -> int:
    return len({gather(torch.zeros(vertices, 3)).numpy().tobytes() for _ in range(20)})


add = distinct(lambda total: total.index_add_(0, index, force))
scatter = distinct(lambda total: total.scatter_add_(0, index[:, None].expand(-1, 3), force))
put = distinct(lambda total: total.index_put_((index,), force, accumulate=True))
print("distinct results of 20 runs:")
print("index_add_  ", add)
print("scatter_add_", scatter)
print("index_put_  ", put)
torch.use_deterministic_algorithms(True)
fixed = distinct(lambda total: total.index_put_((index,), force, accumulate=True))
print("index_put_, deterministic algorithms asked for:", fixed)
sys.exit(not (add == scatter == fixed == 1 and put > 1))
PY
