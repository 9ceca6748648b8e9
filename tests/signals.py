"""Signals at random moments of `refine`, `refine` of several shots, `stitch` and `tune`: when and how each run ends.

    python -m tests.signals            40 signals, some ten minutes
    python -m tests.signals --short    8 signals

Prints a line a signal and fails where a run goes on for longer than `MOST_SECONDS`, or than its longest frame where
that is more, or ends with another code than a shell's for the signal.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

MOST_SECONDS = 2.0
"""Seconds after which a user takes a run for hung."""
COMMAND = (sys.executable, "-m", "physgraph_usd")
SIGNALS = (signal.SIGTERM, signal.SIGINT)


def commands(folder: Path) -> dict[str, list[str]]:
    """The commands by name, of sample shots that are made in a folder."""
    shot = subprocess.run([*COMMAND, "sample", "sleeve", "-o", folder], capture_output=True, text=True, check=True)
    sleeve, chunks = shot.stdout.strip(), folder / "chunks"
    chunks.mkdir()
    for frames in ("1:3", "4:6"):
        part = ["--preroll", "2", "--frames", frames, "-o", chunks / frames[0]]
        subprocess.run([*COMMAND, "refine", sleeve, *part], capture_output=True, check=True)
    copy = folder / "copy.usda"
    copy.write_text(f"#usda 1.0\n(\n subLayers = [@{sleeve}@]\n)\n", encoding="utf-8")
    out = ["-o", str(folder / "out"), "--overwrite"]
    stitched = ["-o", str(folder / "all.usdc"), "--overwrite", "--frames", "1:6"]
    return {
        "refine": ["refine", sleeve, *out],
        "batch": ["refine", sleeve, str(copy), *out, "--workers", "2"],
        "stitch": ["stitch", str(chunks), *stitched],
        "tune": ["tune", sleeve, "-o", str(folder / "tuned.usda"), "--overwrite"],
    }


def ends(line: list[str], number: signal.Signals, delay: float) -> tuple[int, float] | None:
    """Exit code as a shell reports it, and the seconds from signal to end; None where the run was over before."""
    process = subprocess.Popen([*COMMAND, *line], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(delay)
        return None
    except subprocess.TimeoutExpired:
        began = time.monotonic()
        process.send_signal(number)
        code = process.wait(120)
        return (128 - code if code < 0 else code), time.monotonic() - began
    finally:
        process.kill()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true")
    count = 8 if parser.parse_args().short else 40
    signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell lets its background jobs ignore Ctrl-C.
    rng, lines, wrong = np.random.default_rng(0), [], 0
    with tempfile.TemporaryDirectory() as folder:
        known = list(commands(Path(folder)).items())
        while len(lines) < count:
            name, line = known[len(lines) % len(known)]
            number, delay = SIGNALS[len(lines) // len(known) % 2], float(rng.uniform(0.3, 12.0))
            found = ends(line, number, delay)
            if found is None:
                continue
            code, seconds = found
            good = code == 128 + number and seconds <= MOST_SECONDS
            wrong += not good
            lines.append(f"{name:7s} {number.name} after {delay:4.1f} s: code {code}, {seconds:.2f} s later")
            sys.stdout.write(lines[-1] + ("\n" if good else "  WRONG\n"))
            sys.stdout.flush()
    sys.stdout.write(f"{count - wrong} of {count} right\n")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
