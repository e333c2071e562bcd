"""Where a recording goes: a file, a viewer's window, a browser, a viewer that already runs."""

from __future__ import annotations

import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.errors import ConfigError, HirosError, LogError
from hiros_mcap.outputs import replacing

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "hiros"
LOOPBACK = "127.0.0.1"
_PATIENCE_S = 20.0
_ROOM = 1 << 16
"""Bytes, more than what is left of a disk on which rerun finds no place."""
MEMORY_LIMIT = "50%"
"""Of the machine's; a viewer or its server drops what is oldest beyond it."""

Draw = Callable[["rr.RecordingStream"], object]
"""Draws all of a log."""
DrawWhile = Callable[["rr.RecordingStream", Callable[[], bool]], object]
"""Draws a log as long as the function says that somebody looks."""


def new_recording(name: str) -> rr.RecordingStream:
    """Return a recording that goes nowhere yet; the same name gives the same id."""
    # Wall-clock times in a recording would differ from run to run.
    os.environ.setdefault("RERUN_LOG_TIME", "0")
    import rerun as rr

    recording_id = hashlib.sha256(name.encode()).hexdigest()[:12]
    recording = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    recording.send_recording_name(name)
    return recording


def save(target: Path, name: str, draw: Draw) -> None:
    """Write a recording with its layout to a file; whole or not at all.

    Raises LogError if the file cannot be written.
    """
    recording = new_recording(name)
    with replacing(target) as temporary:
        temporary.touch()  # rerun's own error would be none of the file system
        try:
            _told_of_the_disk(temporary, target, lambda: recording.save(temporary))
            draw(recording)
        finally:
            try:  # else a full disk goes unnoticed
                _told_of_the_disk(temporary, target, recording.flush)
            finally:
                recording.disconnect()


def _told_of_the_disk(file: Path, target: Path, write: Callable[[], object]) -> None:
    """Have rerun write to a file; raises OSError or LogError where it cannot."""
    try:
        write()
    except RuntimeError as error:
        with file.open("ab") as end:  # which the system refuses in its own words
            end.write(bytes(_ROOM))
        raise LogError(f"cannot be written: {error}", path=target) from error


def connect(url: str, name: str, draw: Draw) -> None:
    """Send a recording to a viewer that already runs.

    Raises ConfigError if nothing listens there.
    """
    _need_listener(url)
    recording = new_recording(name)
    recording.connect_grpc(url)
    draw(recording)
    recording.flush()
    recording.disconnect()


def _need_listener(url: str) -> None:
    """Fail at once where rerun would try again and again."""
    from urllib.parse import urlsplit

    parts = urlsplit(url)
    if parts.scheme not in ("rerun+http", "rerun+https", "rerun") or parts.path != "/proxy":
        raise ConfigError(f"--connect: {url!r} is not of the form rerun+http://HOST:PORT/proxy")
    try:
        with socket.create_connection((parts.hostname or LOOPBACK, parts.port or 9876), timeout=5):
            return
    except OSError as error:
        raise ConfigError(f"--connect: no viewer at {url}: {error.strerror or error}") from None


def has_display() -> bool:
    """Whether a window can be opened here."""
    if not sys.platform.startswith("linux"):
        return True
    return any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")))


def window(name: str, draw: DrawWhile) -> int:
    """Open a viewer's window, draw into it, wait until it is closed, return its exit code.

    Raises HirosError if it does not open.
    """
    with running_viewer() as (url, process):
        return _draw_into(url, process, name, draw)


def web(name: str, draw: DrawWhile, announce: Callable[[str], None]) -> int:
    """Serve the web viewer on the loopback address until it is interrupted.

    ``announce`` is told the address to open, where the picture grows while the log is read.

    Raises HirosError if the server does not start.
    """
    with web_server() as (page, url, server):
        announce(page)
        return _draw_into(url, server, name, draw)


def _draw_into(url: str, process: subprocess.Popen[bytes], name: str, draw: DrawWhile) -> int:
    """Draw until all is drawn or the viewer ends; wait for its end. It ends if drawing fails."""
    try:
        with connected(url, process, name) as recording:
            draw(recording, lambda: process.poll() is None)
            if process.poll() is None:
                recording.flush()
        return process.wait()
    except BaseException:
        process.terminate()
        process.wait()
        raise


@contextmanager
def connected(
    url: str, process: subprocess.Popen[bytes], name: str
) -> Iterator[rr.RecordingStream]:
    """Yield a recording that goes to a viewer."""
    recording = new_recording(name)
    recording.connect_grpc(url)
    try:
        yield recording
    finally:
        if process.poll() is None:
            recording.disconnect()


def _start(command: Sequence[str], folder: str, *, outlives: bool) -> subprocess.Popen[bytes]:
    """Start a viewer; its own words would stand beside ours, with an address of its own."""
    return subprocess.Popen(  # noqa: S603
        command,
        env=environment(Path(folder)),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=outlives,
    )


@contextmanager
def web_server() -> Iterator[tuple[str, str, subprocess.Popen[bytes]]]:
    """Start the web viewer; yield the page's address, where to send to, and the server's process.

    The server ends with the context, also if a signal comes before anything is drawn.

    Raises HirosError if it does not start.
    """
    page, data = free_port(), free_port()
    command = [
        *(str(viewer_binary()), "--serve-web", "--bind", LOOPBACK),
        *("--web-viewer-port", str(page), "--port", str(data)),
        *("--server-memory-limit", MEMORY_LIMIT),  # beyond, the log's beginning would be dropped
    ]
    with tempfile.TemporaryDirectory(prefix="hiros-view-") as folder:
        server = _start(command, folder, outlives=False)
        try:
            _wait_for(data, server)
            stream = f"rerun%2Bhttp%3A%2F%2F{LOOPBACK}%3A{data}%2Fproxy"
            address = f"http://{LOOPBACK}:{page}/?url={stream}"
            yield address, f"rerun+http://{LOOPBACK}:{data}/proxy", server
        finally:
            server.terminate()
            server.wait()


def viewer_binary() -> Path:
    """Return the viewer itself; the ``rerun`` script would only start it as a child."""
    import rerun_cli

    return Path(rerun_cli.__file__).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")


def environment(folder: Path) -> dict[str, str]:
    """Environment of a viewer that neither sends statistics nor says that it might.

    A user who has made a choice (``rerun analytics ...``) keeps it. Otherwise the viewer is given
    a folder for its configuration in which statistics are off.
    """
    env = dict(os.environ)
    home = Path(env.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    if sys.platform.startswith("linux") and not (home / "rerun" / "analytics.json").exists():
        private = folder / "config"
        (private / "rerun").mkdir(parents=True, exist_ok=True)
        path = private / "rerun" / "analytics.json"
        choice = {
            "analytics_enabled": False,
            "analytics_id": uuid.uuid4().hex,
            "metadata": {},
            "config_file_path": str(path),
            "data_dir_path": str(private / "rerun"),
        }
        path.write_text(json.dumps(choice), encoding="utf-8")
        env["XDG_CONFIG_HOME"] = str(private)
    return env


def free_port() -> int:
    """Return a port that nothing listens on right now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_viewer(*arguments: str) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Start a viewer to stream to; yield its address and its process, which is left running.

    Raises HirosError if it does not start (there may be no screen).
    """
    port = free_port()
    command = [
        *(str(viewer_binary()), "--bind", LOOPBACK, "--port", str(port)),
        *("--memory-limit", MEMORY_LIMIT, "--expect-data-soon", *arguments),
    ]
    with tempfile.TemporaryDirectory(prefix="hiros-view-") as folder:
        process = _start(command, folder, outlives=True)
        _wait_for(port, process)
        yield f"rerun+http://{LOOPBACK}:{port}/proxy", process


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    import time

    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        if process.poll() is not None:
            raise HirosError(
                f"the Rerun viewer ended with code {process.returncode}; without a screen, use "
                "`hiros view --web` (browser) or `hiros view --save FILE`"
            )
        try:
            with socket.create_connection((LOOPBACK, port), timeout=1):
                return
        except OSError:
            time.sleep(0.05)
    process.kill()
    raise HirosError(f"the Rerun viewer did not start within {_PATIENCE_S:.0f} s")
