"""``refine``: a single shot in this process, or several shots in a process each, with a summary of all."""

from __future__ import annotations

import logging
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import LayerError, PhysGraphError, UsageError, counted
from ..interrupts import at_end, signals_noted
from ..interrupts import exit_code_of as signal_code_of
from .options import HEADINGS, out_option, run_options, together, under
from .printing import LOGGER, Output, say, seam_lines
from .show_file import values_for
from .structure import DONE, FAILED, GroupedCommand, errors_named, imports_uncollected, show_trace

if TYPE_CHECKING:
    from ..shot.job import Job
    from ..shot.options import RefineOptions
    from ..shot.report import RefineReport
    from ..shot.summary import Row

USD_SUFFIXES = (".usd", ".usda", ".usdc")
RENAMED = {"run-up": "preroll"}
"""Former names of options, without dashes; accepted, but not in the help."""


@click.command(cls=GroupedCommand, context_settings={"token_normalize_func": lambda name: RENAMED.get(name, name)})
@click.argument("shots", nargs=-1, required=True, metavar="SHOT...", type=click.Path(dir_okay=False))
@out_option("OUT", "Layer to write, or a folder.")
@together(*map(under, HEADINGS))
@run_options
@click.pass_context
def refine(
    ctx: click.Context, shots: tuple[str, ...], out: Path, *, summary: Path | None, dry_run: bool, **options: object
) -> None:
    """Refine the garments of each SHOT into a separate layer, and print only the paths of the layers on stdout.

    Several shots are refined in separate processes; if a shot fails, the others continue. A table of all shots is
    printed last, on stderr. Exits with 0 if all is done, 1 if all failed, 2 for wrong usage, 3 if a part failed.
    """
    with signals_noted():
        jobs = _jobs(ctx, shots, out)
        _check_files(ctx, jobs, out)
        with imports_uncollected():
            from ..shot.job import check_jobs

        layers = [layer for _, layer, _ in jobs]
        verbose, log_file, in_lines = (ctx.params[name] for name in ("verbose", "log_file", "progress"))
        flags = {name: ctx.params[name] for name in ("openjd", "quiet", "as_json")}
        output = Output(verbose, log_file, in_lines, several=len(jobs) > 1, **flags)
        also = [
            (result, file) for result, file in (("the summary", summary), ("the log", log_file)) if file is not None
        ]
        if also:
            check_jobs(jobs, also=also)
        with _folder_of(layers, out, dry_run=dry_run), output.logged():
            code = _refine_each(jobs, output, summary=None if dry_run else summary)
            if not dry_run:
                _check_seams(layers, ctx.params["seam_bound"], output)
    sys.exit(code)


def _check_seams(layers: Sequence[Path], bound: float | None, output: Output) -> None:
    """Print how far seams between neighbouring chunks move; exit with an error beyond the bound."""
    if bound is None:
        return
    from ..shot.stitch import check_seams

    for layer in filter(Path.exists, layers):
        for line in seam_lines(check_seams([layer.parent], of=layer, seam_bound=bound), bound):
            if not output.quiet:
                say(f"{'openjd_status: ' if output.openjd else ''}{line}", err=True)


def _jobs(ctx: click.Context, shots: tuple[str, ...], out: Path) -> list[Job]:
    """Shots with layers and options, from the command line and the show's file."""
    from ..shot.options import OPTIONS, RefineOptions

    if ctx.params["preroll"] is None:
        layers = _one_each(shots, out, "-o", suffix=".refined.usdc", accepts=USD_SUFFIXES)
    else:
        layers = [out] if len(shots) == 1 else [out / Path(shot).stem for shot in shots]
    reports = _each_or_none(shots, ctx.params["report"], "--report", suffix="", accepts=(".json",))
    roots = _each_or_none(shots, ctx.params["root"], "--root", suffix=".usda", accepts=USD_SUFFIXES)
    pictures = _each_or_none(shots, ctx.params["preview"], "--preview", suffix=".png", accepts=(".png",))
    jobs = []
    for shot, layer, report, root, picture in zip(shots, layers, reports, roots, pictures, strict=True):
        values, sources = values_for(ctx, shot, ctx.command)
        options = {name: value for name, value in values.items() if name in OPTIONS and name != "progress"}
        options |= {"report": report, "root": root, "preview": picture, "sources": sources}
        jobs.append((shot, layer, RefineOptions(**options)))
    return jobs


def _check_files(ctx: click.Context, jobs: Sequence[Job], out: Path) -> None:
    """Check the options, input file and output folder of a single shot before numpy, USD and torch are imported.

    A run recording a failure in a file or as JSON makes the same checks later, and so does a run of several shots.
    """
    for _, _, options in jobs:
        options.check()
    (shot, layer, options), *further = jobs
    recorded = any(ctx.params[name] for name in ("report", "summary", "log_file", "as_json", "openjd"))
    if further or recorded or (options.skip_existing and layer.is_file()):
        return
    from ..usd.resolve import check_there
    from ..usd.write.atomic import check_folder_of

    check_there(shot)
    if layer == out and not options.dry_run:
        check_folder_of(layer)


def _each_or_none(shots: tuple[str, ...], to: Path | None, option: str, **known: Any) -> Sequence[Path | None]:
    """One output file per shot, as in `_one_each`; None for each shot without the option."""
    return [None] * len(shots) if to is None else _one_each(shots, to, option, **known)


def _refine_each(jobs: Sequence[Job], output: Output, *, summary: Path | None) -> int:
    """Refine the jobs and report the result of each; returns the exit code."""
    from ..shot.job import results
    from ..shot.summary import check_summary, exit_code_of, row_of

    if summary is not None:
        check_summary(summary, overwrite=jobs[0][2].overwrite)
    rows: list[Row] = []
    failed: list[PhysGraphError] = []

    def interrupted(code: int) -> None:
        unfinished = [row_of(shot, layer, None) for shot, layer, _ in jobs[len(rows) :]]
        _summarise([*rows, *unfinished], output, summary, exit_code=code)

    try:
        with at_end(interrupted):
            for (shot, layer, _), done in zip(jobs, results(jobs, partial(_solved, output=output)), strict=True):
                rows.append(row_of(shot, layer, done))
                if isinstance(done, PhysGraphError):
                    failed.append(done)
                    if output.several:
                        show_trace(done)
                elif done.out is None:
                    say(done.to_json())
                elif not output.as_json:
                    say(str(done.out))
    except (KeyboardInterrupt, SystemExit) as error:
        interrupted(signal_code_of(error) or FAILED)
        raise
    _summarise(rows, output, summary, exit_code=exit_code_of(rows))
    if failed and not output.several:
        raise failed[0]
    _print_failed(rows)
    return exit_code_of(rows)


def _summarise(rows: Sequence[Row], output: Output, summary: Path | None, *, exit_code: int) -> None:
    """Print and write the results of all shots."""
    from ..shot.summary import json_of, table_of, write_summary

    if output.as_json:
        say(json_of(rows, exit_code=exit_code))
    if output.several and not output.quiet:
        say("\n".join(table_of(rows)), err=True)
    if summary is not None:
        write_summary(summary, rows, exit_code=exit_code)


def _print_failed(rows: Sequence[Row]) -> None:
    """Print the failed shots with the reasons."""
    failed = [row for row in rows if row.error]
    for row in failed:
        logging.getLogger(LOGGER).error(row.error, extra={"shot": row.shot})
    if failed:
        say(f"{len(failed)} of {counted(len(rows), 'shot')} failed", err=True)


def _solved(jobs: Sequence[Job], output: Output) -> Generator[RefineReport | PhysGraphError, None, None]:
    """Result of each job: a single job in this process, several in separate processes."""
    if not jobs:
        return
    from ..shot.workers import import_ahead

    if output.several or any(options.workers > 1 and not options.scheduler for *_, options in jobs):
        import_ahead()
    with imports_uncollected():
        from ..shot.refine import refine_shots

    if not output.several:
        try:
            with errors_named():
                done = _refine_shown(*jobs[0], output=output)
        except PhysGraphError as error:
            done = error
        yield done
        return
    workers = max(options.workers for *_, options in jobs)
    refine = partial(_refine_logged, output=output, alone=workers == 1)
    yield from refine_shots(jobs, workers=workers, refine=refine)


def _refine_logged(*job: Any, output: Output, alone: bool) -> RefineReport:
    """Refine a shot in a separate process with a separate log."""
    with output.logged():
        return _refine_shown(*job, output=output, alone=alone)


def _refine_shown(
    shot: str | Path, layer: Path, options: RefineOptions, *, output: Output, alone: bool = True
) -> RefineReport:
    """Refine a shot, with a progress bar if no shots are refined in parallel."""
    with imports_uncollected():
        from ..shot.refine import refine_shot

    with output.progress(Path(shot).name) if alone else nullcontext() as progress:
        return refine_shot(shot, layer, replace(options, progress=progress))


def _one_each(shots: tuple[str, ...], to: Path, option: str, *, suffix: str, accepts: tuple[str, ...]) -> list[Path]:
    """Output path of each shot: ``to`` if ``to`` names a file, else a file in the folder ``to``."""
    if to.suffix in accepts and not to.is_dir():
        if len(shots) > 1:
            raise UsageError(f"{option} {to} is one file for {len(shots)} shots; give a folder")
        return [to]
    if to.suffix and not to.is_dir():
        suffixes = ", ".join(accepts)
        raise UsageError(
            f"{option} {to}: unknown suffix '{to.suffix}'; known: {suffixes}; or make a folder of that name"
        )
    if not suffix and len(shots) == 1:
        return [to]
    files = [to / (Path(shot).stem + suffix) for shot in shots]
    twice = sorted({str(file) for file in files if files.count(file) > 1})
    if twice:
        raise UsageError(f"{option} {to}: two shots would both be written to {twice[0]}; refine them one by one")
    return files


@contextmanager
def _folder_of(layers: Sequence[Path], out: Path, *, dry_run: bool) -> Iterator[None]:
    """Create the layers' folder unless ``out`` names a layer, and remove the folder if no layer was written.

    After an interruption or an error, print the folders of finished frames.
    """
    from ..shot.frames import kept_for

    missing = [] if out in layers or dry_run else [folder for folder in (out, *out.parents) if not folder.exists()]

    def leave(_code: int = DONE) -> None:
        for frames in filter(None, map(kept_for, layers)):
            say(str(frames), err=True)
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()

    try:
        try:
            for folder in reversed(missing):
                folder.mkdir()
        except OSError as error:
            raise LayerError(f"cannot make the folder {out}: {error.strerror}") from error
        with at_end(leave):
            yield
    finally:
        leave()
