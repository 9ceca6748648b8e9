"""Every kind of mutation; a mutant's number picks one in turn."""

from __future__ import annotations

from . import files, instances, meshes, odd, records, shown, values, wholes

KINDS = (
    *files.KINDS,
    *meshes.KINDS,
    *values.KINDS,
    *wholes.KINDS,
    *instances.KINDS,
    *odd.KINDS,
    *records.KINDS,
    *shown.KINDS,
)
