"""Every kind of mutation; a mutant's number picks one in turn."""

from . import attributes, composed, files, meshes, odd, poses, records, shown, wholes

KINDS = (
    *files.KINDS,
    *attributes.KINDS,
    *meshes.KINDS,
    *wholes.KINDS,
    *odd.KINDS,
    *records.KINDS,
    *shown.KINDS,
    *composed.KINDS,
    *poses.KINDS,
)
