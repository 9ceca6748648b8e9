"""The console command: each subcommand declares its options, imports its work and makes one call.

Data goes to stdout; progress, warnings and errors go to stderr.
Exit codes: 0 done, 1 the work failed, 2 wrong usage, 3 done in part.
"""

from __future__ import annotations

import errno
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never

import click

from . import __version__
from .cli_types import FrameRange, PictureSize, RefineLevel, RestShape
from .errors import LayerError, PhysGraphError, UsageError

if TYPE_CHECKING:
    from .options import RefineOptions
    from .report import RefineReport

DONE, FAILED, WRONG_USAGE, IN_PART = 0, 1, 2, 3
USD_SUFFIXES = (".usd", ".usda", ".usdc")
EXTRAS = {
    "pxr": "usd", "embreex": "preview", "PIL": "preview", "matplotlib": "chart", "plotly": "chart", "viser": "tune",
}  # fmt: skip
"""Which extra brings a module that only some commands need."""
MOST_LISTED = 8
"""Longest list of numbers that is printed in full."""

Decorator = Callable[[Callable[..., None]], Callable[..., None]]


class Commands(click.Group):
    """A group whose commands end with ``error: ...`` and the error's exit code instead of a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command; an error of our tree, or one of the disk or of memory, becomes one line on stderr."""
        from .processes import memory_is_named

        try:
            with memory_is_named():
                return super().invoke(ctx)
        except PhysGraphError as error:
            _leave(ctx, str(error), WRONG_USAGE if isinstance(error, UsageError) else FAILED)
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            _leave(ctx, f"{error.filename or 'cannot read or write'}: {error.strerror}", FAILED)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing not in EXTRAS:
                raise
            _leave(ctx, f"{missing} is not installed: pip install 'physgraph-usd[{EXTRAS[missing]}]'", FAILED)


def _together(*options: Decorator) -> Decorator:
    def apply(function: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            function = option(function)
        return function

    return apply


shot_argument = click.argument("shot", type=click.Path(dir_okay=False))
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
garment_option = click.option(
    "--garment", "garments", multiple=True, metavar="PATH", help="Prim path, glob or collection; repeatable."
)
collider_option = click.option(
    "--collider", "colliders", multiple=True, metavar="PATH", help="Prim path, glob or collection; repeatable."
)
scene_options = _together(
    click.option("--frames", type=FrameRange(), help="Time codes to refine.  [default: all of the shot]"),
    garment_option,
    collider_option,
    click.option("--level", type=RefineLevel(), metavar="N|auto", help="Subdivisions; each makes four faces of one."),
    click.option("--set", "overrides", multiple=True, metavar="PRIM.ATTR=VALUE", help="Override an attribute."),
    click.option(
        "--rest", "rest_frame", type=RestShape(), metavar="FRAME|auto", help="Rest shape: this frame, or fitted to all."
    ),
)
solve_options = _together(
    click.option("--integrator", metavar="NAME", help="How forces become displacements."),
    click.option(
        "--weights", type=click.Path(path_type=Path), metavar="FILE", help="Weights for a learned integrator."
    ),
    click.option("--steps", type=click.IntRange(min=0), metavar="N", help="Most steps at the finest level."),
    click.option("--tolerance", type=float, metavar="T", help="Stop when the cloth moves less, in edge lengths."),
    click.option("--budget-ms", type=float, metavar="MS", help="Stop after this time per frame."),
    click.option("--device", metavar="cpu|cuda", help="Where to compute."),
    click.option("--potential", type=click.Choice(["continuum", "paper"]), help="Which form of the energy."),
    click.option("--contact", type=click.Choice(["quadratic", "paper", "off"]), help="How bodies push the cloth."),
    click.option("--self-contact", type=click.Choice(["auto", "paper", "off"]), help="How cloth pushes cloth."),
    click.option("--temporal", type=click.Choice(["tether", "warm", "off"]), help="How a frame uses the last one."),
    click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes; each begins 6 frames early."),
)
asset_paths_option = click.option(
    "--asset-paths", type=click.Choice(["relative", "absolute"]), help="How files written name other files."
)
layer_options = _together(
    click.option("--mode", type=click.Choice(["over", "sibling"]), help="Refine in place, or beside the coarse mesh."),
    click.option("--velocities", is_flag=True, help="Write point velocities even where the shot has none."),
    click.option("--heat-map", is_flag=True, help="Also write depth inside bodies and crossings as primvars."),
    click.option("--root", type=click.Path(path_type=Path), help="Also write a .usda with the layer over the shot."),
    asset_paths_option,
    click.option(
        "--report",
        type=click.Path(path_type=Path),
        metavar="FILE.json|DIR",
        help="Write what was done; DIR: as a page.",
    ),
    click.option("--progress", is_flag=True, help="Say each frame in a line of its own, into files and pipes too."),
    click.option("--strict", is_flag=True, help="Exit with 3 where a frame did not settle."),
    overwrite_option,
    click.option("--resume", is_flag=True, help="Go on from the frames and layers that an interrupted run finished."),
    click.option("--keep-frames/--no-keep-frames", default=True, help="Leave finished frames when interrupted."),
    click.option("--dry-run", is_flag=True, help="Print what would be done; write nothing."),
)


def out_option(metavar: str, help_text: str) -> Decorator:
    """Declare ``-o``, where a command writes.

    Args:
        metavar: What the help shows for the value.
        help_text: The option's line in the help.
    """
    return click.option("-o", "--out", required=True, type=click.Path(path_type=Path), metavar=metavar, help=help_text)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(__version__, prog_name="physgraph-usd")
def main() -> None:
    """Refine coarse animated garments in USD shots into fine cloth."""


@main.command()
@click.argument("shots", nargs=-1, required=True, metavar="SHOT...", type=click.Path(dir_okay=False))
@out_option("OUT", "Layer to write, or a folder.")
@scene_options
@solve_options
@layer_options
def refine(shots: tuple[str, ...], out: Path, *, report: Path | None, root: Path | None, **options: Any) -> None:
    """Refine the garments of each SHOT into a layer of its own and print the layers' paths.

    The options that are left out keep the defaults of physgraph_usd.RefineOptions.
    """
    from .options import RefineOptions
    from .usd.atomic import termination_raises

    layers = _one_each(shots, out, "-o", suffix=".refined.usdc", accepts=USD_SUFFIXES)
    none = [None] * len(shots)
    reports = none if report is None else _one_each(shots, report, "--report", suffix="", accepts=(".json",))
    roots = none if root is None else _one_each(shots, root, "--root", suffix=".usda", accepts=USD_SUFFIXES)
    given = {name: value for name, value in options.items() if value is not None}
    in_lines, workers = given.pop("progress", False), given.pop("workers", 1)
    jobs = [
        (shot, layer, RefineOptions(**given, report=report, root=root))
        for shot, layer, report, root in zip(shots, layers, reports, roots, strict=True)
    ]
    with termination_raises(), _folder_of(layers, out, dry_run=given["dry_run"]):
        if len(jobs) > 1:
            code = _refine_each(jobs, workers=workers, in_lines=in_lines)
        else:
            only, layer, settings = jobs[0]
            code = _say(_refine_shown(only, layer, replace(settings, workers=workers), in_lines=in_lines))
    sys.exit(code)


@main.command()
@shot_argument
@scene_options
@json_option
def inspect(shot: str, *, as_json: bool, **options: Any) -> None:
    """Print what would be refined, with what, from where, and every defect found in SHOT.

    Exits with 1 when SHOT cannot be refined as asked.
    """
    from .shot import inspect_shot

    given = {name: value for name, value in options.items() if value is not None}
    found = inspect_shot(shot, **given)
    click.echo(json.dumps(found, indent=2) if as_json else "\n".join(_outline(found)))
    sys.exit(FAILED if "problem" in found else DONE)


@main.command()
@shot_argument
@out_option("OUT", "Layer to write.")
@garment_option
@collider_option
@click.option("--preset", metavar="FABRIC", help="Fabric of the garments, such as denim; see docs/fabrics.md.")
@click.option("--layer", type=int, metavar="N", help="Order of the garments; lower is nearer to the body.")
@click.option("--side", metavar="SIDE", help="Side of the colliders: auto, winding, start, front or back.")
@asset_paths_option
@overwrite_option
def tag(shot: str, out: Path, *, garments: tuple[str, ...], colliders: tuple[str, ...], **options: Any) -> None:
    """Mark garments and colliders of SHOT in a new layer, so that refine finds them."""
    from .usd.tag import tag as tag_shot

    given = {name: value for name, value in options.items() if value is not None}
    click.echo(tag_shot(shot, out, garments=garments, colliders=colliders, **given))


@main.command()
@shot_argument
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Layer to save into.  [default: SHOT.tuned.usda]")
@garment_option
@collider_option
@click.option("--port", type=int, default=8080, help="Port on this machine; the next free one where it is taken.")
@overwrite_option
def tune(shot: str, *, port: int, **options: Any) -> None:
    """Show SHOT in the browser, with sliders for each garment's values; Save writes them as tag does.

    Prints the page's address, and serves it to this machine alone until it is interrupted.
    """
    from .tune.page import serve
    from .tune.session import TuneSession

    with closing(TuneSession(shot, **options)) as session:
        serve(session, port=port, say=click.echo)


@main.command()
@click.argument("layer", type=click.Path(dir_okay=False))
@click.option(
    "--shot", type=click.Path(dir_okay=False), help="The shot it goes over.  [default: the one the layer names]"
)
@json_option
def validate(layer: str, *, shot: str | None, as_json: bool) -> None:
    """Check a refined LAYER by our rules and by USD's own validators; exit with 1 when it breaks one."""
    from .usd.validate import validate_layer

    problems = validate_layer(layer, shot)
    if as_json:
        click.echo(json.dumps([asdict(problem) for problem in problems], indent=2))
    else:
        for problem in problems:
            click.echo(problem)
    sys.exit(FAILED if any(problem.severity == "error" for problem in problems) else DONE)


@main.command()
@click.argument("name", default="sleeve")
@out_option("DIR", "Folder to write into.")
@overwrite_option
def sample(name: str, out: Path, *, overwrite: bool) -> None:
    """Write the sample shot NAME and print its path; an unknown name lists those there are."""
    from .samples import write_sample

    click.echo(write_sample(name, out, overwrite=overwrite))


@main.command()
@click.argument("layer", type=click.Path(dir_okay=False))
@out_option("PNG|GIF", "Picture to write.")
@click.option("--shot", type=click.Path(dir_okay=False), help="The coarse shot.  [default: the one the layer names]")
@click.option("--time", "times", type=float, multiple=True, metavar="T", help="Time code to draw; repeatable.")
@click.option("--size", type=PictureSize(), default="1280x640", help="Pixels.")
@click.option("--camera", type=(float, float), metavar="AZIMUTH ELEVATION", help="Where to look from, in degrees.")
def preview(layer: str, out: Path, *, times: tuple[float, ...], **options: Any) -> None:
    """Draw the coarse cloth beside the fine cloth of LAYER and print the picture's path.

    A PNG shows one time code, a GIF all of them.
    """
    from .preview import preview as draw

    click.echo(draw(layer, out, times=times or None, **options))


@main.command()
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
    from .chart.options import ChartOptions
    from .chart.run import chart_shot

    given = {name: value for name, value in options.items() if value not in (None, ())}
    done = chart_shot(shot, out, ChartOptions(**given, progress=_tell))
    click.echo("\n".join(done.lines()))


@main.command()
@click.option(
    "--config", "config_file", required=True, type=click.Path(path_type=Path), metavar="FILE.toml", help="What and how."
)
@out_option("DIR", "Folder for the log, the checkpoint, the weights and their card.")
@click.option("--device", default="cpu", metavar="cpu|cuda", help="Where to compute.")
@click.option("--minutes", type=float, metavar="M", help="Train so long.  [default: the configuration's]")
@click.option("--resume", is_flag=True, help="Go on from the folder's checkpoint.")
def train(config_file: Path, out: Path, *, device: str, **options: Any) -> None:
    """Train a learned integrator and print its weights' path."""
    from .shot import prepare_device
    from .train.record import run_training

    prepare_device(device)
    click.echo(run_training(config_file, out, device=device, say=partial(click.echo, err=True), **options))


@main.command("schema-path")
def schema_path() -> None:
    """Print the folder of the schemas, for PXR_PLUGINPATH_NAME."""
    from .usd.schema import schema_path as find

    click.echo(find())


def _refine_shown(
    shot: str, layer: Path, options: RefineOptions, *, in_lines: bool, several: bool = False, alone: bool = True
) -> RefineReport:
    """Refine a shot and say on stderr each warning when it is known, and how far it is where it is alone at work."""
    from .shot import refine_shot

    told: list[str] = []

    def tell(warning: str) -> None:
        if warning not in told:
            told.append(warning)
            click.echo(f"warning: {shot}: {warning}" if several else f"warning: {warning}", err=True)

    with _progress(Path(shot).name, in_lines=in_lines) if alone else nullcontext() as progress:
        done = refine_shot(shot, layer, replace(options, progress=progress, say=tell))
    for warning in done.warnings:
        tell(warning)
    return done


def _refine_each(jobs: Sequence[tuple[str, Path, RefineOptions]], *, workers: int, in_lines: bool) -> int:
    """Refine several shots, each in a process of its own, and say at the end which failed and why."""
    from .shot import refine_shots

    refine = partial(_refine_shown, in_lines=in_lines, several=True, alone=workers == 1)
    codes, failed = [], []
    for (shot, _, _), done in zip(jobs, refine_shots(jobs, workers=workers, refine=refine), strict=True):
        if isinstance(done, PhysGraphError):
            failed.append(f"error: {shot}: {done}")
            codes.append(WRONG_USAGE if isinstance(done, UsageError) else FAILED)
        else:
            codes.append(_say(done))
    for line in failed:
        click.echo(line, err=True)
    if failed:
        click.echo(f"{len(failed)} of {len(jobs)} shots failed", err=True)
    return codes[0] if len(set(codes)) == 1 else IN_PART


def _say(done: RefineReport) -> int:
    """Print a run's layer, or after a dry run its report; returns the exit code."""
    click.echo(done.to_json() if done.out is None else done.out)
    return done.exit_code


def _one_each(shots: tuple[str, ...], to: Path, option: str, *, suffix: str, accepts: tuple[str, ...]) -> list[Path]:
    """Name one output per shot: ``to`` itself when it is a file's name, else files in the folder ``to``."""
    if to.suffix in accepts and not to.is_dir():
        if len(shots) > 1:
            raise UsageError(f"{option} {to} is one file for {len(shots)} shots; give a folder")
        return [to]
    if to.suffix and not to.is_dir():
        known = ", ".join(accepts)
        raise UsageError(f"{option} {to}: unknown suffix '{to.suffix}'; known: {known}; or make a folder of that name")
    if not suffix and len(shots) == 1:
        return [to]
    files = [to / (Path(shot).stem + suffix) for shot in shots]
    twice = sorted({str(file) for file in files if files.count(file) > 1})
    if twice:
        raise UsageError(f"{option} {to}: two shots would both be written to {twice[0]}; refine them one by one")
    return files


@contextmanager
def _folder_of(layers: Sequence[Path], out: Path, *, dry_run: bool) -> Iterator[None]:
    """Make the folder that layers go into, unless ``out`` names a layer; it goes again where nothing came into it.

    Finished frames that are left by an interruption are named.
    """
    from .frames import frames_folder
    from .lock import is_held

    made = [] if out in layers or dry_run else [each for each in (out, *out.parents) if not each.exists()]
    try:
        try:
            for folder in reversed(made):
                folder.mkdir()
        except OSError as error:
            raise LayerError(f"cannot make the folder {out}: {error.strerror}") from error
        yield
    finally:
        for kept in filter(Path.is_dir, map(frames_folder, layers)):
            if not is_held(kept):
                click.echo(f"finished frames are kept in {kept}; --resume goes on from them", err=True)
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def _progress(label: str, *, in_lines: bool = False) -> Iterator[Callable[[int, int], None]]:
    hidden = in_lines or not sys.stderr.isatty()
    with click.progressbar(length=1, label=label, file=sys.stderr, hidden=hidden) as bar:

        def show(done: int, total: int) -> None:
            bar.length = total
            bar.update(done - bar.pos)
            if in_lines:
                _tell(bar.pct, bar.eta, f"{done} of {total} frames")

        yield show


def _tell(part: float, seconds: float, what: str) -> None:
    """One line of progress on stderr."""
    left = f"about {seconds / 60.0:.0f} min left" if seconds > 90.0 else f"about {seconds:.0f} s left"
    click.echo(f"{part:4.0%}  {left:20s}  {what}", err=True)


def _outline(value: Any, indent: str = "") -> Iterator[str]:
    """Lines of a report for reading: nested records indented, plain lists on one line."""
    pairs = value.items() if isinstance(value, dict) else (("-", item) for item in value)
    for key, item in pairs:
        label = key if key == "-" else f"{key}:"
        if isinstance(item, dict | list) and any(isinstance(part, dict | list | str) for part in item):
            yield f"{indent}{label}"
            yield from _outline(item, indent + "  ")
        else:
            yield f"{indent}{label} {_in_words(item)}"


def _in_words(value: Any) -> str:
    if isinstance(value, list) and len(value) > MOST_LISTED:
        return f"{_in_words(value[:3])}, ..., {_in_words(value[-1])} ({len(value)} in all)"
    if isinstance(value, list) and value:
        return ", ".join(map(_in_words, value))
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None or value in ([], {}) else str(value)


def _leave(ctx: click.Context, message: str, code: int) -> Never:
    click.echo(f"error: {message}", err=True)
    ctx.exit(code)
