"""``hiros plot``: curves of a result as a picture or a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hiros_cli.completing import topics
from hiros_cli.options import Force, Quiet
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.outputs import Kind


def plot(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Output of `hiros process`.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="One plot (.png) or all (.html). Default: LOG's name with .html.",
        ),
    ] = None,
    what: Annotated[
        str,
        typer.Option(metavar="KIND", help="Plot in a PNG: angles, limbs or error (needs a truth)."),
    ] = "angles",
    person: Annotated[
        int | None,
        typer.Option(metavar="ID", help="Person in a PNG. Default: the one seen longest."),
    ] = None,
    channel: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC", help="Channel to plot. Default: the last stage.", autocompletion=topics
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|TOPIC", help="Truth to draw as well. Default: LOG's /truth channel."
        ),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Plot joint angles, limb lengths and errors as PNG or HTML."""
    from hiros_cli.compiling import prepare
    from hiros_cli.output import beside, check_outputs

    log.stat()
    target = beside(log, ".html") if output is None else output
    if target.suffix not in (".png", ".html"):
        raise ConfigError(f"{target}: the name of a plot must end in .png or .html")
    kind: Kind = "HTML page" if target.suffix == ".html" else "PNG picture"
    check_outputs((target, kind), inputs=(log, truth), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.evaluate.logs import find_truth, output_channels, read_channel
    from hiros_mcap.running.progress_bar import bar
    from hiros_viewer import curves
    from hiros_viewer.headline import headline

    if what not in curves.KINDS:
        raise ConfigError(f"--what: {what!r} is none of {', '.join(curves.KINDS)}")
    topic = output_channels(log, [channel] if channel else [])[-1]
    with bar(f"plotting {log.name}", quiet=quiet):
        frames, model, _ = read_channel(log, topic)
        its_truth = find_truth(log, truth)
        start = frames[0].stamp if frames else 0
        true = None if its_truth is None else its_truth.moved(start=start)
        collected = curves.collect(f"{log}: {topic}", frames, model, true)
        about = headline(log).lines(curves.verdict(collected), curves.summary_row(frames, model))
        collected = replace(collected, about=about)
        if target.suffix == ".html":
            curves.page_of(collected).write(target)
        else:
            curves.save_png(curves.figure_of(collected, what, person), target)
    if not quiet:
        print(f"wrote {target}")
