"""The commands beside ``refine``."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click

from ..errors import UsageError
from ..interrupts import signals_noted
from ..shot.plain_json import to_json
from ..solver.fabric import PRESETS
from .options import (
    config_option,
    json_option,
    of_field,
    out_option,
    overwrite_option,
    scene_options,
    shot_argument,
    together,
)
from .printing import outline, print_progress
from .refine import refine
from .show_file import values_for
from .structure import DONE, FAILED, imports_uncollected
from .types import FRAME_RANGE, PICTURE_SIZE

PRIMS = "Prim path, glob or collection; repeatable."
session_options = together(
    click.option(
        "-o", "--out", type=click.Path(path_type=Path), help="Layer to save into.  [default: SHOT.tuned.usda]"
    ),
    of_field("garments"),
    of_field("colliders"),
    of_field("bind"),
    of_field("device"),
    overwrite_option,
)


@click.command()
@click.argument("chunks", nargs=-1, required=True, metavar="CHUNK...", type=click.Path(path_type=Path))
@out_option("LAYER", "Layer to write.", required=False)
@click.option("--check-seams", is_flag=True, help="Look at the seams of those there, and write nothing.")
@click.option("--frames", type=FRAME_RANGE, help="Time codes that must be there.  [default: all of the shot]")
@click.option(
    "--seam-bound",
    type=click.FloatRange(min=0),
    metavar="EDGES",
    default=0.05,
    help="Most that a seam may move, RMS, in mean fine edge lengths.",
)
@click.option("--shot", type=click.Path(dir_okay=False), help="The shot where it is not where the chunks say.")
@click.option(
    "--report",
    "report_to",
    type=click.Path(path_type=Path),
    metavar="FILE.json|DIR",
    help="Write one report of all frames.",
)
@click.option("--root", type=click.Path(path_type=Path), help="Also write a .usda with the layer over the shot.")
@overwrite_option
def stitch(chunks: tuple[Path, ...], out: Path | None, *, check_seams: bool, seam_bound: float, **options: Any) -> None:
    """Join each CHUNK of a shot, a folder as refine --preroll leaves it, into one layer and print its path.

    A folder of chunks stands for all in it. How far each seam moves goes to stderr. Exits with 3 where a frame failed.
    """
    with signals_noted():
        with imports_uncollected():
            from ..shot import stitch as chunk

        if check_seams:
            for seam in chunk.check_seams(chunks, seam_bound=seam_bound, shot=options["shot"]):
                click.echo(seam, err=True)
            return
        if out is None:
            raise UsageError("give a layer to write by -o, or --check-seams")
        report, seams = chunk.stitch(chunks, out, seam_bound=seam_bound, **options)
        for seam in seams:
            click.echo(seam, err=True)
    click.echo(out)
    sys.exit(report.exit_code)


@click.command()
@shot_argument
@scene_options
@config_option
@click.option(
    "--time",
    "timed",
    is_flag=True,
    help="Also solve three frames, and say what the whole shot takes and how far from rest its frames end.",
)
@json_option
@click.pass_context
def inspect(ctx: click.Context, shot: str, *, as_json: bool, timed: bool, **options: Any) -> None:
    """Print what would be refined, with what, from where, and every defect found in SHOT.

    Exits with 1 when SHOT cannot be refined as asked, with 2 when what was named is not there.
    """
    with imports_uncollected():
        from ..shot.refine import inspect_shot

    values, _ = values_for(ctx, shot, refine)
    found = inspect_shot(shot, timed=timed, **{name: values[name] for name in options if name != "config"})
    click.echo(to_json(found) if as_json else "\n".join(outline(found)))
    sys.exit(found.get("exit_code", DONE))


@click.command()
@shot_argument
@out_option("OUT", "Layer to write.")
@of_field("garments", help=PRIMS)
@of_field("colliders", help=PRIMS, metavar="PATH")
@of_field("bind")
@click.option("--preset", metavar="FABRIC", help=f"Fabric of the garments, or of all tagged: {', '.join(PRESETS)}.")
@click.option("--side", metavar="SIDE", help="Side of the colliders: auto, winding, start, front or back.")
@of_field("asset_paths")
@overwrite_option
def tag(shot: str, out: Path, *, garments: tuple[str, ...], colliders: tuple[str, ...], **options: Any) -> None:
    """Write a layer over SHOT that marks garments, colliders and targets for refine."""
    from ..usd.write.tag import tag as tag_shot

    values = {name: value for name, value in options.items() if value is not None}
    click.echo(tag_shot(shot, out, garments=garments, colliders=colliders, **values))


@click.command()
@shot_argument
@session_options
def live(shot: str, **options: Any) -> None:
    """Solve frames of SHOT for another program, which sends values as lines of JSON on standard input.

    Each answer is a line of JSON on standard output; physgraph_usd/studio/live.py describes both. Ends with the input.
    With - for SHOT the solver is loaded first, and the first line of the input is a list of the arguments.
    """
    with signals_noted():
        with imports_uncollected():
            from ..studio.live import answers_alone, lines_of, serve
            from ..studio.session import TuneSession

        lines = lines_of(sys.stdin.fileno())
        if shot == "-":
            line = next(lines, None)
            if line is None:
                return
            options = dict(live.make_context("live", _words(line)).params)
            shot = options.pop("shot")
        with answers_alone() as stream, closing(TuneSession(shot, **options)) as session:
            if session.warning:
                click.echo(f"warning: {session.warning}", err=True)
            serve(session, stream, lines)


def _words(line: bytes) -> list[str]:
    """Arguments from a line of JSON."""
    try:
        words = json.loads(line)
    except ValueError as error:
        raise UsageError(f"cannot read the arguments: {error}") from error
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise UsageError(f"the arguments are {words!r}, not a list of strings")
    return words


@click.command()
@shot_argument
@session_options
@click.option("--port", type=int, default=8080, help="Port on this machine; the next free one where it is taken.")
def tune(shot: str, *, port: int, **options: Any) -> None:
    """Show SHOT in the browser, with sliders for each garment's values; Save writes them as tag does.

    Prints the page's address, and serves it to this machine alone until it is interrupted.
    """
    with signals_noted():
        with imports_uncollected():
            from ..studio.page import serve
            from ..studio.session import TuneSession

        with closing(TuneSession(shot, **options)) as session:
            if session.warning:
                click.echo(f"warning: {session.warning}", err=True)
            serve(session, port=port, say=click.echo)


@click.command()
@click.argument("layer", type=click.Path(dir_okay=False))
@click.option(
    "--shot", type=click.Path(dir_okay=False), help="The shot it goes over.  [default: the one the layer names]"
)
@json_option
def validate(layer: str, *, shot: str | None, as_json: bool) -> None:
    """Check a refined LAYER by our rules and by USD's own validators; exit with 1 when it breaks one."""
    from ..usd.check.validate import validate_layer

    problems = validate_layer(layer, shot)
    if as_json:
        click.echo(to_json([asdict(problem) for problem in problems]))
    else:
        for problem in problems:
            click.echo(problem)
    sys.exit(FAILED if any(problem.severity == "error" for problem in problems) else DONE)


@click.command()
@click.argument("name", default="sleeve")
@out_option("DIR", "Folder to write into.")
@overwrite_option
def sample(name: str, out: Path, *, overwrite: bool) -> None:
    """Write the sample shot NAME and print its path; an unknown name lists all names."""
    from ..lab.samples import write_sample

    click.echo(write_sample(name, out, overwrite=overwrite))


@click.command()
@click.argument("layer", type=click.Path(dir_okay=False))
@out_option("PNG|GIF", "Picture to write.")
@click.option("--shot", type=click.Path(dir_okay=False), help="The coarse shot.  [default: the one the layer names]")
@click.option("--time", "times", type=float, multiple=True, metavar="T", help="Time code to draw; repeatable.")
@click.option("--size", type=PICTURE_SIZE, default="1280x640", help="Pixels.")
@click.option("--camera", type=(float, float), metavar="AZIMUTH ELEVATION", help="Where to look from, in degrees.")
@overwrite_option
def preview(layer: str, out: Path, *, times: tuple[float, ...], **options: Any) -> None:
    """Draw the smoothly subdivided input beside the cloth of LAYER and print the picture's path.

    A PNG shows one time code, a GIF all of them.
    """
    from ..shot.page.preview import preview as draw

    click.echo(draw(layer, out, times=times or None, **options))


@click.command()
@shot_argument
@out_option("DIR", "Folder to write into; a chart that was begun there goes on.")
@scene_options
@click.option("--device", metavar="cpu|cuda", help="Where to compute.")
@click.option("--clock", type=click.Choice(["wall", "cpu"]), help="cpu: one core's own time, for busy machines.")
@click.option("--method", "methods", multiple=True, metavar="NAME", help="Integrator to measure; repeatable.")
@click.option(
    "--peer", "peers", multiple=True, metavar="NAME=PYTHON", help="Solver outside, and the Python that has it."
)
@click.option("--count", type=click.IntRange(min=1), metavar="N", help="Frames to measure.")
@click.option("--repeats", type=click.IntRange(min=1), metavar="N", help="How often each time is taken.")
@click.option("--short", is_flag=True, help="Take less than 15 minutes.")
@click.option("--budget-minutes", type=float, metavar="M", help="Plan with this time.")
@overwrite_option
def chart(shot: str, out: Path, **options: Any) -> None:
    """Measure SHOT's frames by every method, draw speed against accuracy, and print a summary."""
    from ..lab.chart.options import ChartOptions
    from ..lab.chart.run import chart_shot

    values = {name: value for name, value in options.items() if value not in (None, ())}
    done = chart_shot(shot, out, ChartOptions(**values, progress=print_progress))
    click.echo("\n".join(done.lines()))


@click.command()
@click.option(
    "--config", "config_file", required=True, type=click.Path(path_type=Path), metavar="FILE.toml", help="What and how."
)
@out_option("DIR", "Folder for the log, the checkpoint, the weights and their card.")
@of_field("device")
@click.option("--minutes", type=float, metavar="M", help="Train so long.  [default: the configuration's]")
@click.option("--resume", is_flag=True, help="Go on from the folder's checkpoint.")
def train(config_file: Path, out: Path, *, device: str, **options: Any) -> None:
    """Train a learned integrator and print its weights' path."""
    from ..lab.train.record import run_training
    from ..shot.solve import prepare_device

    device = prepare_device(device)
    click.echo(run_training(config_file, out, device=device, say=partial(click.echo, err=True), **options))


@click.command("warm-up")
@of_field("device")
def warm_up(device: str) -> None:
    """Compile all kernels ahead of the first refine, as for an image of a farm's machines.

    They are kept in the folder that WARP_CACHE_PATH names, by default in the user's cache.
    """
    from ..shot.solve import prepare_device
    from ..solver.mesh.kernels import compile_kernels

    compile_kernels(prepare_device(device))


@click.command("report-schema")
@click.argument("name", type=click.Choice(["report", "summary"]), default="report")
def report_schema(name: str) -> None:
    """Print the JSON Schema of the report of a run, or of the summary of several."""
    from ..shot import report, summary

    click.echo({"report": report.SCHEMA, "summary": summary.SCHEMA}[name].read_text(encoding="utf-8"), nl=False)


@click.command("schema-path")
def schema_path() -> None:
    """Print the folder of the schemas, for PXR_PLUGINPATH_NAME."""
    from ..usd.schema import schema_path as find

    click.echo(find())
