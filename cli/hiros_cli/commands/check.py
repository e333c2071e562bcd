"""``hiros check``: whether a result is still what it was, and still good enough."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from hiros_cli.compiling import prepare
from hiros_cli.exit_codes import BAD_INPUT, DIFFERENT
from hiros_cli.many_logs import one_log
from hiros_cli.options import FORCE, JSON, QUIET, argument, flag, option
from hiros_cli.output import check_outputs, error_line, print_json, printable
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.outputs import Kind
    from hiros_mcap.regression.suite import CaseResult


def check(
    named: str = argument(
        "OUT|SUITE", "Output of `hiros process`, or a suite (.toml) of recordings."
    ),
    golden: Path | None = option("FILE", "With OUT: the golden log to compare with."),
    tolerances: Path | None = option(
        "FILE",
        "With OUT: TOML file with tolerances. Default: GOLDEN.tolerances.toml beside the "
        "golden log.",
    ),
    channel: list[str] | None = option(
        "GLOB",
        "With OUT and --bless: channels to keep; may be repeated. Default: the last stage.",
    ),
    bless: bool = flag("--bless", "Accept the result as the new golden file; print what changed."),
    only: list[str] | None = option("NAME", "With SUITE: this log only; may be repeated."),
    keep: Path | None = option("FOLDER", "With SUITE: keep the outputs in this folder."),
    junit: Path | None = option("FILE", "With SUITE: also write JUnit XML."),
    markdown: Path | None = option("FILE", "With SUITE: also write a summary for a pull request."),
    jobs: int = option("NUMBER", "With SUITE: logs at once; 0 = one per core.", default=0, min=0),
    force: bool = FORCE,
    json: bool = JSON,
    quiet: bool = QUIET,
) -> int:
    """Compare a result with its golden log, or run a suite of logs.

    Exit code: 0 equal within the tolerances, 1 different, 2 cannot be compared.
    """
    is_suite = Path(named).suffix == ".toml"
    for_log = {"golden": golden, "tolerances": tolerances, "channel": channel}
    for_suite = {"only": only, "keep": keep, "junit": junit, "markdown": markdown}
    wrong = for_log if is_suite else for_suite
    target_kind = "a suite" if is_suite else "an output; a suite's name ends in .toml"
    for name, value in wrong.items():
        if value:
            raise ConfigError(f"--{name} has no effect on {target_kind} (see hiros check --help)")
    target = one_log(named)
    prepare(quiet=quiet or json)
    from hiros_mcap.outputs import write_text
    from hiros_mcap.regression import check_report
    from hiros_mcap.regression.quantities import load_tolerances
    from hiros_mcap.regression.suite import (
        Golden,
        check_output,
        kept_path,
        load_suite,
        run_suite,
    )

    if is_suite:
        suite = load_suite(target)
        kept = [] if keep is None else [kept_path(keep, case) for case in suite.cases]
        reports: list[tuple[Path | None, Kind]]
        reports = [(junit, "JUnit report"), (markdown, "Markdown summary")]
        check_outputs(*reports, inputs=[*suite.files, *kept], force=force)
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
        names = only or ()
        with bar(f"{target.name}: {len(names) or len(suite.cases)} logs", quiet=quiet) as progress:
            results = run_suite(
                suite,
                bless=bless,
                only=names,
                jobs=jobs,
                keep=keep,
                force=force,
                progress=progress,
            )
        if junit is not None:
            write_text(junit, check_report.junit(results, target.stem))
        if markdown is not None:
            write_text(markdown, check_report.markdown(results, target.stem))
        return _show(results, json=json, quiet=quiet)
    if golden is None:
        raise ConfigError(f"{target}: name the golden log with --golden")
    limits = None if tolerances is None else load_tolerances(tolerances)
    result = check_output(target, Golden(golden, limits, channel or ()), bless=bless)
    return _show([_with_hint(result, target, golden)], json=json, quiet=quiet)


def _with_hint(result: CaseResult, target: Path, golden: Path) -> CaseResult:
    """Add the command that shows the first difference."""
    if not result.first:
        return result
    topic, first = result.first[0]
    stage = topic.rpartition("/")[2]
    start = max(0.0, first.seconds - 1)
    command = (
        f"hiros view {quote(str(target))} {quote(str(golden))} --stage {stage} "
        f"--time-range {start:.2f}:{first.seconds + 2:.2f}"
    )
    return replace(result, notes=(*result.notes, f"see it: {command}"))


def _show(results: list[CaseResult], *, json: bool, quiet: bool) -> int:
    """Print what differs, without ``quiet`` everything; return the exit code."""
    from hiros_mcap.regression import check_report

    if json:
        print_json("check", check_report.as_dict(results))
    else:
        for result in results if quiet else ():
            if result.status == "error":
                print(error_line(ConfigError(f"{result.name}: {result.error}")), file=sys.stderr)
        _print([r for r in results if r.status == "different"] if quiet else results, quiet=quiet)
    statuses = {result.status for result in results}
    return BAD_INPUT if "error" in statuses else DIFFERENT if "different" in statuses else 0


def _print(results: list[CaseResult], *, quiet: bool) -> None:
    from rich.text import Text

    from hiros_cli.run_report import page
    from hiros_mcap.regression import check_report

    styles = {"equal": "green", "different": "red", "error": "yellow"}
    lines: list[str | Text] = []
    for result in results:
        head = Text(f"{result.status:9} ", style=styles[result.status])
        lines.append(head + Text(printable(result.name, 500)))
        notes = () if quiet else result.notes
        lines += [f"  {line}" for line in (*check_report.lines(result), *notes)]
    totals = None
    if len(results) > 1 and not quiet:
        totals = [Text(check_report.totals(results), style="bold")]
    if lines:
        page((), lines, totals)
