"""Contact of one group of garments with the bodies of one frame: near vertices and their contact planes.

A closest-point query costs about as much as a force evaluation, so queries are few. A vertex at distance d that has
moved by m is still at least d - m away. Only vertices for which d - m is less than the offset plus the expected move of
a round are queried again. The bound also tells which vertices may have changed sides.
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
"""Move of a vertex after which its contact plane is found anew, in edge lengths."""


@dataclass(frozen=True, eq=False)
class Touching:
    """A surface that a group may touch.

    Attributes:
        path: Prim path of the collider.
        surface: The posed surface.
        offset: Distance kept by each garment of the group [m]; minus infinity if the garment ignores the surface.
    """

    path: str
    surface: Surface
    offset: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class LevelBodies:
    """One level's view of the bodies. Immutable: methods that refine the distances return a new view.

    Attributes:
        level: The level.
        tracks: Cached distances to each surface.
        settings: Contact settings, with the stiffness in SI.
        seam: Sewn vertices, kept together when bodies push; None without seams.
        sights: Contact planes of the vertices last found on each surface; empty before the first look.
    """

    level: Level
    tracks: tuple[Track, ...]
    settings: ContactSettings
    seam: Seam | None = None
    sights: tuple[Sight, ...] = ()

    def seen(self, x: Float[Tensor, "vertices 3"]) -> tuple[LevelBodies, Contact | None]:
        """The view from positions x [m], and the contact force there, or None if nothing can touch."""
        before = self.sights or [Sight.none(x)] * len(self.tracks)
        looks = [self._look(*each, x) for each in zip(self.tracks, before, strict=True)]
        tracks, sights = tuple(track for track, _ in looks), tuple(sight for _, sight in looks)
        planes = [sight.planes() for sight in sights]
        there = any(len(each.vertex) for each in planes)
        force = Contact(self.level, planes, self.settings.stiffness) if there else None
        return replace(self, tracks=tracks, sights=sights), force

    def _look(self, track: Track, known: Sight, x: Tensor) -> tuple[Track, Sight]:
        """Distances and contact planes of one body at x [m]; planes are kept for moves of up to `STALE` edges."""
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
        """Masks of the vertices inside closed bodies at x [m] and of the pinched vertices among them."""
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
        """View that does not push out cloth between overlapping parts of a body at x [m] while the cloth stays inside.

        Such cloth is a patch of vertices with buried closest faces, some of them inside two parts at once. Pushed out,
        the patch would fold through its neighbours, which leave on the opposite side.
        """
        tracks = []
        for track in self.tracks:
            between, in_two = track.between(x)
            lost = self._patches(between, between[in_two]) if bool(in_two.any()) else None
            tracks.append(replace(track, lost=lost))
        return replace(self, tracks=tuple(tracks))

    def _patches(self, some: Tensor, seeds: Tensor) -> Bool[Tensor, " vertices"]:
        """Connected patches of the given vertices that contain a seed."""
        kept, wanted = (torch.zeros_like(self.level.free[:, 0]) for _ in range(2))
        kept[some], wanted[seeds] = True, True
        masks = (each.cpu().numpy() for each in (kept, wanted))
        return torch.as_tensor(patches_with(self.level.edges.cpu().numpy(), *masks), device=kept.device)


@dataclass(frozen=True, eq=False)
class FrameBodies:
    """Bodies of a group in one frame.

    Attributes:
        touching: The surfaces.
        tracks: Cached distances from the upsampled cage to each surface.
        settings: Contact settings, with the stiffness in SI.
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
            levels: Levels of the group.
            touching: The surfaces.
            coarse: Cage positions [m], recentred.
            origin: World position of the group's origin [m], shape (3,).
            settings: Contact settings, with the stiffness in SI.
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
        """Mean depth [m] and body path of each garment of the finest level that is wholly inside a body."""
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
        """Penetrations and crossings of each body before and after the solve, as plain values.

        Args:
            finest: The finest level.
            base: The upsampled cage [m].
            x: The result [m].
            view: The finest level's view of the bodies; None if the solve ignored the bodies.
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
        """The view of one level, whose vertices are the first of each garment's vertices in the finest level."""
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
    """Side of the surface on which the cage around each fine vertex lies: 1 or -1; 0 if undecided or meaningless."""
    if surface.closed or surface.fixed_side is not None:
        return torch.full((finest.vertex_count,), surface.fixed_side or 0.0, dtype=cage.dtype, device=cage.device)
    found = surface.closest(cage, torch.full_like(cage[:, 0], float("inf")))
    side = torch.where(found.rim, torch.zeros_like(found.side), found.side)
    return finest.base.apply(side.unsqueeze(1).expand(-1, 3).contiguous())[:, 0].sign()
