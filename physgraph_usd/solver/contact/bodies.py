"""Contact of one group of garments with the bodies of one frame: who is near, and the planes they see.

Closest points cost about as much as a force evaluation, so they are asked for seldom and for few vertices. Distances
change no faster than vertices move: a vertex that was d away and has moved by m is at least d - m away, and only those
for which that is less than the offset and the move expected of a round are asked again. The same bound tells which may
have changed sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..colliders.base import Surface
from ..colliders.sign import signed_and_closest, signed_distances
from ..forces.contact import Contact
from ..forces.seam import Seam
from ..level import Level
from ..mesh.topology import patches_with
from .measure import depths, penetration
from .settings import ContactSettings
from .sight import Sight
from .track import Track

STALE = 0.1
"""How far a vertex moves before the plane that it sees is found anew, in edge lengths."""


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


@dataclass(frozen=True, eq=False)
class LevelBodies:
    """One level's view of the bodies, a value: what learns more of the distances returns a new one.

    Attributes:
        level: The level.
        tracks: What is known of the distances to each surface.
        settings: How contact is solved, with k_c itself as its stiffness.
        seam: What is sewn together, and stays so where bodies push; or None without seams.
        sights: The planes that vertices saw last in each surface; empty before the first look.
    """

    level: Level
    tracks: tuple[Track, ...]
    settings: ContactSettings
    seam: Seam | None = None
    sights: tuple[Sight, ...] = ()

    def seen(self, x: Float[Tensor, "vertices 3"]) -> tuple[LevelBodies, Contact | None]:
        """The view from positions x [m], and the contact force near them, or None where nothing can touch."""
        before = self.sights or [Sight.none(x)] * len(self.tracks)
        looks = [self._look(*each, x) for each in zip(self.tracks, before, strict=True)]
        tracks, sights = tuple(track for track, _ in looks), tuple(sight for _, sight in looks)
        planes = [sight.planes() for sight in sights]
        there = any(len(each.vertex) for each in planes)
        force = Contact(self.level, planes, self.settings.stiffness) if there else None
        return replace(self, tracks=tracks, sights=sights), force

    def _look(self, track: Track, known: Sight, x: Tensor) -> tuple[Track, Sight]:
        """What is seen of one body; planes of vertices that have hardly moved stay."""
        still = known.there & ((x - known.at).norm(dim=1) <= STALE * self.level.spacing)
        reach = track.offset + float(self.level.spacing.mean())
        asked = torch.where(still, torch.full_like(reach, -torch.inf), reach)
        track, vertex, normal, signed = track.refresh(x, asked)
        near = torch.nonzero(signed < reach[vertex]).squeeze(1)
        vertex, normal, signed = vertex[near], normal[near], signed[near]
        sight = known.renewed(
            x,
            still,
            vertex=vertex,
            normal=normal,
            signed=signed,
            offset=track.offset[vertex],
        )
        return track, sight

    def within(self, x: Float[Tensor, "vertices 3"]) -> tuple[Bool[Tensor, " vertices"], Bool[Tensor, " vertices"]]:
        """Vertices inside closed bodies at x [m], and those of them that are pinched."""
        inside, held = (torch.zeros_like(self.level.free[:, 0]) for _ in range(2))
        for track in self.tracks:
            at = x + track.shift
            asked, reach = (track.surface, at, self.level.edges), float(self.level.spacing.mean())
            signed = track.known if torch.equal(x, track.at) else signed_distances(*asked, reach=reach)
            signed = torch.where(track.offset.isfinite(), signed, signed.abs())
            depth, pinned = depths(track.surface, at, signed, track.longest)
            inside |= depth > 0
            held |= pinned
        return inside, held

    def losing(self, x: Float[Tensor, "vertices 3"]) -> LevelBodies:
        """The same, which leaves cloth that is between overlapping parts of a body at x [m] to itself while inside.

        It is a patch of vertices whose closest faces are buried, some of them inside two parts at once. Pushed out, it
        would fold through its neighbours, whose way out is on the other side.
        """
        tracks = []
        for track in self.tracks:
            between, in_two = track.between(x)
            lost = self._patches(between, between[in_two]) if bool(in_two.any()) else None
            tracks.append(replace(track, lost=lost))
        return replace(self, tracks=tuple(tracks))

    def _patches(self, some: Tensor, seeds: Tensor) -> Bool[Tensor, " vertices"]:
        """Of some vertices, by number, the connected patches that hold a seed."""
        kept, wanted = (torch.zeros_like(self.level.free[:, 0]) for _ in range(2))
        kept[some], wanted[seeds] = True, True
        masks = (each.cpu().numpy() for each in (kept, wanted))
        return torch.as_tensor(patches_with(self.level.edges.cpu().numpy(), *masks), device=kept.device)


@dataclass(frozen=True, eq=False)
class FrameBodies:
    """A group's bodies in one frame.

    Attributes:
        touching: The surfaces.
        tracks: What is known of the distances of the upsampled cage to each.
        settings: How contact is solved, with k_c itself as its stiffness.
    """

    touching: tuple[Touching, ...]
    tracks: tuple[Track, ...]
    settings: ContactSettings

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
        tracks = []
        for each in touching:
            shift = torch.as_tensor(origin - each.surface.origin).to(base)
            offset = torch.as_tensor(each.offset).to(base)[finest.vertex_garment.long()]
            reach = float(offset.max()) + float(levels[0].spacing.mean())
            known, closest = signed_and_closest(each.surface, base + shift, finest.edges, reach=reach)
            feels = offset.isfinite()
            known = torch.where(feels, known, torch.full_like(known, float("inf")))
            closest = closest if bool(feels.all()) else None
            side = _start_sides(each.surface, coarse + shift, finest)
            longest = settings.way_out * float(levels[0].spacing.mean())
            tracks.append(Track(each.surface, shift, offset, side, base, known, longest, inside=closest))
        return FrameBodies(tuple(touching), tuple(tracks), settings)

    def depths(self, finest: Level) -> list[tuple[float, str]]:
        """For each garment of the finest level that is wholly in a body, how deep on the mean [m], and in which."""
        found = [(0.0, "")] * len(finest.spans)
        for each, track in zip(self.touching, self.tracks, strict=True):
            for index, span in enumerate(finest.spans):
                if each.surface.closed and span.stop > span.start and bool((track.known[span] < 0).all()):
                    x = track.at[span] + track.shift
                    near = each.surface.closest(x, torch.full_like(x[:, 0], float("inf")))
                    found[index] = max(found[index], (float(near.distance.mean()), each.path))
        return found

    def measure(
        self,
        finest: Level,
        base: Float[Tensor, "vertices 3"],
        x: Float[Tensor, "vertices 3"],
        *,
        view: LevelBodies | None = None,
    ) -> dict[str, object]:
        """What is in each body and what crosses it, before and after, as plain values.

        Args:
            finest: The finest level.
            base: The upsampled cage [m].
            x: The result [m].
            view: Its level's view of the bodies; None where they were not felt.
        """
        bodies: dict[str, object] = {}
        for index, (each, track) in enumerate(zip(self.touching, self.tracks, strict=True)):
            surface, at, last = each.surface, x + track.shift, track if view is None else view.tracks[index]
            # What was farther outside a closed surface than it moved since still is; of an open one it may be behind.
            least = last.least(x) if surface.closed else None
            signed = signed_distances(surface, at, finest.edges, reach=float(finest.spacing.max()), least=least)
            signed = torch.where(track.offset.isfinite(), signed, torch.full_like(signed, float("inf")))
            longest = track.longest
            before = penetration(surface, finest, base + track.shift, track.known, longest=longest, inside=track.inside)
            after = penetration(surface, finest, at, signed, longest=longest, lost=last.lost)
            name = each.path if surface.closed else f"{each.path} (open part)"
            bodies[name] = {"before": asdict(before), "after": asdict(after)}
        return {"bodies": bodies}

    def at(self, level: Level, finest: Level) -> LevelBodies:
        """The view of one level; its vertices come first among each garment's finest ones."""
        pairs = zip(level.spans, finest.spans, strict=True)
        places = [torch.arange(fine.start, fine.start + own.stop - own.start) for own, fine in pairs]
        which = torch.cat(places).to(level.rest.device)
        tracks = [
            replace(
                t,
                inside=t.inside if level is finest else None,
                **{name: getattr(t, name)[which] for name in ("offset", "side", "at", "known")},
            )
            for t in self.tracks
        ]
        return LevelBodies(level, tuple(tracks), self.settings)


def _start_sides(surface: Surface, cage: Float[Tensor, "coarse 3"], finest: Level) -> Float[Tensor, " vertices"]:
    """The side on which the cage around each fine vertex lies: 1 or -1, 0 where it is undecided or has no meaning."""
    if surface.closed or surface.fixed_side is not None:
        return torch.full((finest.vertex_count,), surface.fixed_side or 0.0, dtype=cage.dtype, device=cage.device)
    found = surface.closest(cage, torch.full_like(cage[:, 0], float("inf")))
    side = torch.where(found.rim, torch.zeros_like(found.side), found.side)
    return finest.base.apply(side.unsqueeze(1).expand(-1, 3).contiguous())[:, 0].sign()
