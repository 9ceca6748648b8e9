"""How far the cage's edges are from their median lengths in each rest shape that a garment could have.

python -m benchmarks.rest SHOT... [--garment PATH]
"""

from __future__ import annotations

import argparse
import sys
from contextlib import closing

import numpy as np

from physgraph_usd.usd.read.reader import open_shot
from physgraph_usd.usd.read.rest import MOST_FITTED


def main() -> None:
    """Print one row a garment and rest shape: percentiles of length over median length, less one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shots", nargs="+")
    parser.add_argument("--garment", action="append", default=[])
    given = parser.parse_args()
    for shot in given.shots:
        with closing(open_shot(shot, garments=given.garment)) as plain:
            with closing(open_shot(shot, garments=given.garment, rest_frame="auto")) as auto:
                fitted = [garment.rest for garment in auto.scene.garments]
            times = plain.scene.times
            picks = np.linspace(0, len(times) - 1, min(MOST_FITTED, len(times))).round().astype(int)
            frames = [plain.frame(times[pick]) for pick in picks]
            for index, garment in enumerate(plain.scene.garments):
                ends = garment.mesh.half_edges.edges
                poses = [frame.garments[index].points for frame in frames]
                lengths = np.array([_lengths(pose, ends) for pose in poses])
                median = np.median(lengths, axis=0)
                nearest = poses[int(np.abs(lengths - median).sum(axis=1).argmin())]
                shapes = {"by default": garment.rest, "nearest frame": nearest, "auto": fitted[index]}
                for name, shape in shapes.items():
                    low, high = np.percentile(_lengths(shape, ends) / median - 1.0, [1, 99])
                    sys.stdout.write(f"{shot} {garment.path} {name}: {low:+.1%} to {high:+.1%}\n")


def _lengths(points: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)


if __name__ == "__main__":
    main()
