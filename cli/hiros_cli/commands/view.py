"""``hiros view``: a log in the Rerun viewer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_cli.compiling import prepare
from hiros_cli.options import (
    EXTRINSICS,
    FORCE,
    QUIET,
    argument,
    flag,
    option,
    seconds_range,
    settings_of,
)
from hiros_cli.output import check_outputs, warn
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from rerun import RecordingStream


def view(
    logs: list[Path] = argument("LOG", "A recording or a result; a second log is overlaid."),
    layout: str = option("NAME", "overview, stages or cameras.", default="overview"),
    time_range: str | None = option("START:END", "Only this part, s from the log's start."),
    stage: str | None = option("NAME", "Stage to plot. Default: the last."),
    truth: str | None = option(
        "FILE|TOPIC", "Truth to overlay, with errors. Default: LOG's /truth channel."
    ),
    extrinsics: Path | None = EXTRINSICS,
    images: list[str] | None = option(
        "LOG|CAMERA=FILE",
        "Images beneath keypoints: of another log, or a camera's video (MP4), from its first "
        "keypoints on; may be repeated. Default: LOG's.",
    ),
    uncertainty: bool = flag(
        "--uncertainty", "Draw 68 % ellipsoids round joints (results of --system fuse)."
    ),
    save: Path | None = option("FILE", "Write a Rerun recording (.rrd) instead."),
    web: bool = flag("--web", "Serve the viewer to a browser on this machine."),
    connect: str | None = option("URL", "Send to a running viewer: rerun+http://HOST:PORT/proxy."),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> int:
    """Show logs in the Rerun viewer: people, angles, limbs, events."""
    for log in logs:
        log.stat()
    if len(logs) > 2:
        raise ConfigError("view shows at most two logs")
    if sum((save is not None, web, connect is not None)) > 1:
        raise ConfigError("use only one of --save, --web and --connect")
    window = None if time_range is None else seconds_range("--time-range", time_range)
    from hiros_viewer import destinations

    films = [Path(text.rpartition("=")[2]) for text in images or ()]
    for film in films:
        film.stat()
    inputs = (*logs, extrinsics, truth, *films)
    check_outputs((save, "Rerun recording"), inputs=inputs, force=force)
    prepare(quiet=quiet)
    from hiros_viewer.replay import ViewOptions, recording_name, replay

    configs = [settings_of(log).load() for log in logs]
    options = ViewOptions(
        *(layout, window, extrinsics, stage or "", truth),
        *(uncertainty, configs, images or (), warn),
    )
    name = recording_name(list(logs), layout)

    def draw(recording: RecordingStream, is_open: Callable[[], bool] = lambda: True) -> None:
        replay(logs, recording, options, is_open)

    if save is not None:
        with bar(f"drawing {name}", quiet=quiet):
            destinations.save(save, name, draw)
        if not quiet:
            print(f"wrote {save}; open it with: rerun {save}")
        return 0
    if connect is not None:
        destinations.connect(connect, name, draw)
        return 0
    if web:
        return destinations.web(name, draw, _announce)
    if not destinations.has_display():
        raise ConfigError("there is no screen here; use --web (browser) or --save FILE")
    code = destinations.window(name, draw)
    if code:
        raise ConfigError(
            f"the Rerun viewer ended with code {code}; without a screen, use --web (browser) or "
            "--save FILE"
        )
    return 0


def _announce(url: str) -> None:
    print(f"open {url}\nstop with Ctrl-C", flush=True)
