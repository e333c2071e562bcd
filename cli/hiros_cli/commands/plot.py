"""``hiros plot``: curves of a result as a picture or a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_cli.compiling import prepare
from hiros_cli.options import FORCE, QUIET, argument, option
from hiros_cli.output import beside, check_outputs
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.outputs import Kind


def plot(
    log: Path = argument("LOG", "Output of `hiros process`."),
    output: Path | None = option(
        "FILE", "One plot (.png) or all (.html). Default: LOG's name with .html.", "--output", "-o"
    ),
    what: str = option(
        "KIND", "Plot in a PNG: angles, limbs or error (needs a truth).", default="angles"
    ),
    person: int | None = option("ID", "Person in a PNG. Default: the one seen longest."),
    channel: str | None = option("TOPIC", "Channel to plot. Default: the last stage."),
    truth: str | None = option(
        "FILE|TOPIC", "Truth to draw as well. Default: LOG's /truth channel."
    ),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Plot joint angles, limb lengths and errors as PNG or HTML."""
    log.stat()
    target = beside(log, ".html") if output is None else output
    if target.suffix not in (".png", ".html"):
        raise ConfigError(f"{target}: the name of a plot must end in .png or .html")
    kind: Kind = "HTML page" if target.suffix == ".html" else "PNG picture"
    check_outputs((target, kind), inputs=(log, truth), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.evaluate.logs import find_truth, output_channels, read_channel, start_of
    from hiros_mcap.evaluate.reprojection import image_scores_of
    from hiros_mcap.io.log import open_reader
    from hiros_mcap.io.result import stored_events
    from hiros_viewer import curves
    from hiros_viewer.pictures import save_png

    if what not in curves.KINDS:
        raise ConfigError(f"--what: {what!r} is none of {', '.join(curves.KINDS)}")
    topic = output_channels(log, [channel] if channel else [])[-1]
    with bar(f"plotting {log.name}", quiet=quiet):
        frames, model, _ = read_channel(log, topic)
        its_truth = find_truth(log, truth)
        with open_reader(log) as reader:
            events = stored_events(reader)
        true = None if its_truth is None else its_truth.moved(start=start_of(log))
        collected = curves.collect(f"{log}: {topic}", frames, model, true, events)
        lines = curves.about(log, curves.verdict(collected), curves.summary_row(frames, model))
        collected = replace(collected, about=lines)
        if target.suffix == ".html":
            images = image_scores_of(log, topic, frames, model)
            collected = replace(collected, images=images)
            curves.page_of(collected).write(target)
        else:
            save_png(curves.figure_of(collected, what, person), target)
    if not quiet:
        print(f"wrote {target}")
