"""Forces, and their sum for the integrator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import Any, Protocol, runtime_checkable

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from ..level import Level
from ..mesh.formula import SCALAR, VECTOR, block_size, kernel, native, one_by_one
from ..mesh.recorded import Recordings, Work
from ..mesh.stencil import incidence, vectors
from ..mesh.threads import Launch


@runtime_checkable
class Force(Protocol):
    """One term of the potential.

    A term computes its force by hand-written code; tests compare the force with finite differences of the energy.
    """

    name: str

    def add_force(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add -dE/dx [N] to ``force`` in place and return the energy E [J] as a float64 scalar."""
        ...

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """A third of the trace of each vertex's positive semi-definite Hessian block [N/m]."""
        ...

    def rest_springs(self) -> tuple[Any, Any]:
        """Springs in place of the term at rest [N/m]: the level's, shape (S,), and to fixed points, shape (V,); or 0.

        They are the term's scalar Hessian: its couplings along the level's springs, negated, and its row sums.
        """
        ...


def total_of(terms: Sequence[Force]) -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
    """A function of positions [m] and all `_aims_of` the terms: their energy [J], force [N], and each energy."""

    def total(x: Tensor, *aims: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        left, now = iter(aims), list[Any]()
        for each in terms:
            now.append(_aimed(each, tuple(islice(left, len(_aims_of(each))))))
        force, energy = torch.zeros_like(x), torch.zeros((), dtype=torch.float64, device=x.device)
        energies = [each.add_force(x, force) for each in now]
        for each in energies:
            energy = energy + each
        return energy, force, torch.stack(energies) if energies else energy.reshape(1)[:0]

    return total


def _aims_of(term: Any) -> tuple[Tensor, ...]:
    """A term's tensors that change from frame to frame, if any; ``term.aimed`` takes others."""
    return getattr(term, "aims", ())


def _aimed(term: Any, aims: tuple[Tensor, ...]) -> Any:
    """A term with other `_aims_of`."""
    return term.aimed(*aims) if aims else term


class ForceModule:
    """The sum of the terms of one frame.

    Attributes:
        forces: The terms, in order.
    """

    def __init__(self, forces: Sequence[Force], recordings: Recordings | None = None) -> None:
        """Keep the terms in order; the order fixes the rounding of the sum.

        Args:
            recordings: Of sums with the same terms but for their `aims`.
        """
        self.forces = tuple(forces)
        self._recordings = Recordings() if recordings is None else recordings
        names, aims = tuple(each.name for each in forces), [aim for each in forces for aim in _aims_of(each)]
        self._work = Work(names, total_of(self.forces), aims)

    def joined_by(self, more: Sequence[Force]) -> ForceModule:
        """This module's terms and more."""
        return ForceModule((*self.forces, *more), self._recordings)

    def energy_and_force(self, x: Float[Tensor, "vertices 3"]) -> tuple[Float[Tensor, ""], Float[Tensor, "vertices 3"]]:
        """Total energy [J], float64 scalar, and force [N] at positions x [m]."""
        energy, force, _ = self._work.run(self._recordings, x)
        return energy, force

    def energy_and_force_each(
        self, x: Float[Tensor, "vertices 3"], garments: int
    ) -> tuple[Float[Tensor, " garments"], Float[Tensor, "vertices 3"]]:
        """Energy of each garment [J], float64, and force [N] at positions x [m]; requires terms with `split`."""
        force = torch.zeros_like(x)
        energy = torch.zeros(garments, dtype=torch.float64, device=x.device)
        for term in self.forces:
            term.add_force(x, force)
            values, owner = term.split(x)  # pyright: ignore[reportAttributeAccessIssue]
            energy.index_add_(0, owner.long(), values.double())
        return energy, force

    def energies(self, x: Float[Tensor, "vertices 3"]) -> dict[str, float]:
        """Energy of each term [J] by name."""
        values = self._work.run(self._recordings, x)[2]
        return dict(zip((term.name for term in self.forces), values.tolist(), strict=True))

    def diagonal(self, x: Float[Tensor, "vertices 3"]) -> Float[Tensor, " vertices"]:
        """Sum of the terms' Hessian diagonals [N/m]."""
        return torch.stack([term.diagonal(x) for term in self.forces]).sum(dim=0)

    def rest_springs(self) -> tuple[Any, Any]:
        """Sums of the terms' springs at rest, as in `Force` [N/m], shapes (S,) and (V,)."""
        between, fixed = zip(*(term.rest_springs() for term in self.forces), strict=True)
        return sum(between), sum(fixed)


def _gather_kernel(dtype: torch.dtype) -> wp.Kernel:
    """The kernel of (first, starts, slots, corner_force, force) adding the corners' forces at each vertex [N]."""

    def of_vertex(vertex, starts, slots, corner_force, force): ...

    def gather(first, starts, slots, corner_force, force):
        add(first + wp.tid(), starts, slots, corner_force, force)

    source = """
    Scalar* f = (Scalar*)(force.data + vertex);
    Four total = three(f);
    for (int k = starts.data[vertex]; k < starts.data[vertex + 1]; ++k)
        total += *(const Four*)(corner_force.data + slots.data[k]);
    for (int i = 0; i < 3; ++i) f[i] = total[i];
    """
    kinds = [wp.array(dtype=kind) for kind in (wp.int32, wp.int32, VECTOR[dtype], VECTOR[dtype])]
    name = f"gather_corners_{SCALAR[dtype].__name__}"
    add = native(of_vertex, name, one_by_one(source, dtype), *kinds)
    return kernel(gather, name, *kinds)


_GATHER = {dtype: _gather_kernel(dtype) for dtype in VECTOR}


class Elements:
    """Elements of N corners, with buffers for their energies and corner forces.

    Element kernels write one force per corner, then each vertex gathers its corners: no two threads write to the same
    place and the order of each sum is fixed.

    Attributes:
        count: Number of elements.
        energy: Energy of each element [J], shape (count,).
        corner_force: Force on each corner [N], shape (count * N, 3).
    """

    def __init__(
        self,
        kernels: Mapping[torch.dtype, wp.Kernel],
        corners: Int[Tensor, "elements corners"],
        parameters: Sequence[Float[Tensor, " elements"] | Float[Tensor, "elements 4"]],
        *,
        level: Level,
        rows: tuple[Int[Tensor, " starts"], Int[Tensor, " slots"]] | None = None,
    ) -> None:
        """Prepare the launches, gather tables and buffers on the level's device.

        Args:
            kernels: The kernels of `element_kernels`.
            parameters: The kernel's two parameters.
            rows: The corners at each vertex, as of `incidence`, if known.
        """
        self.count, width = corners.shape
        dtype, device, threads = level.dtype, level.device, level.threads
        starts, slots = incidence(corners, level.vertex_count) if rows is None else rows
        # Not `contiguous`: an empty tensor keeps strides that Warp refuses.
        corners = corners.clone(memory_format=torch.contiguous_format)
        packed = wp.from_torch(corners, dtype=wp.types.vector(length=width, dtype=wp.int32))
        self.energy = torch.empty(self.count, dtype=dtype, device=device)
        # One more row: the gather reads four numbers at once.
        self.corner_force = torch.empty((self.count * width + 1, 3), dtype=dtype, device=device)[:-1]
        x = vectors(level.rest)
        arrays = [vectors(each) if each.ndim == 2 else wp.from_torch(each) for each in parameters]
        buffers = [wp.from_torch(self.energy), vectors(self.corner_force)]
        self._tensors = (corners, starts, slots, parameters)
        place: dict[str, Any] = {"device": device, "threads": threads}
        arrays = [x, packed, *arrays, *buffers]
        self._elements = Launch(kernels[dtype], self.count, arrays, at_once=block_size(device), **place)
        inputs = [wp.from_torch(starts), wp.from_torch(slots), buffers[1], x]
        self._gather = Launch(_GATHER[dtype], level.vertex_count, inputs, **place)

    def evaluate(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Run the element kernel and gather: adds to ``force`` and returns the energy.

        Args:
            x: Positions [m].
            force: Force [N], added to in place.

        Returns:
            Energy [J], float64 scalar.
        """
        if not self.count:
            return torch.zeros((), dtype=torch.float64, device=x.device)
        self._elements({0: vectors(x)})
        self._gather({3: vectors(force)})
        return self.energy.sum(dtype=torch.float64)
