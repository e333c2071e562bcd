"""Make the pictures of these pages anew, by the viewer itself, without a screen.

::

    python docs/pictures.py          # writes overview.png, stages.png, cameras.png and floor.png

It needs a Vulkan driver; Debian's packages are libvulkan1 and mesa-vulkan-drivers.
"""

from __future__ import annotations

import io
import tempfile
import time
from pathlib import Path

from matplotlib.image import imread, imsave
from rerun.experimental import ViewerClient

from hiros_mcap.plan.planning import make_plan
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_viewer.columns import TIMELINE
from hiros_viewer.curves import save_png
from hiros_viewer.destinations import running_viewer, save
from hiros_viewer.floor_picture import floor_figure
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
        result = Path(folder) / "crossing.hiros.mcap"
        process(LOG, result)
        for layout, second in (("overview", 2.0), ("stages", 2.0), ("cameras", 2.0)):
            recording = Path(folder) / f"{layout}.rrd"
            options = ViewOptions(layout)
            save(recording, layout, lambda sink, o=options: replay([result], sink, o))
            pixels = imread(io.BytesIO(screenshot(recording, second)), format="png")
            imsave(HERE / f"{layout}.png", pixels[MENU:, :, :3])


def screenshot(recording: Path, second: float) -> bytes:
    """Return what the viewer shows of a recording at this second, as PNG."""
    with running_viewer("--headless", "--window-size", "1600x900") as (url, viewer):
        try:
            with ViewerClient.connect(url) as client:
                client.open(str(recording))
                while (state := client.get_state()).loading or not state.views:
                    time.sleep(0.1)
                client.set_time(TIMELINE, duration=second, play_state="paused")
                return settled(client)
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
