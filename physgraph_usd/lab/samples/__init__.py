"""Small generated shots showing the purpose of refinement.

Each sample is one module with a ``build`` function that returns a plain record of the shot. Imports are deferred, so
that listing the names costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from ...errors import UsageError

SAMPLES: dict[str, str] = {
    "sleeve": "a triangulated tube, compressed by a fifth and twisted",
    "skirt": "a flared skirt on turning hips, with a collider",
    "tshirt": "quads with UVs, two materials and skinning that shows the armpit artefact",
    "trims": "the T-shirt with a render mesh that has thickness, buttons and piping",
    "flag": "quads in the wind, pinned on one edge, no collider",
    "dancer": "a dress with a wide skirt on a person who turns on one foot",
    "frozen": "a cloth draped over a table, twelve equal samples",
    "armpit": "a T-shirt pinched between the side and an arm that goes down and up again",
    "layers": "trousers, a shirt over them and a belt over both, on a body that walks in place",
    "overcoat": "a coat over a shirt, skinned apart: their cages cross a thousand times",
    "block": "a sheet dropped over a block, folding at its corners",
    "torus": "a sheet pulled through a torus by a grip on its middle",
    "hood": "a wide hood over a turning head, with a fold that lies on itself",
    "crossing": "two hanging sheets whose lower ends start on the wrong sides of one another",
    "swatch": "a small hanging swatch whose top edge is gathered, metres, Y up",
    "swatch_cm": "the swatch in centimetres",
    "swatch_zup": "the swatch with Z up",
    "swatch_lefthanded": "the swatch with faces that run clockwise",
}
"""Sample names, each with a description."""


def write_sample(name: str, directory: Path, *, overwrite: bool = False) -> Path:
    """Write one of ``SAMPLES`` as ``<directory>/<name>.usdc``, and return that path; missing folders are made.

    Raises:
        UsageError: When no sample has that name, or the file exists and may not be replaced.
        LayerError: When the file cannot be written.
    """
    if name not in SAMPLES:
        raise UsageError(f"unknown sample {name!r}; known samples: {', '.join(SAMPLES)}")
    module, _, variant = name.partition("_")
    build = import_module(f".{module}", __package__).build
    record = build(variant) if variant else build()
    from ...usd.write.sample_stage import write_stage  # noqa: PLC0415

    return write_stage(record, Path(directory) / f"{name}.usdc", overwrite=overwrite)
