"""``hiros view``: a log in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hiros_cli.options import Force, Quiet
from hiros_mcap.errors import ConfigError


def view(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG [LOG]", help="A recording or what `hiros process` wrote; two are overlaid."
        ),
    ],
    layout: Annotated[
        str, typer.Option(metavar="NAME", help="overview, stages, person or cameras.")
    ] = "overview",
    time_range: Annotated[
        str | None,
        typer.Option(metavar="START:END", help="Only this part, s from the log's start."),
    ] = None,
    stage: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Stage that is drawn in curves. Default: the last."),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Camera poses that replace the log's transforms."),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a recording (.rrd) instead of opening a window."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the viewer to a browser on this machine.")
    ] = False,
    connect: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Send to a viewer: rerun+http://127.0.0.1:9876/proxy."),
    ] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> int:
    """Look at logs: the room, every camera's detections, every stage, angles, limbs, events."""
    from hiros_cli.compiling import prepare
    from hiros_cli.options import seconds_range
    from hiros_cli.output import check_outputs

    for log in logs:
        log.stat()
    if len(logs) > 2:
        raise ConfigError("view overlays two logs at most")
    if sum((save is not None, web, connect is not None)) > 1:
        raise ConfigError("--save, --web and --connect exclude each other")
    window = None if time_range is None else seconds_range("--time-range", time_range)
    from hiros_viewer import show

    check_outputs((save, "Rerun recording"), inputs=(*logs, extrinsics), force=force)
    prepare(quiet=quiet)
    from hiros_viewer.replay import ViewOptions, recording_name, replay

    options = ViewOptions(layout, window, extrinsics, stage or "")
    name = recording_name(list(logs))

    def draw(recording: object) -> None:
        replay(logs, recording, options)  # type: ignore[arg-type]

    if save is not None:
        show.save(save, name, draw)
        if not quiet:
            print(f"wrote {save}; open it with: rerun {save}")
        return 0
    if connect is not None:
        show.connect(connect, name, draw)
        return 0
    if web:
        return show.web(name, draw, lambda url: print(f"open {url}\nCtrl-C ends it", flush=True))
    code = show.window(name, draw)
    if code:
        raise ConfigError(
            f"the Rerun viewer ended with code {code}: is there a screen? --web serves it to a "
            "browser, --save writes a file"
        )
    return 0
