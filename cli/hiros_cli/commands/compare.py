"""``hiros compare``: several systems on the same logs."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hiros_cli.options import Force, Json, QuietResult
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.evaluate.comparison import Entry, Outcome, Task

STUDIES = ("cameras", "radius", "people", "malaguti", "lee")


def compare(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="Recordings; a truth on /truth is found by itself."),
    ] = None,
    systems: Annotated[
        list[str] | None,
        typer.Option(
            "--system",
            metavar="NAME[:CHAIN][,PARAM=VALUE]",
            help="Takes part; may be repeated. hiros:TMF, lee,cluster.radius=0.2. Default: hiros "
            "with and without look-ahead, malaguti, lee and the baselines.",
        ),
    ] = None,
    study: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="cameras: every subset of the cameras. radius: Lee's four. people: 1 to 4, "
            "simulated, no LOG. malaguti, lee: the tables of these papers.",
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(metavar="FILE|TOPIC", help="The truth, of one LOG. Default: its own."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Runs at once; 0 = one per core.")] = 0,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write a page with plots.")
    ] = None,
    rrd: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a recording with all systems overlaid."),
    ] = None,
    force: Force = False,
    json: Json = False,
    quiet: QuietResult = False,
) -> None:
    """Run systems on the same logs and rank them by their error.

    Without a truth, by how far the camera that is left out is from what the others give.
    """
    from hiros_cli.compiling import ALL, prepare
    from hiros_cli.output import check_outputs

    paths = list(logs or ())
    for path in paths:
        path.stat()
    _check(paths, study, truth, rrd)
    check_outputs(
        (html, "HTML page"), (rrd, "Rerun recording"), inputs=(*paths, truth), force=force
    )
    prepare(quiet=quiet or json, roots=ALL)
    from hiros_cli.progress import bar
    from hiros_mcap.evaluate.comparison import comparison

    with ExitStack() as stack:
        if study == "people":
            paths = _simulated(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        entries = _entries(systems or (), study)
        tasks = _tasks(paths, entries, truth, study)
        with bar(f"{len(tasks)} runs", quiet=quiet) as progress:
            outcomes = comparison(tasks, jobs=jobs, progress=progress)
        if rrd is not None:
            from hiros_viewer.comparison_page import save_overlay

            save_overlay(rrd, paths[0], entries)
    if html is not None:
        from hiros_viewer.comparison_page import comparison_page

        comparison_page(outcomes, study or "").write(html)
    if json:
        _print_json(outcomes)
    elif not quiet:
        _show(outcomes, study or "")


def _check(paths: list[Path], study: str | None, truth: str | None, rrd: Path | None) -> None:
    if study is not None and study not in STUDIES:
        raise ConfigError(f"--study: {study!r} is none of {', '.join(STUDIES)}")
    if not paths and study != "people":
        raise ConfigError("compare needs a LOG, or --study people (see hiros compare --help)")
    if paths and study == "people":
        raise ConfigError("--study people simulates its logs; leave LOG out")
    if truth is not None and len(paths) != 1:
        raise ConfigError("--truth is of one LOG")
    if rrd is not None and len(paths) != 1:
        raise ConfigError("--rrd shows one LOG")


def _simulated(folder: Path) -> list[Path]:
    """One log for each number of people."""
    from hiros_mcap.simulate import SimulateParams
    from hiros_mcap.simulate.write_log import write_log

    paths = []
    for people in range(1, 5):
        path = folder / f"{people} people.mcap"
        write_log(path, SimulateParams(people=people, seconds=15.0, seed=people))
        paths.append(path)
    return paths


def _entries(named: Sequence[str], study: str | None) -> list[Entry]:
    from hiros_mcap.evaluate.comparison import DEFAULT, Entry
    from hiros_mcap.evaluate.published import LEE, LEE_RADII, MALAGUTI_COLUMNS

    if named:
        return [Entry.parse(text) for text in named]
    chosen: tuple[str, ...] = DEFAULT
    if study == "cameras":
        chosen = ("hiros", "malaguti", "lee")
    elif study == "radius":
        chosen = tuple(f"lee-a4,cluster.radius={radius:g}" for radius in LEE_RADII)
    elif study == "malaguti":
        chosen = MALAGUTI_COLUMNS
    elif study == "lee":
        chosen = tuple(LEE)
    return [Entry.parse(text) for text in chosen]


def _tasks(
    paths: list[Path], entries: list[Entry], truth: str | None, study: str | None
) -> list[Task]:
    from hiros_mcap.evaluate.comparison import Task, camera_subsets

    tasks = [Task(path, entry, truth=truth) for path in paths for entry in entries]
    if study != "cameras":
        return tasks
    return [subset for task in tasks for subset in camera_subsets(task)]


def _show(outcomes: list[Outcome], study: str) -> None:
    from rich.text import Text

    from hiros_cli.printable import printable
    from hiros_cli.run_report import console, table
    from hiros_mcap.evaluate import comparison
    from hiros_mcap.evaluate import comparison_tables as tables

    out = console()

    def show(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        out.print(Text(f"\n{printable(title, 500)}", style="bold"), soft_wrap=True)
        out.print(table(header[0], *(f">{cell}" for cell in header[1:]), rows=rows))

    orderings = list(comparison.check_orderings(outcomes))
    if study == "cameras":
        by_number = comparison.by_number_of_cameras(outcomes)
        header, rows = tables.camera_rows(by_number)
        show("Mean joint error (SD), mm, by number of cameras, over all subsets", header, rows)
        orderings = list(comparison.camera_orderings(by_number))
    elif study == "malaguti":
        rows = tables.malaguti_rows(outcomes)
        show("Malaguti 2019, Table I, cm; paper: other data", tables.MALAGUTI_HEADER, rows)
        times = tables.malaguti_times(outcomes)
        show("Table II: malaguti, by a line; paper: i7-4770", tables.TIME_HEADER, times)
    elif study in ("lee", "radius"):
        rows = tables.lee_rows(outcomes)
        show("Lee 2022, error (SD), mm [paper: other data]", tables.LEE_HEADER, rows)
        header, rows = tables.joint_rows(outcomes)
        show("The same by joint, mm, as Tables A1 to A6", header, rows)
    else:
        for log in dict.fromkeys(o.log for o in outcomes):
            header, rows = tables.ranked([o for o in outcomes if o.log == log])
            show(log, header, rows)
    for ordering in orderings:
        verdict = "holds" if ordering.holds else "DOES NOT HOLD"
        out.print(Text(f"{verdict}: {ordering.text}: {ordering.detail}"), soft_wrap=True)


def _print_json(outcomes: list[Outcome]) -> None:
    from json import dumps

    from hiros_mcap.evaluate.comparison import check_orderings
    from hiros_mcap.summary import plain

    data: dict[str, Any] = {
        "outcomes": [plain(o) for o in outcomes],
        "orderings": [plain(o) for o in check_orderings(outcomes)],
    }
    print(dumps(data, indent=2, allow_nan=False))
