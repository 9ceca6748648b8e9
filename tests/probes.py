"""Calibration probes: the elastic constants that a mesh really has, and hanging strips against closed formulas.

The in-plane probe strains the rim of a sheet by each of the three uniform strains, lets the inside relax, and reads the
stiffness matrix C from the energies: so C is what the sheet shows to an experiment, not what its elements were given.
The bending probe does the same with the three uniform curvatures. The strips are solved to rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from sheets import level_of_kind

from physgraph_usd.lab.methods.newton import Newton
from physgraph_usd.solver.fabric import Fabric
from physgraph_usd.solver.forces import elastic_terms
from physgraph_usd.solver.forces.base import Force, ForceModule
from physgraph_usd.solver.forces.bending import Bending
from physgraph_usd.solver.forces.gravity import Gravity
from physgraph_usd.solver.integrate.base import System
from physgraph_usd.solver.integrate.descend import solve_level
from physgraph_usd.solver.integrate.metric import Metric, laplacian
from physgraph_usd.solver.integrate.quasi_newton import QuasiNewton
from physgraph_usd.solver.integrate.stop import Budget
from physgraph_usd.solver.level import Level

G = 9.81


@dataclass(frozen=True)
class Spread:
    """A constant over all directions in the sheet."""

    mean: float
    low: float
    high: float


def hessian(force: Force, level: Level, axes: Sequence[int]) -> np.ndarray:
    """Central differences of a force at rest [N/m], shape (n V, n V) for n axes; degrees of freedom vertex by vertex.

    Vertices that share no neighbour move at once: no row feels two of them.
    """
    x, near, n = level.rest, pattern(level), len(axes)
    step, count = 1e-6 * float(x.std()), len(x)
    out = np.zeros((count, n, count, n))
    for together in colours(near):
        rows, which = np.nonzero(near[:, together])
        for column, axis in enumerate(axes):
            sides = []
            for sign in (1.0, -1.0):
                moved, f = x.clone(), torch.zeros_like(x)
                moved[torch.as_tensor(together), axis] += sign * step
                force.add_force(moved, f)
                sides.append(f[:, axes].numpy())
            out[rows, :, together[which], column] = ((sides[1] - sides[0]) / (2 * step))[rows]
    flat = out.reshape(count * n, count * n)
    return 0.5 * (flat + flat.T)


def pattern(level: Level) -> np.ndarray:
    """Which vertices may feel which: those within two springs, shape (V, V)."""
    near = np.eye(level.vertex_count, dtype=np.float32)
    a, b = level.springs.numpy().T
    near[a, b] = near[b, a] = 1.0
    return near @ near > 0


def colours(near: np.ndarray) -> list[np.ndarray]:
    """Groups of vertices that share no neighbour, greedily."""
    shares = near.astype(np.float32) @ near.astype(np.float32) > 0
    left, groups = np.ones(len(near), bool), []
    while left.any():
        group: list[int] = []
        blocked = ~left
        while not blocked.all():
            vertex = int(np.flatnonzero(~blocked)[0])
            group.append(vertex)
            blocked |= shares[vertex]
            blocked[vertex] = True
        left[group] = False
        groups.append(np.array(group))
    return groups


def relaxed(stiffness: np.ndarray, modes: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Modes whose free entries minimise the quadratic energy, shape (N, modes)."""
    free = ~held
    result = modes.copy()
    load = -stiffness[np.ix_(free, held)] @ modes[held]
    result[free] = np.linalg.lstsq(stiffness[np.ix_(free, free)], load, rcond=1e-10)[0]
    return result


def rim(level: Level, depth: float) -> np.ndarray:
    """True at vertices within a depth of the sheet's bounding box sides."""
    p = level.rest[:, :2].numpy()
    return ((p < p.min(axis=0) + depth) | (p > p.max(axis=0) - depth)).any(axis=1)


def plane_stiffness(level: Level, forces: Sequence[Force]) -> np.ndarray:
    """C [N/m] of the sheet, shape (3, 3), for strains (e11, e22, 2 e12)."""
    p = level.rest.numpy()
    none = np.zeros(len(p))
    modes = [(p[:, 0], none), (none, p[:, 1]), (0.5 * p[:, 1], 0.5 * p[:, 0])]
    modes = np.stack([np.stack(mode, axis=1).reshape(-1) for mode in modes], axis=1)
    stiffness = np.sum([hessian(force, level, [0, 1]) for force in forces], axis=0)
    held = np.repeat(rim(level, 1.2 * float(level.spacing.mean())), 2)
    u = relaxed(stiffness, modes, held)
    return u.T @ stiffness @ u / float(level.vertex_area.sum())


def bending_stiffness(level: Level, rigidity: float) -> np.ndarray:
    """Bending stiffness [N m], shape (3, 3), for curvatures (k11, k22, 2 k12), away from the rim."""
    p, edge = level.rest.numpy(), float(level.spacing.mean())
    modes = 0.5 * np.stack([p[:, 0] ** 2, p[:, 1] ** 2, p[:, 0] * p[:, 1]], axis=1)
    bending = Bending(level, torch.tensor([rigidity]))
    u = relaxed(hessian(bending, level, [2]), modes, rim(level, 2.2 * edge))
    weighed, area = inside(level)
    stiffness = hessian(Bending(weighed, torch.tensor([rigidity])), level, [2])
    return u.T @ stiffness @ u / area


def inside(level: Level) -> tuple[Level, float]:
    """The level with its bending weighed by a bump that vanishes near the rim, and the area under the bump [m^2]."""
    p, edge = level.rest.numpy(), float(level.spacing.mean())
    low, high = p.min(axis=0)[:2] + 2.7 * edge, p.max(axis=0)[:2] - 2.7 * edge

    def bump(at: np.ndarray) -> np.ndarray:
        return (np.sin(np.pi * np.clip((at[:, :2] - low) / (high - low), 0.0, 1.0)) ** 2).prod(axis=1)

    weight = bump(p[level.hinges.numpy()[:, :2]].mean(axis=1))
    weighed = replace(level, bend_scale=level.bend_scale * torch.as_tensor(weight))
    return weighed, float((level.vertex_area.numpy() * bump(p)).sum())


def turned(stiffness: np.ndarray, angle: float) -> np.ndarray:
    """A stiffness matrix for axes turned by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    strain = np.array([[c * c, s * s, -c * s], [s * s, c * c, c * s], [2 * c * s, -2 * c * s, c * c - s * s]])
    return strain.T @ stiffness @ strain


def over_directions(measure: Callable[[float], float]) -> Spread:
    """Mean and extremes of a function of direction over half a turn."""
    values = np.array([measure(angle) for angle in np.linspace(0, np.pi, 73)[:-1]])
    return Spread(float(values.mean()), float(values.min()), float(values.max()))


def plane_constants(stiffness: np.ndarray) -> dict[str, Spread]:
    """Young's modulus Y, Poisson's ratio nu and shear stiffness G over all directions."""

    def compliance(angle: float) -> np.ndarray:
        return np.linalg.inv(turned(stiffness, angle))

    return {
        "Y": over_directions(lambda a: 1.0 / compliance(a)[0, 0]),
        "nu": over_directions(lambda a: -compliance(a)[1, 0] / compliance(a)[0, 0]),
        "G": over_directions(lambda a: 1.0 / compliance(a)[2, 2]),
    }


def bending_constants(stiffness: np.ndarray) -> dict[str, Spread]:
    """D of a cylinder of any direction, and the ratio of its two moments."""
    return {
        "D": over_directions(lambda a: turned(stiffness, a)[0, 0]),
        "nu": over_directions(lambda a: turned(stiffness, a)[1, 0] / turned(stiffness, a)[0, 0]),
    }


def tensile_test(level: Level, forces: Sequence[Force]) -> tuple[float, float]:
    """Young's modulus [N/m] and Poisson's ratio along x: short sides pulled, everything else free."""
    p, strain = level.rest.numpy(), 1.0
    stiffness = np.sum([hessian(force, level, [0, 1]) for force in forces], axis=0)
    edge = float(level.spacing.mean())
    ends = (p[:, 0] < p[:, 0].min() + 0.6 * edge) | (p[:, 0] > p[:, 0].max() - 0.6 * edge)
    held = np.stack([ends, np.arange(len(p)) == int(np.flatnonzero(ends)[0])], axis=1)
    modes = np.stack([strain * p[:, 0], 0 * p[:, 0]], axis=1)
    u = relaxed(stiffness, modes.reshape(-1, 1), held.reshape(-1))[:, 0]
    inside = np.abs(p[:, 0] - p[:, 0].mean()) < 0.3 * np.ptp(p[:, 0])
    fit = np.column_stack([p[inside, 0], p[inside, 1], np.ones(inside.sum())])
    slope = np.linalg.lstsq(fit, u.reshape(-1, 2)[inside], rcond=None)[0]
    pulled = u @ stiffness @ u / (float(level.vertex_area.sum()) * float(slope[0, 0]) * strain)
    return float(pulled), float(-slope[1, 1] / slope[0, 0])


def cylinder_rigidity(level: Level, radius: float, angle: float) -> float:
    """D over the hinges' D, from the energy of the sheet rolled onto a cylinder, every vertex on it, inside its rim."""
    weighed, area = inside(level)
    bending = Bending(weighed, torch.ones(1))
    p = level.rest.numpy()
    along = p[:, 0] * np.cos(angle) + p[:, 1] * np.sin(angle)
    across = p[:, 1] * np.cos(angle) - p[:, 0] * np.sin(angle)
    rolled = np.stack([radius * np.sin(along / radius), across, radius * np.cos(along / radius)], axis=1)
    energy = float(bending.add_force(torch.as_tensor(rolled), torch.zeros_like(level.rest)))
    return 2 * energy * radius**2 / area


def relax(level: Level, forces: Sequence[Force], x: torch.Tensor, *, steps: int = 400) -> torch.Tensor:
    """The positions at rest: quasi-Newton first, Newton to polish."""
    module = ForceModule(forces)
    between, fixed = module.rest_springs()
    matrix = laplacian(level.springs.numpy(), between, fixed + np.zeros(level.vertex_count))
    metric = Metric(matrix, free=level.free, dtype=level.dtype)
    system = System(module, metric, free=level.free, spacing=level.spacing)
    for integrator, count in ((QuasiNewton(), steps), (Newton(), 200)):
        x, _ = solve_level(system, integrator, x, level=0, budget=Budget(count, 1e-7))
    return x


def hang(level: Level, start: np.ndarray, fabric: Fabric) -> np.ndarray:
    """Rest positions of a pinned sheet under its own weight, z up."""
    weight = Gravity(level, torch.tensor([fabric.density]), np.array([0.0, 0.0, -G]))
    forces = (*elastic_terms(level, [fabric]), weight)
    return relax(level, forces, torch.as_tensor(start)).numpy()


def clamped(level: Level) -> Level:
    """The level with hinges at its clamp twice as stiff.

    A hinge stands for the halves of two triangles; of one of them the clamp leaves nothing to bend.
    """
    held = ~level.free[:, 0][level.hinges.long()]
    at_clamp = held[:, :2].all(dim=1) & (held[:, 2:4].all(dim=1) ^ held[:, 4:].all(dim=1))
    return replace(level, bend_scale=torch.where(at_clamp, 2.0, 1.0) * level.bend_scale)


def cantilever(kind: str, length: float, fabric: Fabric, *, edges: int = 24, warp: np.ndarray | None = None) -> float:
    """Angle of the chord below the horizontal [rad] of a strip clamped where x <= 0, free at x = length."""
    edge = length / edges
    width = 2 * edge * round(0.35 * edges / 2)
    level = level_of_kind(
        kind, (length + 2 * edge, width, edge), start=-2 * edge, pinned=lambda p: p[:, 0] < 1e-3 * edge, warp=warp
    )
    points = level.rest.numpy()
    start, out = points.copy(), np.maximum(points[:, 0], 0.0)
    start[:, 0] = np.minimum(points[:, 0], 0.0) + length * np.sin(out / length)
    start[:, 2] = -length * (1.0 - np.cos(out / length))
    settled = hang(clamped(level), start, fabric)
    tip = settled[points[:, 0] > length * (1 - 1e-3)].mean(axis=0)
    return float(np.arctan2(-tip[2], tip[0]))


def hanging_chain(kind: str, length: float, span: float, fabric: Fabric) -> float:
    """Sag [m] of a narrow strip whose short sides are pinned a span apart."""
    edge = length / 30
    level = level_of_kind(
        kind, (length, 2 * edge, edge), pinned=lambda p: (p[:, 0] < 0.6 * edge) | (p[:, 0] > p[:, 0].max() - 0.6 * edge)
    )
    points = level.rest.numpy()
    along = points[:, 0] / points[:, 0].max() - 0.5
    start = points.copy()
    start[:, 0] = along * span
    start[:, 2] = -0.8 * catenary_sag(length, span) * (1 - (2 * along) ** 2)
    start[~level.free[:, 0].numpy(), 2] = 0.0
    return float(-hang(level, start, fabric)[:, 2].min())


def elastica(length: float, rigidity: float, density: float) -> float:
    """The same angle of the heavy elastica: rigidity t'' = -density G (length - s) cos t, t(0) = t'(length) = 0."""
    load = density * G * length**3 / rigidity
    s = np.linspace(0, 1, 201)
    guess = np.stack([s, 1 - s])
    found = solve_bvp(
        lambda s, t: np.stack([t[1], -load * (1 - s) * np.cos(t[0])]),
        lambda a, b: np.array([a[0], b[1]]),
        s,
        guess,
        tol=1e-8,
    )
    s = np.linspace(0, 1, 2001)
    t = found.sol(s)[0]
    return float(np.arctan2(np.trapezoid(np.sin(t), s), np.trapezoid(np.cos(t), s)))


def rigidity_from(angle: float, length: float, density: float) -> float:
    """The rigidity [N m] with which the elastica has this chord angle."""
    unit = density * G * length**3
    return float(brentq(lambda d: elastica(length, d, density) - angle, 0.02 * unit, 2.0 * unit, rtol=1e-6))


def catenary_sag(length: float, span: float) -> float:
    """Sag [m] of an inextensible chain between two points at equal height."""
    a = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 1e-3 * length, 1e3 * length)
    return float(a * (np.cosh(span / (2 * a)) - 1))
