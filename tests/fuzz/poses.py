"""Skinned clothes in two layers over a limb, in random poses: joints turn by up to 120 degrees about any axes."""

from pathlib import Path

import numpy as np
from meshes import quads_of
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt
from stages import COLLIDER_API, author, new_stage, save, vec3

from .mutant import Draft, Kind

ROOT = "/World/rig"
JOINTS = ("upper", "upper/lower", "upper/lower/hand")
PLACES = (0.0, 0.2, 0.4)
BLEND = 0.06
"""Length over which the weights of two joints change into one another [m]."""
MOST_DEGREES = 120.0
AROUND = 12


def tube(radius: float, start: float, end: float, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [m] and quads of an open tube about x, wound outward."""
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = radius * np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([ring + np.array([x, 0.0, 0.0]) for x in np.linspace(start, end, rows)])
    return points, quads_of(AROUND, rows, closed=True)


def write_limb(folder: Path) -> None:
    """A closed arm with three joints, a sleeve over it and a shorter, wider sleeve over that in the same mesh."""
    stage = new_stage(folder / "shot.usda", metres=1.0)
    UsdSkel.Root.Define(stage, ROOT)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{ROOT}/skel")
    bind = [Gf.Matrix4d().SetTranslate((x, 0.0, 0.0)) for x in PLACES]
    steps = [Gf.Matrix4d().SetTranslate((step, 0.0, 0.0)) for step in np.diff(PLACES, prepend=0.0)]
    skeleton.CreateJointsAttr(JOINTS)
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray(bind))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray(steps))
    animation = UsdSkel.Animation.Define(stage, f"{ROOT}/skel/anim")
    animation.CreateJointsAttr(JOINTS)
    animation.CreateTranslationsAttr(Vt.Vec3fArray([(step, 0.0, 0.0) for step in np.diff(PLACES, prepend=0.0)]))
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(JOINTS)))
    for time in (1.0, 2.0):
        animation.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1.0)] * len(JOINTS)), time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    points, quads = tube(0.05, -0.05, 0.6, 14)
    ends = np.array([points[:AROUND].mean(axis=0), points[-AROUND:].mean(axis=0)])
    first, last = np.arange(AROUND), len(points) - AROUND + np.arange(AROUND)
    caps = [[following, corner, len(points)] for corner, following in zip(first, np.roll(first, -1), strict=True)]
    caps += [[corner, following, len(points) + 1] for corner, following in zip(last, np.roll(last, -1), strict=True)]
    arm = _skinned_mesh(stage, "arm", np.concatenate([points, ends]), [*quads.tolist(), *caps])
    arm.GetPrim().AddAppliedSchema(COLLIDER_API)
    inner, outer = tube(0.056, 0.0, 0.5, 12), tube(0.064, 0.08, 0.42, 9)
    cloth = np.concatenate([inner[0], outer[0]])
    faces = [*inner[1].tolist(), *(outer[1] + len(inner[0])).tolist()]
    _skinned_mesh(stage, "cloth", cloth, faces).GetPrim().AddAppliedSchema("PhysGraphGarmentAPI")
    save(stage)


def _skinned_mesh(stage: Usd.Stage, name: str, points: np.ndarray, faces: list[list[int]]) -> UsdGeom.Mesh:
    """A mesh bound to the joints by the place of its points [m] along x."""
    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/{name}")
    mesh.CreatePointsAttr(vec3(points))
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
    mesh.CreateFaceVertexIndicesAttr([int(corner) for face in faces for corner in face])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([f"{ROOT}/skel"])
    later = np.stack([np.clip((points[:, 0] - x) / BLEND + 0.5, 0.0, 1.0) for x in PLACES], axis=1)
    weights = later.copy()
    weights[:, 0] = 1.0
    weights[:, :-1] -= later[:, 1:]
    count = len(JOINTS)
    binding.CreateJointIndicesPrimvar(False, count).Set(Vt.IntArray(list(range(count)) * len(points)))
    binding.CreateJointWeightsPrimvar(False, count).Set(Vt.FloatArray.FromNumpy(weights.ravel().astype(np.float32)))
    return mesh


def _poses(draft: Draft) -> None:
    """Two neighbouring poses by random rotations of the joints."""
    stage = draft.open()
    rotations = UsdSkel.Animation(stage.GetPrimAtPath(f"{ROOT}/skel/anim")).GetRotationsAttr()
    axes = draft.rng.normal(size=(len(JOINTS), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = draft.rng.uniform(0.0, MOST_DEGREES, len(JOINTS))
    for time, share in ((1.0, 1.0), (2.0, 0.95)):
        turns = [
            Gf.Rotation(Gf.Vec3d(*axis), share * angle).GetQuat() for axis, angle in zip(axes, angles, strict=True)
        ]
        rotations.Set(Vt.QuatfArray([Gf.Quatf(turn) for turn in turns]), time)
    if draft.chance(0.3):
        author(stage.GetPrimAtPath(f"{ROOT}/cloth"), "physgraph:contact:selfCollision", False)
    draft.options |= {"steps": 24}
    draft.options.pop("integrator", None)
    draft.save(stage, f"joints turn by {np.round(angles).tolist()} degrees")


KINDS = (Kind("poses", _poses, ("limb",)),)
