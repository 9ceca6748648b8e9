"""Contact of one group of garments with the bodies of one frame: who is near, the planes they see, a last projection.

Closest points cost about as much as a force evaluation, so they are asked for seldom and for few vertices. Distances
change no faster than vertices move: a vertex that was d away and has moved by m is at least d - m away, and only those
for which that is less than the offset and the move expected of a round are asked again. The same bound tells which may
have changed sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..colliders.base import Nearest, Surface
from ..colliders.sign import signed_and_closest, signed_distances
from ..forces.contact import Contact
from ..forces.seam import Seam
from ..level import Level
from ..mesh.topology import patches_with
from .corners import lift_over
from .measure import DEEP, Pierced, depths, penetration
from .room import room_above
from .settings import ContactSettings
from .sight import Sight
from .track import Track

LIFT = 2.0
"""Farthest that cloth is lifted over what comes through its faces, in edge lengths: a spike would show more."""
STALE = 0.1
"""How far a vertex moves before the plane that it sees is found anew, in edge lengths."""
HOLLOW = 0.02
"""How far in front of a plane seen before the closest point lies in a crease of the body, in edge lengths."""
PASSING = 2.0
"""Edges from its target beyond which a vertex may pass through a body to it."""
STALLED = 6
"""How often faces that a body comes through are moved in vain, once none more comes clear."""


def no_farther(
    x: Float[Tensor, "vertices 3"], start: Float[Tensor, "vertices 3"], most: Float[Tensor, " vertices"]
) -> Float[Tensor, "vertices 3"]:
    """Positions on the way from where each vertex started to x, no farther than most [m]; x itself where none is."""
    way = x - start
    length = way.norm(dim=1)
    far = length > most
    return torch.where(far.unsqueeze(1), start + way * (most / length).unsqueeze(1), x) if bool(far.any()) else x


@dataclass(frozen=True, eq=False)
class Touching:
    """A surface that a group may touch.

    Attributes:
        path: Its collider's prim path.
        surface: The posed surface.
        offset: Distance kept by each garment of the group [m]; minus infinity where it does not feel the surface.
    """

    path: str
    surface: Surface
    offset: tuple[float, ...]


class LevelBodies:
    """One level's view of the bodies.

    Attributes:
        seam: What is sewn together, and stays so where bodies push; or None without seams.
    """

    def __init__(self, level: Level, tracks: Sequence[Track], settings: ContactSettings) -> None:
        """Keep what is known of the distances."""
        self.seam: Seam | None = None
        self._level, self._tracks, self._settings = level, tuple(tracks), settings
        self._reach = float(level.spacing.mean())
        self._sights: list[Sight] = []

    def term(self, x: Float[Tensor, "vertices 3"]) -> Contact | None:
        """The contact force near positions x [m], or None where nothing can touch."""
        before = self._sights or [Sight.none(x)] * len(self._tracks)
        self._sights = [self._look(*each, x) for each in zip(self._tracks, before, strict=True)]
        planes = [each.planes() for sight in self._sights for each in (sight.closest, sight.crease)]
        seen = any(len(each.vertex) for each in planes)
        return Contact(self._level, planes, self._settings.stiffness, form=self._settings.form) if seen else None

    def _look(self, track: Track, known: Sight, x: Tensor) -> Sight:
        """What is seen of one body; planes of vertices that have hardly moved stay."""
        still = known.closest.there & ((x - known.at).norm(dim=1) <= STALE * self._level.spacing)
        reach = track.offset + self._reach
        vertex, normal, signed = track.refresh(x, torch.where(still, torch.full_like(reach, -torch.inf), reach))
        near = signed < reach[vertex]
        vertex, normal, signed = vertex[near], normal[near], signed[near]
        offset = self._kept(track, x[vertex], normal, signed, track.offset[vertex])
        # Where parts of the body overlap there is no room in the crease between them.
        return known.renewed(
            x,
            still,
            vertex=vertex,
            normal=normal,
            signed=signed,
            offset=offset,
            hollow=HOLLOW * self._level.spacing if track.lost is None else None,
        )

    def project(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, "vertices 3"], int]:
        """Move free vertices that are under the least clearance to it, and farther where a body comes through a face.

        Returns:
            Positions [m]; x itself when none had to move; and the passes that it took.
        """
        out, passes = self._out(x)
        first, best, least, stalled = out, out, len(self._level.triangles) + 1, 0
        for _ in range(self._settings.lifts):
            lifted, faces = self._over_corners(out)
            if faces < least:
                best, least, stalled = out, faces, 0
            stalled += 1
            if not faces or stalled > STALLED:
                break
            out, passes = no_farther(lifted, first, LIFT * self._level.spacing), passes + 1
        if best is first:
            return first, passes
        # What was lifted in vain goes back: it would stand as a spike, and the body still come through.
        stuck = torch.zeros_like(self._level.free[:, 0])
        for track in self._tracks if least else ():
            stuck[self._level.triangles[self._pierced_faces(track, best)].long().reshape(-1)] = True
        return self.push_out(torch.where(stuck.unsqueeze(1), first, best)), passes

    def let_through(self, x: Float[Tensor, "vertices 3"], target: Float[Tensor, "vertices 3"]) -> None:
        """From now on let vertices at x [m] pass through bodies that are between them and a target [m]."""
        for each in self._tracks:
            each.let_through(x, target, PASSING * self._level.spacing)

    def push_out(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, "vertices 3"]:
        """Free vertices moved to the least clearance, wherever bodies come through faces [m]."""
        return self._out(x)[0]

    def within(self, x: Float[Tensor, "vertices 3"]) -> tuple[Bool[Tensor, " vertices"], Bool[Tensor, " vertices"]]:
        """Vertices inside closed bodies at x [m], and those of them that are pinched."""
        inside, held = (torch.zeros_like(self._level.free[:, 0]) for _ in range(2))
        for track in self._tracks:
            at = x + track.shift
            asked = track.surface, at, self._level.edges
            signed = track.known if torch.equal(x, track.at) else signed_distances(*asked, reach=self._reach)
            signed = torch.where(track.offset.isfinite(), signed, signed.abs())
            depth, pinned = depths(track.surface, at, signed, track.longest)
            inside |= depth > 0
            held |= pinned
        return inside, held

    def lose(self, x: Float[Tensor, "vertices 3"]) -> None:
        """From now on leave cloth that is between overlapping parts of a body at x [m] to itself while inside that.

        It is a patch of vertices whose closest faces are buried, some of them inside two parts at once. Pushed out, it
        would fold through its neighbours, whose way out is on the other side.
        """
        for track in self._tracks:
            between, in_two = track.between(x)
            track.lost = self._patches(between, between[in_two]) if bool(in_two.any()) else None

    def _patches(self, some: Tensor, seeds: Tensor) -> Bool[Tensor, " vertices"]:
        """Of some vertices, by number, the connected patches that hold a seed."""
        kept, wanted = (torch.zeros_like(self._level.free[:, 0]) for _ in range(2))
        kept[some], wanted[seeds] = True, True
        masks = (each.cpu().numpy() for each in (kept, wanted))
        return torch.as_tensor(patches_with(self._level.edges.cpu().numpy(), *masks), device=kept.device)

    @property
    def lost(self) -> tuple[Bool[Tensor, " vertices"] | None, ...]:
        """The vertices that each body lost; None where there are none."""
        return tuple(track.lost for track in self._tracks)

    @property
    def passing(self) -> tuple[Bool[Tensor, " vertices"] | None, ...]:
        """The vertices that each body lets through; None where it lets none."""
        return tuple(track.passing for track in self._tracks)

    def _out(self, x: Tensor) -> tuple[Tensor, int]:
        """Push out to the least clearance, body by body; the positions and the passes made.

        What bodies push to and fro until the passes end is moved by halves, and so to the middle between them.
        """
        out, passes = x, 0
        for attempt in range(2 * self._settings.projections):
            together = attempt >= self._settings.projections
            moved, total = False, torch.zeros_like(x)
            for track in self._tracks:
                vertex, push = self._pushes(track, out)
                if not len(vertex):
                    continue
                moved = True
                if together:
                    total[vertex] += 0.5 * push
                else:
                    out = out.clone() if out is x else out
                    out[vertex] += push
            out = out + total if together and moved else out
            if not moved or (together and float(total.abs().max()) < 1e-7):
                break
            passes += 1
        return (out if self.seam is None else self.seam.closed(out)), passes

    def _pushes(self, track: Track, x: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices that are under their least clearance to a surface, and the ways to it."""
        least = self._settings.clearance * track.offset
        vertex, normal, signed = track.refresh(x, least)
        lack = self._kept(track, x[vertex], normal, signed, least[vertex]) - signed
        push = (lack > 1e-7) & self._level.free[vertex, 0]
        return vertex[push], lack[push].unsqueeze(1) * normal[push]

    def _kept(self, track: Track, x: Tensor, normal: Tensor, signed: Tensor, wanted: Tensor) -> Tensor:
        """The distance to keep from a surface: half the room that it leaves, where that is less than what is wanted."""
        foot = x - signed.unsqueeze(1) * normal + track.shift
        reach = 2.0 * wanted.clamp_min(0.0)
        room = room_above(track.surface, foot, normal, reach=reach, lanes=self._level.lanes)
        return torch.minimum(wanted, 0.5 * room)

    def _over_corners(self, x: Tensor) -> tuple[Tensor, int]:
        """Corners of faces that bodies come through moved towards where they do not, and how many there are."""
        out, count = x, 0
        for track in self._tracks:
            faces = self._pierced_faces(track, out)
            count += len(faces)
            if len(faces):
                least = self._settings.clearance * track.offset
                at = out + track.shift
                out = out + lift_over(track.surface, self._level, at, faces, clearance=least, start=track.side)
        if not count:
            return x, 0
        out = self.push_out(out)
        # What another body is in the way of stays where it is.
        stuck = self._depth(out) > self._depth(x).clamp_min(DEEP)
        return torch.where(stuck.unsqueeze(1), x, out), count

    def _pierced_faces(self, track: Track, x: Tensor) -> Tensor:
        """Faces that a body comes through though none of their corners is left inside it."""
        found = self._pierced(track, x)
        triangles, ends = self._level.triangles.long(), self._level.edges[found.edges].long()
        hit = torch.zeros(len(triangles), dtype=torch.bool, device=x.device)
        hit[found.triangles] = True
        if len(ends):
            around = torch.zeros_like(self._level.free[:, 0])
            around[ends.reshape(-1)] = True
            near = torch.nonzero(around[triangles].sum(dim=1) >= 2).squeeze(1)
            sides = triangles[near][:, [[0, 1], [1, 2], [2, 0]]].sort(dim=2).values
            key, known = sides[..., 0] * len(x) + sides[..., 1], ends.sort(dim=1).values
            hit[near[torch.isin(key, known[:, 0] * len(x) + known[:, 1]).any(dim=1)]] = True
        stays = (track.known < 0) | ~track.offset.isfinite()
        for other in self._tracks:  # Between two bodies there is no room to lift anything.
            if other is not track:
                stays |= other.known - (x - other.at).norm(dim=1) < 2.0 * self._settings.clearance * other.offset
        return torch.nonzero(hit & ~stays[triangles].any(dim=1)).squeeze(1)

    def _pierced(self, track: Track, x: Tensor) -> Pierced:
        """What goes through a body and through what it goes."""
        return track.pierced(self._level, x, (track.known.abs() - (x - track.at).norm(dim=1)).clamp_min(0.0))

    def _depth(self, x: Tensor) -> Tensor:
        """How deep each vertex is in the deepest body [m]."""
        out = torch.zeros_like(x[:, 0])
        for track in self._tracks:
            vertex, _, signed = track.refresh(x, torch.zeros_like(out))
            out[vertex] = torch.maximum(out[vertex], -signed)
        return out


def moves(x: Float[Tensor, "vertices 3"], out: Float[Tensor, "vertices 3"], passes: int) -> dict[str, int | float]:
    """How many vertices moved from x to other positions [m], how far at most [mm] and in how many passes."""
    shifts = (out - x).norm(dim=1)
    far = 1e3 * float(shifts.max()) if len(shifts) else 0.0
    return {"vertices": int((shifts > 0).sum()), "largest_mm": round(far, 4), "passes": passes}


@dataclass(eq=False)
class FrameBodies:
    """A group's bodies in one frame.

    Attributes:
        touching: The surfaces.
        distances: Signed distances of the upsampled cage to each [m], shape (V,).
    """

    touching: tuple[Touching, ...]
    distances: list[Float[Tensor, " vertices"]]
    _inside: list[Nearest | None]
    _tracks: list[Track] = field(default_factory=list)
    _settings: ContactSettings = field(default_factory=ContactSettings)
    _views: dict[int, LevelBodies] = field(default_factory=dict)

    @staticmethod
    def begin(
        levels: Sequence[Level],
        touching: Sequence[Touching],
        coarse: Float[Tensor, "coarse 3"],
        *,
        origin: np.ndarray,
        settings: ContactSettings,
    ) -> FrameBodies:
        """Find the distances of the upsampled cage.

        Args:
            levels: The group's levels.
            touching: The surfaces.
            coarse: Cage positions [m], recentred.
            origin: World position of the group's origin [m], shape (3,).
            settings: How contact is solved, with k_c itself as its stiffness.
        """
        finest = levels[-1]
        base = finest.base.apply(coarse)
        tracks, inside = [], []
        for each in touching:
            shift = torch.as_tensor(origin - each.surface.origin).to(base)
            offset = torch.as_tensor(each.offset).to(base)[finest.vertex_garment.long()]
            reach = float(offset.max()) + float(levels[0].spacing.mean())
            known, closest = signed_and_closest(each.surface, base + shift, finest.edges, reach=reach)
            feels = offset.isfinite()
            known = torch.where(feels, known, torch.full_like(known, float("inf")))
            closest = closest if bool(feels.all()) else None
            inside.append(closest)
            side = _start_sides(each.surface, coarse + shift, finest)
            longest = settings.way_out * float(levels[0].spacing.mean())
            tracks.append(Track(each.surface, shift, offset, side, base, known, longest, inside=closest))
        return FrameBodies(tuple(touching), [track.known.clone() for track in tracks], inside, tracks, settings)

    def measure(
        self,
        finest: Level,
        base: Float[Tensor, "vertices 3"],
        x: Float[Tensor, "vertices 3"],
        *,
        lost: Sequence[Bool[Tensor, " vertices"] | None] = (),
        passing: Sequence[Bool[Tensor, " vertices"] | None] = (),
    ) -> dict[str, object]:
        """What is in each body and what crosses it, before and after, as plain values.

        Args:
            finest: The finest level.
            base: The upsampled cage [m].
            x: The result [m].
            lost: `LevelBodies.lost`.
            passing: `LevelBodies.passing`.
        """
        bodies: dict[str, object] = {}
        lost, passing = (given or [None] * len(self._tracks) for given in (lost, passing))
        known = zip(self.touching, self._tracks, self.distances, self._inside, lost, passing, strict=True)
        for index, (each, track, before, inside, own, through) in enumerate(known):
            surface, shift = each.surface, track.shift
            # What was farther outside a closed surface than it moved since still is; of an open one it may be behind.
            least = self._known_last(index, finest).least(x) if surface.closed else None
            reach = float(finest.spacing.max())
            after = signed_distances(surface, x + shift, finest.edges, reach=reach, least=least)
            after = torch.where(track.offset.isfinite(), after, torch.full_like(after, float("inf")))
            crossings, longest = len(track.pierced(finest, x, after.abs())), track.longest
            first = penetration(surface, finest, base + shift, before, longest=longest, inside=inside)
            left = {"lost": own, "passing": through, "crossings": crossings}
            last = penetration(surface, finest, x + shift, after, longest=longest, **left)
            name = each.path if surface.closed else f"{each.path} (open part)"
            bodies[name] = {"before": asdict(first), "after": asdict(last)}
        return {"bodies": bodies}

    def _known_last(self, index: int, finest: Level) -> Track:
        """What is known of a surface: what the finest level found of it last, or of the upsampled cage."""
        view = self._views.get(finest.index)
        return self._tracks[index] if view is None else view._tracks[index]

    def at(self, level: Level, finest: Level) -> LevelBodies:
        """The view of one level, the same at each call; its vertices come first among each garment's finest ones."""
        if level.index in self._views:
            return self._views[level.index]
        pairs = zip(level.spans, finest.spans, strict=True)
        places = [torch.arange(fine.start, fine.start + own.stop - own.start) for own, fine in pairs]
        which = torch.cat(places).to(level.rest.device)
        tracks = [
            replace(
                t,
                inside=t.inside if level is finest else None,
                **{name: getattr(t, name)[which].clone() for name in ("offset", "side", "at", "known")},
            )
            for t in self._tracks
        ]
        self._views[level.index] = LevelBodies(level, tracks, self._settings)
        return self._views[level.index]


def _start_sides(surface: Surface, cage: Float[Tensor, "coarse 3"], finest: Level) -> Float[Tensor, " vertices"]:
    """The side on which the cage around each fine vertex lies: 1 or -1, 0 where it is undecided or has no meaning."""
    if surface.closed or surface.fixed_side is not None:
        return torch.full((finest.vertex_count,), surface.fixed_side or 0.0, dtype=cage.dtype, device=cage.device)
    found = surface.closest(cage, torch.full_like(cage[:, 0], float("inf")))
    side = torch.where(found.rim, torch.zeros_like(found.side), found.side)
    return finest.base.apply(side.unsqueeze(1).expand(-1, 3).contiguous())[:, 0].sign()
