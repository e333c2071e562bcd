"""The real viewer for tests: headless, or its absence as a reason to skip."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import shutil
import subprocess
import time
import urllib.request
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from hiros_mcap.errors import HirosError
from hiros_viewer.destinations import running_viewer

REQUIRED = os.environ.get("HIROS_REQUIRE_VIEWER") == "1"
"""Set where a skipped viewer test is a failure, as in .ci/run."""

PACKAGES = "libvulkan1 mesa-vulkan-drivers"
"""Driver that draws without a graphics card."""

SIZE = "640x420"
"""Of the window in pixels: all of them are drawn by the processor."""

Picture = npt.NDArray[np.uint8]


def skip(reason):
    """Skip, unless the viewer must be there."""
    if REQUIRED:
        pytest.fail(reason)
    pytest.skip(reason)


def need_chromium():
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next((path for name in names if (path := shutil.which(name))), None)
    if found is None or os.environ.get("HIROS_WEB_TEST") != "1":
        if os.environ.get("HIROS_WEB_TEST") == "1":
            pytest.fail("there is no Chromium")
        pytest.skip("slow: run with HIROS_WEB_TEST=1 and Chromium")
    return str(found)


@cache
def fault_of_headless_viewer():
    """Why the viewer cannot draw without a screen here; "" if it can."""
    from rerun.experimental import ViewerClient

    try:
        with _viewer() as (url, _), ViewerClient.connect(url) as client:
            client.take_screenshot()
    except (HirosError, ConnectionError) as error:
        return f"no headless viewer ({error}); Debian packages: {PACKAGES}"
    return ""


@contextmanager
def headless():
    """Start the viewer that ``hiros process --view`` starts, without a screen."""
    if fault := fault_of_headless_viewer():
        skip(fault)
    with _viewer() as found:
        yield found


@contextmanager
def _viewer():
    with running_viewer("--headless", "--window-size", SIZE) as (url, process):
        try:
            yield url, process
        finally:
            process.kill()
            process.wait()


def picture(png):
    """(H, W, 3) pixels of a PNG."""
    from matplotlib.image import imread

    pixels = imread(io.BytesIO(png), format="png")
    return np.asarray(np.rint(pixels[..., :3] * 255), np.uint8)


def pixels_like(image, colour, apart=60):
    """How many pixels have the hue of a colour: shading makes joints darker, not greyer."""
    colours = image.reshape(-1, 3)
    colours = colours[colours.max(axis=1) > 90].astype(float)
    scaled = colours / colours.max(axis=1, keepdims=True) * max(colour)
    return int((np.abs(scaled - np.array(colour)).max(axis=1) < apart).sum())


def settled_picture(client, view_id=None):
    """Return the screenshot once it does not change any more."""
    before = b""
    for _ in range(60):
        now = client.take_screenshot(view_id)  # type: ignore[attr-defined]
        if now == before:
            return bytes(now)
        before = now
        time.sleep(0.2)
    raise AssertionError("the picture does not settle")


def listeners(pid):
    """Addresses that a process listens on, by the kernel's tables (Linux)."""
    if not Path("/proc/net/tcp").exists():
        pytest.skip("needs /proc")
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = os.readlink(link)  # noqa: PTH115
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = []
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            cells = line.split()
            if cells[3] == "0A" and cells[9] in inodes:
                found.append(cells[1].split(":")[0])
    return found


LOOPBACK = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}
"""127.0.0.1 and ::1 as the kernel writes them."""


class Browser:
    """Headless Chromium, told what to do over its DevTools socket."""

    FLAGS = (
        *("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        *("--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-sync"),
        *("--disable-background-networking", "--disable-component-update"),
        *("--window-size=800,500", "--remote-debugging-port=0"),
    )

    def __init__(self, chromium, profile, address):
        command = [chromium, *self.FLAGS, f"--user-data-dir={profile}", address]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdout=quiet, stderr=quiet)
        self._port_file = profile / "DevToolsActivePort"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()

    def screenshot(self):
        """Return what the page looks like right now, as PNG."""
        from websockets.sync.client import connect

        with connect(self._page(), max_size=None) as socket_:
            socket_.send(json.dumps({"id": 1, "method": "Page.captureScreenshot"}))
            while True:
                answer = json.loads(socket_.recv(timeout=60))
                if answer.get("id") == 1:
                    return base64.b64decode(answer["result"]["data"])

    def _page(self, seconds=30.0):
        """Address of the page's DevTools socket, as soon as there is one."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(OSError, IndexError):
                port = self._port_file.read_text().split()[0]
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5) as reply:
                    pages = [page for page in json.load(reply) if page["type"] == "page"]
                return str(pages[0]["webSocketDebuggerUrl"])
            time.sleep(0.2)
        raise AssertionError("Chromium does not start")
