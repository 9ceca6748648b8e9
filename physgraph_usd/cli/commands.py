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

from ..errors import UsageError, counted
from ..interrupts import signals_noted
from ..shot.plain_json import to_json
from ..solver.fabric import PRESETS
from .options import (
    config_option,
    existing_or_stopped,
    json_option,
    layer_argument,
    of_field,
    out_option,
    overwrite_option,
    scene_options,
    shot_argument,
    together,
)
from .printing import print_progress, seam_lines
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
@click.option("--check-seams", is_flag=True, help="Measure the seams between the present chunks, and write nothing.")
@click.option("--frames", type=FRAME_RANGE, help="First and last time code to join.  [default: all of the shot]")
@click.option(
    "--seam-bound",
    type=click.FloatRange(min=0),
    metavar="EDGES",
    default=0.05,
    help="Largest movement of a seam, RMS, in mean fine edge lengths.",
)
@click.option("--shot", type=click.Path(dir_okay=False), help="The shot, if moved since the chunks were written.")
@click.option(
    "--report",
    "report_to",
    type=click.Path(path_type=Path),
    metavar="FILE.json|DIR",
    help="Write a report of all frames.",
)
@click.option(
    "--root", type=click.Path(path_type=Path), help="Also write a root file (.usda) with the layer over the shot."
)
@click.option(
    "--partial",
    is_flag=True,
    help="Write the finished frames alone, whatever seams move; CHUNK may be the .frames folder or the layer of a "
    "stopped run.",
)
@overwrite_option
def stitch(chunks: tuple[Path, ...], out: Path | None, *, check_seams: bool, seam_bound: float, **options: Any) -> None:
    """Join chunks of a shot, folders written by refine --preroll, into a layer and print the path of the layer.

    A folder of chunks counts as all its chunks. The movement of each seam is printed on stderr, with the bound. Exits
    with 3 if a frame failed.
    """
    with signals_noted():
        with imports_uncollected():
            from ..shot import stitch as chunk

        if check_seams:
            report, seams = None, chunk.check_seams(chunks, seam_bound=seam_bound, shot=options["shot"])
        elif out is None:
            raise UsageError("give a layer to write by -o, or --check-seams")
        else:
            report, seams = chunk.stitch(chunks, out, seam_bound=seam_bound, **options)
        for line in seam_lines(seams, seam_bound):
            click.echo(line, err=True)
    if report is not None:
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
    help="Also solve three frames; print the time for the whole shot, and the distance of the frames from rest.",
)
@click.option("--details", "detailed", is_flag=True, help="Also print every value and its source.")
@json_option
@click.pass_context
def inspect(ctx: click.Context, shot: str, *, as_json: bool, timed: bool, detailed: bool, **options: Any) -> None:
    """Print the garments and bodies of SHOT, every problem and warning, and the command to refine SHOT.

    Exits with 1 if SHOT cannot be refined with these options, with 2 if a named prim or file does not exist.
    """
    with imports_uncollected():
        from ..shot.refine import inspect_shot
    from .inspected import details, summary

    values, _ = values_for(ctx, shot, refine)
    plan = inspect_shot(shot, timed=timed, **{name: values[name] for name in options if name != "config"})
    lines = [*summary(plan), *(["", *details(plan)] if detailed else [])]
    click.echo(to_json(plan) if as_json else "\n".join(lines))
    sys.exit(plan.get("exit_code", DONE))


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
    """Write a layer over SHOT with marks on garments, colliders and bound prims, for refine."""
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
@click.option("--port", type=int, default=8080, help="Port on this machine; if taken, the next free port.")
def tune(shot: str, *, port: int, **options: Any) -> None:
    """Show SHOT in the browser, with sliders for each garment's values; Save writes the values as tag does.

    Prints the address of the page, and serves the page to this machine alone until interrupted.
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
@layer_argument
@click.option(
    "--shot", type=click.Path(dir_okay=False), help="The shot below the layer.  [default: the shot named in the layer]"
)
@json_option
def validate(layer: str, *, shot: str | None, as_json: bool) -> None:
    """Check a refined LAYER by our rules and by USD's own validators, and print every problem.

    A layer without errors ends with a line on what was checked. Exits with 1 if a rule is broken.
    """
    from ..usd.check.validate import validate_layer, what_was_checked

    problems = validate_layer(layer, shot)
    is_valid = all(problem.severity != "error" for problem in problems)
    if as_json:
        click.echo(to_json([asdict(problem) for problem in problems]))
    else:
        for problem in problems:
            click.echo(problem)
        if is_valid:
            warned = f", with {counted(len(problems), 'warning')}" if problems else ""
            click.echo(f"{layer} is valid{warned}: {what_was_checked(layer, shot)}")
    sys.exit(DONE if is_valid else FAILED)


def _list_samples(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Print every sample with its description and end, if wanted."""
    if wanted:
        from ..lab.samples import SAMPLES

        for name, words in SAMPLES.items():
            click.echo(f"{name}: {words}")
        context.exit()


@click.command()
@click.argument("name", default="sleeve")
@out_option("DIR", "Folder to write into.")
@overwrite_option
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_samples,
    help="Print every NAME with a description.",
)
def sample(name: str, out: Path, *, overwrite: bool) -> None:
    """Write the sample shot NAME and print its path."""
    from ..lab.samples import write_sample

    click.echo(write_sample(name, out, overwrite=overwrite))


@click.command()
@click.argument("layer", type=click.Path(), callback=existing_or_stopped)
@out_option("PNG|GIF", "Picture to write.")
@click.option(
    "--shot", type=click.Path(dir_okay=False), help="The coarse shot.  [default: the shot named in the layer]"
)
@click.option(
    "--time", "times", type=float, multiple=True, metavar="T", help="Time code to draw; repeatable for a GIF."
)
@click.option("--size", type=PICTURE_SIZE, default="1280x640", help="Pixels.")
@click.option("--camera", type=(float, float), metavar="AZIMUTH ELEVATION", help="Direction of the camera, in degrees.")
@overwrite_option
def preview(layer: str, out: Path, *, times: tuple[float, ...], **options: Any) -> None:
    """Draw the smoothly subdivided input beside the cloth of LAYER and print the picture's path.

    A PNG shows a single time code, a GIF all time codes. For a run that was stopped LAYER is the layer's name, or the
    folder of finished frames beside it; only finished frames are drawn.
    """
    from ..shot.stopped import preview_any

    click.echo(preview_any(layer, out, times=times or None, **options))


@click.command()
@shot_argument
@out_option("DIR", "Folder to write into; an unfinished chart there is continued.")
@scene_options
@click.option("--device", metavar="cpu|cuda", help="Where to compute.")
@click.option("--clock", type=click.Choice(["wall", "cpu"]), help="cpu: one core's own time, for busy machines.")
@click.option("--method", "methods", multiple=True, metavar="NAME", help="Integrator to measure; repeatable.")
@click.option(
    "--peer", "peers", multiple=True, metavar="NAME=PYTHON", help="A solver of others, and the Python with that solver."
)
@click.option("--count", type=click.IntRange(min=1), metavar="N", help="Frames to measure.")
@click.option("--repeats", type=click.IntRange(min=1), metavar="N", help="Number of repetitions of each measurement.")
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
    "--config",
    "config_file",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    help="Configuration of the training.",
)
@out_option("DIR", "Folder for the log, the checkpoint, the weights and their card.")
@of_field("device")
@click.option("--minutes", type=float, metavar="M", help="Training time.  [default: the configuration's]")
@click.option("--resume", is_flag=True, help="Continue from the checkpoint in the folder.")
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

    Compiled kernels are kept in the folder WARP_CACHE_PATH, by default in the user's cache.
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
