"""``hiros compare``: several systems on the same logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hiros_cli.compiling import prepare
from hiros_cli.options import (
    FORCE,
    HTML,
    JSON,
    QUIET,
    TABLE,
    argument,
    option,
    settings_of,
)
from hiros_cli.output import check_outputs, print_json
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.evaluate.comparison import Outcome
    from hiros_mcap.evaluate.measures import Sheet
    from hiros_mcap.outputs import Kind

CAMERA_STUDY = ("fuse", "hiros", "malaguti", "lee")
"""Systems of the study of cameras, which runs each many times, unless others are named."""


def compare(
    logs: list[Path] = argument("LOG", "Recordings; hiros uses a truth on /truth."),
    systems: list[str] | None = option(
        "NAME[:CHAIN][,PARAM=VALUE]",
        "System to compare, such as hiros:TMF or lee,cluster.radius=0.2; may be repeated. "
        "Default: fuse, hiros, both realtime, malaguti, lee and the baselines.",
        "--system",
    ),
    study: str | None = option("NAME", "cameras: run on every subset of the cameras."),
    truth: str | None = option(
        "FILE|TOPIC", "Truth for a single LOG. Default: its /truth channel."
    ),
    jobs: int = option("NUMBER", "Runs at once; 0 = one per core.", default=0, min=0),
    html: Path | None = HTML,
    table: Path | None = TABLE,
    force: bool = FORCE,
    json: bool = JSON,
    quiet: bool = QUIET,
) -> None:
    """Run several systems on the same logs.

    With a truth, they are ranked by joint error. Without one, they are not ranked: the table shows
    how far each camera is from the result of the others, on the same detections for all systems,
    jitter, limb lengths and ids. The last column compares each system with the first one named:
    better or worse by so many mm, or no difference, by the 95 % interval over blocks of a second.
    """
    for path in logs:
        path.stat()
    if study not in (None, "cameras"):
        raise ConfigError(f"--study: {study!r} is no study; there is: cameras")
    if truth is not None and len(logs) != 1:
        raise ConfigError("--truth needs exactly one LOG")
    outputs: list[tuple[Path | None, Kind]] = [(html, "HTML page"), (table, "table of scores")]
    check_outputs(*outputs, inputs=(*logs, truth), force=force)
    from hiros_mcap.evaluate.logs import check_recording

    for path in logs:
        check_recording(path)
        settings_of(path)
    prepare(quiet=quiet or json)
    from hiros_mcap.evaluate.comparison import DEFAULT, Entry, Task, camera_subsets, comparison

    default = CAMERA_STUDY if study == "cameras" else DEFAULT
    entries = [Entry.parse(text) for text in systems or default]
    tasks = [Task(path, entry, truth=truth) for path in logs for entry in entries]
    if study == "cameras":
        tasks = [subset for task in tasks for subset in camera_subsets(task)]
    with bar(f"{len(tasks)} runs", quiet=quiet) as progress:
        outcomes = comparison(tasks, jobs=jobs, progress=progress)
    if html is not None:
        from hiros_viewer.score_pages import comparison_page

        comparison_page(outcomes, study).write(html)
    if table is not None:
        from hiros_mcap.evaluate.measures import write_table

        write_table(table, _sheets(outcomes, study))
    if json:
        from hiros_mcap.evaluate.score_tables import notes_on
        from hiros_mcap.wording import plain

        data = {"outcomes": [plain(o) for o in outcomes], "notes": notes_on(outcomes)}
        print_json("compare", data)
    elif not quiet:
        _show(outcomes, study)


def _sheets(outcomes: list[Outcome], study: str | None) -> list[Sheet]:
    from hiros_mcap.evaluate.comparison import by_number_of_cameras
    from hiros_mcap.evaluate.score_tables import camera_sheet, comparison_sheets

    if study == "cameras":
        return [camera_sheet(by_number_of_cameras(outcomes))]
    return comparison_sheets(outcomes)


def _show(outcomes: list[Outcome], study: str | None) -> None:
    from hiros_cli.run_report import page
    from hiros_mcap.evaluate.measures import text_of
    from hiros_mcap.evaluate.score_tables import notes_on, system_sheets, with_differences

    if study == "cameras":
        tables = [(sheet.title, text_of(sheet)) for sheet in _sheets(outcomes, study)]
    else:
        tables = [(sheet.title, with_differences(sheet)) for sheet in system_sheets(outcomes)]
    page((), *tables, notes=notes_on(outcomes))
