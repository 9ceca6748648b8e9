"""Forces, and their sum for the integrator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
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


def total_of(terms: Sequence[Force], assembly: Assembly | None = None) -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
    """A function of positions [m] and all `_aims_of` the terms: their energy [J], force [N], and each energy.

    Args:
        terms: The terms.
        assembly: Joint sum of the elements of the first terms, or None.
    """
    assembled = () if assembly is None else assembly.kinds

    def total(x: Tensor, *aims: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        unused, aimed_terms = iter(aims), list[Any]()
        for term in terms:
            aimed_terms.append(_aimed(term, tuple(islice(unused, len(_aims_of(term))))))
        if assembly is None:
            force, first = torch.zeros_like(x), {}
        else:
            force = torch.empty_like(x)
            first = dict(zip(map(id, assembled), assembly.evaluate(x, force, adds=False), strict=True))
        energies = list[Tensor]()
        for term in aimed_terms:
            summed = [first[id(kind)] for kind in _elements_of(term) if id(kind) in first]
            energies.append(sum(summed[1:], summed[0]) if summed else term.add_force(x, force))
        values = torch.stack(energies) if energies else x.new_zeros(0, dtype=torch.float64)
        return values.sum(), force, values

    return total


def _elements_of(term: Any) -> tuple[Elements, ...]:
    """The kinds of elements of a term; () for terms of other kinds."""
    return getattr(term, "elements", ())


def assembly_of(terms: Sequence[Force], level: Level) -> Assembly | None:
    """The joint sum of the elements of terms that last; None for terms without elements."""
    kinds = [kind for term in terms for kind in _elements_of(term) if len(kind.corners)]
    return Assembly(kinds, level) if kinds else None


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

    def __init__(
        self, forces: Sequence[Force], recordings: Recordings | None = None, assembly: Assembly | None = None
    ) -> None:
        """Keep the terms in order; the order fixes the rounding of the sum.

        Args:
            recordings: Of sums with the same terms but for their `aims`.
            assembly: As for `total_of`.
        """
        self.forces = tuple(forces)
        self._recordings = Recordings() if recordings is None else recordings
        names, aims = tuple(term.name for term in forces), [aim for term in forces for aim in _aims_of(term)]
        self._assembly = assembly
        self._work = Work(names, total_of(self.forces, assembly), aims)

    def joined_by(self, terms: Sequence[Force]) -> ForceModule:
        """The sum of this module's terms and further terms."""
        return ForceModule((*self.forces, *terms), self._recordings, self._assembly)

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


def _sum_kernel(name: str, source: str, dtype: torch.dtype) -> wp.Kernel:
    """A kernel of (first, adds, parts, count, starts, slots, forces, force) adding up forces at each vertex [N]."""

    def of_vertex(vertex, adds, parts, count, starts, slots, forces, force): ...

    def sum_up(first, adds, parts, count, starts, slots, forces, force):
        add(first + wp.tid(), adds, parts, count, starts, slots, forces, force)

    source = f"""
    Scalar* f = (Scalar*)(force.data + vertex);
    Four total = adds ? three(f) : Four{{}};
    {source}
    for (int i = 0; i < 3; ++i) f[i] = total[i];
    """
    kinds = *[wp.int32] * 3, *(wp.array(dtype=kind) for kind in (wp.int32, wp.int32, VECTOR[dtype], VECTOR[dtype]))
    full = f"{name}_{SCALAR[dtype].__name__}"
    add = native(of_vertex, full, one_by_one(source, dtype), *kinds)
    return kernel(sum_up, full, *kinds)


_OF_PARTS = "for (int p = 0; p < parts; ++p) total += ((const Four*)forces.data)[p * count + vertex];"
_OF_CORNERS = """
for (int k = starts.data[vertex]; k < starts.data[vertex + 1]; ++k)
    total += *(const Four*)(forces.data + slots.data[k]);
"""
ELEMENT_PARTS, LEAST_PARTED = 2, 8192
"""Parts of many elements on a CPU, each with its own sums, and thus most threads: as many whatever the threads, so that
the sums round alike. And the fewest elements in several parts: to zero and add up the sums of a part takes as long as
some thousand elements."""
_SUM = {
    (on_card, dtype): _sum_kernel(name, source, dtype)
    for on_card, name, source in ((True, "gather_corners", _OF_CORNERS), (False, "add_parts", _OF_PARTS))
    for dtype in VECTOR
}


class Elements:
    """Elements of N corners, and the kernel of their energies and forces.

    Attributes:
        kernels: The kernels of `element_kernels`.
        corners: Vertices of each element, shape (count, N).
        parameters: The kernel's two parameters.
        level: The level of the vertices.
        rows: The corners at each vertex, as of `incidence`, if known; or None.
        energy: Energy of each element at the positions of the last `evaluate` [J], shape (count,).
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
        """Take the elements."""
        # Not `contiguous`: an empty tensor keeps strides that Warp refuses.
        self.kernels, self.corners = kernels, corners.clone(memory_format=torch.contiguous_format)
        self.parameters, self.level, self.rows = parameters, level, rows
        self.energy = torch.empty(len(corners), dtype=level.dtype, device=level.device)

    @cached_property
    def _assembly(self) -> Assembly:
        return Assembly([self], self.level, energies=True)

    def evaluate(self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"]) -> Float[Tensor, ""]:
        """Add the forces [N] to ``force`` and return the energy [J], a float64 scalar, at positions x [m]."""
        return self._assembly.evaluate(x, force)[0]


class Assembly:
    """The sum of the forces of several kinds of elements.

    On a CPU the elements are in `ELEMENT_PARTS` parts, and each part adds to its own forces, which fit into a cache. On
    CUDA element kernels write one force per corner, then each vertex gathers its corners. Either way no two threads
    write to the same place and the order of each sum is fixed.

    Attributes:
        kinds: The elements.
    """

    def __init__(self, kinds: Sequence[Elements], level: Level, *, energies: bool = False) -> None:
        """Prepare the launches, tables and buffers on the level's device.

        Args:
            kinds: The elements.
            energies: Whether to write the energy of each element.
        """
        self.kinds = tuple(kinds)
        dtype, device, count = level.dtype, level.device, level.vertex_count
        on_card, size = device != "cpu", block_size(device)
        none = torch.zeros(1, dtype=torch.int32, device=device)
        self._tables = _corners_at(kinds, count) if on_card else (none, none)
        # On CUDA one more row: the gather reads four numbers at once.
        parts = ELEMENT_PARTS if sum(len(kind.corners) for kind in kinds) >= LEAST_PARTED else 1
        rows = (sum(kind.corners.numel() for kind in kinds) + 1, 3) if on_card else (parts * count, 4)
        self._forces = torch.zeros(rows, dtype=dtype, device=device)
        flat = self._forces.reshape(-1)[: self._forces.numel() // 3 * 3].reshape(-1, 3)
        self._totals, self._launches, begin, x = list[Tensor](), list[Launch](), 0, vectors(level.rest)
        for kind in kinds:
            blocks = -(-len(kind.corners) // size)
            of_part = 1 if on_card else -(-blocks // parts)
            items = -(-blocks // max(of_part, 1))
            self._totals.append(torch.zeros(items, dtype=torch.float64, device=device))
            packed = wp.from_torch(kind.corners, dtype=wp.types.vector(length=kind.corners.shape[1], dtype=wp.int32))
            numbers = [vectors(values) if values.ndim == 2 else wp.from_torch(values) for values in kind.parameters]
            energy = wp.from_torch(kind.energy) if energies else wp.array(dtype=SCALAR[dtype], device=device)
            forces = flat[begin:] if on_card else flat
            arrays = [x, packed, *numbers, energy, wp.from_torch(self._totals[-1]), vectors(forces)]
            inputs = [of_part, blocks, len(kind.corners), count, *arrays]
            self._launches.append(Launch(kind.kernels[dtype], items, inputs, device=device, threads=level.threads))
            begin += kind.corners.numel()
        inputs = [1, parts, count, *(wp.from_torch(table) for table in self._tables), vectors(flat), x]
        self._sum = Launch(_SUM[on_card, dtype], count, inputs, device=device, threads=level.threads)

    def evaluate(
        self, x: Float[Tensor, "vertices 3"], force: Float[Tensor, "vertices 3"], *, adds: bool = True
    ) -> list[Float[Tensor, ""]]:
        """Compute all elements.

        Args:
            x: Positions [m].
            force: The forces [N], written in place.
            adds: Whether to add to the present values of ``force``.

        Returns:
            Energy of each kind of elements [J], float64 scalars.
        """
        if not self._forces.is_cuda:
            self._forces.zero_()
        for launch in self._launches:
            launch({4: x})
        self._sum({0: int(adds), 6: force})
        return [totals.sum() for totals in self._totals]


def _corners_at(kinds: Sequence[Elements], count: int) -> tuple[Tensor, Tensor]:
    """The corners of all elements at each of so many vertices, as of `incidence`."""
    if len(kinds) == 1 and kinds[0].rows is not None:
        return kinds[0].rows
    return incidence(torch.cat([kind.corners.reshape(-1) for kind in kinds]).unsqueeze(1), count)
