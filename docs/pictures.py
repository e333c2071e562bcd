"""Make the pictures of these pages anew, by the viewer itself, without a screen.

::

    python docs/pictures.py          # writes crossing.gif, live.png, ...

It needs a Vulkan driver; Debian's are libvulkan1 and mesa-vulkan-drivers.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from threading import Thread

import numpy as np
from matplotlib.image import imread, imsave
from PIL import Image
from rerun.experimental import ViewerClient

from hiros_mcap.io.container import McapReader
from hiros_mcap.io.container.file import Pipe
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.io.foxglove import FoxgloveInput
from hiros_mcap.plan.planning import make_plan
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_live import process_live, subscription
from hiros_mcap.simulate import RigParams, SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_viewer.columns import TIMELINE
from hiros_viewer.destinations import connected, running_viewer, save
from hiros_viewer.live import LiveView
from hiros_viewer.pictures import floor_figure, save_png
from hiros_viewer.replay import ViewOptions, replay

HERE = Path(__file__).parent
LOG = HERE.parent / "sample_data" / "two_people_crossing.mcap"
MENU = 37
"""Pixels: height of the viewer's menu, which is left out."""


def main() -> None:
    """Draw a plan; process the sample log, and take a picture of it in three layouts."""
    plan = make_plan(SimulateParams(people=2, cameras=4, area=(-3.0, -2.5, 3.0, 2.5)), height=2.2)
    save_png(floor_figure(plan), HERE / "floor.png")
    with tempfile.TemporaryDirectory() as folder:
        few_colours(rgb_picture(Path(folder)), HERE / "rgb.png")
        result = Path(folder) / "crossing.hiros.mcap"
        process(LOG, result)
        for layout in ("overview", "stages", "cameras"):
            recording = Path(folder) / f"{layout}.rrd"
            options = ViewOptions(layout)
            save(recording, layout, lambda sink, o=options: replay([result], sink, o))
        for layout in ("stages", "cameras"):
            (picture,) = screenshots(Path(folder) / f"{layout}.rrd", [2.0])
            pixels = imread(io.BytesIO(picture), format="png")
            imsave(HERE / f"{layout}.png", pixels[MENU:, :, :3])
        moving = screenshots(Path(folder) / "overview.rrd", np.arange(0.6, 4.2, 0.1), "1120x660")
        save_gif(moving, HERE / "crossing.gif")
        few_colours(live_picture(), HERE / "live.png")


def few_colours(picture: bytes, path: Path) -> None:
    """Write a window, a PNG, in 64 colours and without its menu."""
    window = Image.open(io.BytesIO(picture))
    window.crop((0, MENU, *window.size)).quantize(64).save(path, optimize=True)


def rgb_picture(folder: Path) -> bytes:
    """Return what four simulated RGB cameras see of two people, and the result in it, as PNG."""
    log, result, recording = (
        folder / f"rgb{suffix}" for suffix in (".mcap", ".hiros.mcap", ".rrd")
    )
    rig = RigParams(kinds=("rgb",), rate=60.0)
    write_log(log, SimulateParams(people=2, cameras=4, action="cross", seconds=5, rig=rig))
    process(log, result)
    save(recording, "rgb", lambda sink: replay([result], sink, ViewOptions("cameras")))
    (picture,) = screenshots(recording, [2.0], "1120x660")
    return picture


def live_picture() -> bytes:
    """Return the window of a run that reads what another one serves, as PNG."""
    command = [sys.executable, "-m", "hiros_cli", "process", "-", "-o", "ws://:0"]
    options = ProcessOptions(system="fuse-realtime")
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as server,
        running_viewer("--headless", "--window-size", "1120x660") as (url, viewer),
        connected(url, viewer, "live") as recording,
        McapReader(LOG) as log,
        LiveWriter(Pipe(server.stdin.fileno(), "pipe")) as writer,
    ):
        address = next(line.split()[-1] for line in server.stderr if b"serving" in line).decode()
        source = FoxgloveInput(address, subscription(options))
        watcher = LiveView(recording, lambda: True, lambda: None)
        watched = partial(process_live, source, None, options=options, watcher=watcher)
        run = Thread(target=watched)
        run.start()
        ids = {i: writer.adopt(c, log.schema(c)) for i, c in log.channels.items()}
        time.sleep(2)
        begin, first = time.monotonic(), 0
        for message in log.messages():
            first = first or message.log_time
            seconds = (message.log_time - first) / 1e9
            if seconds > 4:
                break
            time.sleep(max(0.0, begin + seconds - time.monotonic()))
            writer.write_message(ids[message.channel_id], message)
            writer.flush()
        with ViewerClient.connect(url) as client:
            picture = bytes(client.take_screenshot())
        source.stop()
        run.join()
        viewer.kill()
        server.kill()
    return picture


def save_gif(pictures: Sequence[bytes], path: Path) -> None:
    """Write PNG pictures as one that moves, ten a second, all with the colours of the first."""
    images = [Image.open(io.BytesIO(picture)).convert("RGB") for picture in pictures]
    images = [image.crop((0, MENU, image.width, image.height)) for image in images]
    first = images[0].quantize(64)
    frames = [image.quantize(palette=first, dither=Image.Dither.NONE) for image in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0)


def screenshots(recording: Path, seconds: Sequence[float], size: str = "1600x900") -> list[bytes]:
    """Return what the viewer shows of a recording at these seconds, as PNG."""
    with running_viewer("--headless", "--window-size", size) as (url, viewer):
        try:
            with ViewerClient.connect(url) as client:
                client.open(str(recording))
                while (state := client.get_state()).loading or not state.views:
                    time.sleep(0.1)
                pictures = []
                for second in seconds:
                    client.set_time(TIMELINE, duration=float(second), play_state="paused")
                    pictures.append(settled(client))
                return pictures
        finally:
            viewer.kill()
            viewer.wait()


def settled(client: ViewerClient) -> bytes:
    """Return the picture once it does not change any more."""
    before, now = b"", b"-"
    while before != now:
        time.sleep(0.5)
        before, now = now, client.take_screenshot()
    return bytes(now)


if __name__ == "__main__":
    main()
