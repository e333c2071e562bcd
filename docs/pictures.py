"""Make the pictures of these pages anew, by the viewer itself, without a screen.

::

    python docs/pictures.py          # writes crossing.gif, live.png, opensim.png, ...

It needs OpenSim's package and a Vulkan driver; Debian's are libvulkan1 and mesa-vulkan-drivers.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import chdir
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread, imsave
from PIL import Image
from rerun.experimental import ViewerClient

from hiros_cli.app import run
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
        imsave(HERE / "opensim.png", opensim_picture(result, Path(folder)))
        inverse_kinematics_figure(Path(folder)).savefig(HERE / "opensim-ik.png", dpi=110)
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


def opensim_picture(result: Path, folder: Path) -> np.ndarray:
    """Draw the first person's model of OpenSim, (H, W, 3), in the pose of its motion after 2 s."""
    import opensim

    model_file, motion_file = folder / "lab.osim", folder / "lab.mot"
    for target in (model_file, motion_file):
        run(["export", str(result), "--person", "0", "-o", str(target), "-q"])
    model = opensim.Model(str(model_file))
    state = model.initSystem()
    table = opensim.TimeSeriesTable(str(motion_file))
    row = table.getRowAtIndex(
        table.getNearestRowIndexForTime(table.getIndependentColumn()[0] + 2.0)
    )
    for name, value in zip(table.getColumnLabels(), row.to_numpy(), strict=True):
        coordinate = model.getCoordinateSet().get(name)
        is_angle = coordinate.getMotionType() == opensim.Coordinate.Rotational
        coordinate.setValue(state, np.radians(value) if is_angle else value, False)
    model.realizePosition(state)
    figure = Figure(figsize=(9, 7), layout="constrained")
    for k, (elevation, azimuth) in enumerate(((8, -60), (8, 30))):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        draw_model(axes, model, state)
        axes.view_init(elevation, azimuth)
        axes.set_box_aspect(np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1))
        axes.set_axis_off()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    buffer.seek(0)
    picture = imread(buffer)[:, :, :3]
    rows, columns = np.nonzero((picture < 0.99).any(axis=2))
    return picture[rows.min() - 20 : rows.max() + 20, columns.min() - 20 : columns.max() + 20]


def inverse_kinematics_figure(folder: Path) -> Figure:
    """Draw angles of somebody who bends, as hiros and OpenSim's inverse kinematics have them."""
    import opensim

    log, result = folder / "bend.mcap", folder / "bend.hiros.mcap"
    write_log(log, SimulateParams(action="bend", seconds=8, seed=5))
    process(log, result)
    names = ",".join(str(folder / f"bend{suffix}") for suffix in (".osim", ".trc", ".xml", ".mot"))
    run(["export", str(result), "--person", "0", "-o", names, "-q"])
    with chdir(folder):  # OpenSim finds the model and the markers beside where it runs
        opensim.InverseKinematicsTool("bend.xml").run()
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    angles = ("pelvis_tilt", "hip_flexion_r", "knee_angle_r")
    for axes, name in zip(figure.subplots(1, len(angles)), angles, strict=True):
        for file, label, style in (("bend.mot", "hiros", "-"), ("bend_ik.mot", "OpenSim", "--")):
            table = opensim.TimeSeriesTable(str(folder / file))
            values = table.getMatrix().to_numpy()[:, table.getColumnIndex(name)]
            axes.plot(table.getIndependentColumn(), values, style, label=label)
        axes.set(title=name, xlabel="s", ylabel="degrees")
    axes.legend()
    return figure


def draw_model(axes: Any, model: Any, state: Any) -> None:
    """Draw the ellipsoids of the bodies and the markers; y is up in OpenSim, z in the picture."""
    import opensim

    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, np.pi, 9))
    sphere = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    for component in model.getComponentsList():
        shape = opensim.Ellipsoid.safeDownCast(component)
        if shape is None:
            continue
        frame = shape.getFrame().getTransformInGround(state)
        turn = frame.R().asMat33()
        rotation = np.array([[turn.get(i, j) for j in range(3)] for i in range(3)])
        points = (sphere * shape.get_radii().to_numpy()) @ rotation.T + frame.p().to_numpy()
        axes.plot_surface(
            points[..., 2], points[..., 0], points[..., 1], color="#f28c28", alpha=0.45, linewidth=0
        )
    markers = model.getMarkerSet()
    places = [
        markers.get(k).getLocationInGround(state).to_numpy() for k in range(markers.getSize())
    ]
    x, y, z = np.array(places).T
    axes.scatter(z, x, y, color="#1f5fa8", s=14, depthshade=False)
    centre = np.array([z.mean(), x.mean()])
    floor = np.linspace(-0.6, 0.6, 5)
    for line in floor:
        axes.plot(centre[0] + floor, np.full(5, centre[1] + line), 0, color="#c9cfd6", lw=0.8)
        axes.plot(np.full(5, centre[0] + line), centre[1] + floor, 0, color="#c9cfd6", lw=0.8)


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
