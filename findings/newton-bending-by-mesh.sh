#!/usr/bin/env bash
# Library: newton 1.8.0 with warp-lang 1.19.0 (ModelBuilder.add_cloth_grid, SolverVBD on the CPU)
#
# Expected: "bending stiffness" is the fabric's. A strip of cloth that is clamped at one end, with one edge_ke and one
# mass by area, sags by about as much on a fine mesh as on a coarse one, and nearer to the truth.
#
# Seen: edge_ke is a stiffness of each edge's angle times the edge's length, whatever the size of the faces beside it. On
# a mesh twice as fine the same strip has half the bending stiffness. A strip of 12 x 3 cm, edge_ke 2, 0.15 kg/m^2,
# after three damped seconds; how far its free end hangs below the clamp:
#
#   edges of 15.0 mm:  27 mm
#   edges of  7.5 mm:  95 mm
#   edges of  3.8 mm: 113 mm
#
# Why it matters: whoever refines a cage and simulates it with the numbers that were tuned on the coarse one gets a limper
# fabric, and a comparison of two resolutions compares two fabrics.
#
# Workaround: for a fabric of bending stiffness B [N m] on nearly regular triangles, let edge_ke be proportional to B over
# the length of the edges.
set -euo pipefail
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install -q newton==1.8.0 warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$tmp/cache"
cd "$tmp"
"$tmp/venv/bin/python" - <<'PY'
import sys

import newton
import numpy as np
import warp as wp

wp.config.quiet = True
LENGTH, WIDTH, DENSITY, STIFFNESS = 0.12, 0.03, 0.15, 2.0


def sag(across: int) -> float:
    edge = WIDTH / across
    builder = newton.ModelBuilder()
    builder.add_cloth_grid(
        pos=wp.vec3(0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        dim_x=round(LENGTH / edge),
        dim_y=across,
        cell_x=edge,
        cell_y=edge,
        mass=DENSITY * edge**2,
        tri_ke=200.0,
        tri_ka=200.0,
        tri_kd=0.0,
        edge_ke=STIFFNESS,
        edge_kd=0.0,
        particle_radius=0.3 * edge,
    )
    builder.color()
    model = builder.finalize(device="cpu")
    rest = model.particle_q.numpy()
    clamped = rest[:, 0] < 1.5 * edge
    flags, inverse = model.particle_flags.numpy(), model.particle_inv_mass.numpy()
    flags[clamped], inverse[clamped] = 0, 0.0
    model.particle_flags.assign(flags)
    model.particle_inv_mass.assign(inverse)
    solver, now, then = newton.solvers.SolverVBD(model, iterations=30), model.state(), model.state()
    control = model.control()
    for _ in range(720):
        now.clear_forces()
        solver.step(now, then, control, None, 1 / 240)
        now, then = then, now
        now.particle_qd.assign(0.97 * now.particle_qd.numpy())
    free_end = rest[:, 0] > LENGTH - 1e-6
    return 1e3 * float((rest[:, 2] - now.particle_q.numpy()[:, 2])[free_end].mean())


sags = [sag(across) for across in (2, 4, 8)]
for across, value in zip((2, 4, 8), sags):
    print(f"edges of {1e3 * WIDTH / across:4.1f} mm: {value:3.0f} mm")
sys.exit([round(value) for value in sags] != [27, 95, 113])
PY
