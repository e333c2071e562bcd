"""What the viewer shows of RGB cameras: keypoints, the result through the lens, and pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import rerun.blueprint as rrb
import rerun.chunk
from rosbags.typesys import Stores, get_typestore

from hiros_cli.app import run
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.rgb_cameras import RgbCamera
from hiros_mcap.io.ros_messages import COMPRESSED_IMAGE as IMAGE
from hiros_mcap.io.ros_messages import FilmFrame
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.simulation import write_log
from hiros_viewer.blueprint import cameras
from hiros_viewer.destinations import save
from hiros_viewer.poses import Poses
from hiros_viewer.replay import content_of
from hiros_viewer.scene import Scene

STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(scope="module")
def simulation():
    rig = {"kinds": ("rgb",)}
    scene = {"people": 2, "cameras": 2, "seconds": 1.0, "rig": rig, "action": "cross"}
    return simulate(SimulateParams.model_validate(scene))


def rgb_cameras(simulation):
    frames = list(simulation.keypoints)
    return [
        (
            RgbCamera(f"/{name}/keypoints", name, lens, body_model("coco-17"),
                      [frame for frame in frames if frame.camera == name]),
            simulation.transforms[name],
        )
        for name, lens in simulation.intrinsics.items()
    ]  # fmt: skip


@pytest.fixture(scope="module")
def recording(simulation, tmp_path_factory):
    target = tmp_path_factory.mktemp("view") / "images.rrd"

    def draw(sink):
        scene = Scene(sink, simulation.model)
        scene.start = start = simulation.params.start
        scene.begin({})
        scene.show_images(rgb_cameras(simulation))
        truth = Poses.joined([Poses.of(frame) for frame in simulation.truth])
        scene.draw({("filtered", ""): truth})
        for image in scene.images:
            image.keypoints(image.camera.frames, start)
            pixels = np.zeros((9, 16, 3), np.uint8)
            image.picture(FilmFrame(image.camera.name, start, start, "", b"", pixels), start)
            video = FilmFrame(image.camera.name, start, start, "h264", b"\0\0\0\1g", is_video=True)
            image.picture(video, start)
        scene.finish()
        draw.content = content_of([scene])

    save(target, "images", draw)
    return target, draw.content


def rows(recording, entity, component):
    """Stamp, ns -> values of a component of an entity."""
    found: dict[int, Any] = {}
    for chunk in rerun.chunk.RrdReader(str(recording)).stream().filter(content=entity).to_chunks():
        batch: Any = chunk.to_record_batch()
        if {component, "stamp"} <= {*batch.schema.names}:
            stamps = batch.column("stamp").cast("int64").to_numpy(zero_copy_only=False)
            found |= dict(zip(stamps.tolist(), batch.column(component).to_pylist(), strict=True))
    return found


def test_keypoints_are_drawn_at_the_times_of_their_images(recording, simulation):
    path, _ = recording
    for camera, _ in rgb_cameras(simulation):
        drawn = rows(path, f"/images/{camera.name}/keypoints", "Points2D:positions")
        for frame in camera.frames:
            found = frame.pixels[np.isfinite(frame.pixels).all(axis=-1)]
            assert np.allclose(drawn[frame.stamp], found, atol=1e-3)
        assert drawn[max(drawn)] == []  # hidden after the last image


def test_the_result_is_seen_through_the_lens(recording, simulation):
    path, _ = recording
    for name, lens in simulation.intrinsics.items():
        drawn = rows(path, f"/images/{name}/result", "Points2D:positions")
        to_camera = simulation.transforms[name].inverse()
        for frame in simulation.truth:
            true = lens.pixels(to_camera.moved(frame.positions))
            assert np.allclose(drawn[frame.stamp], true[~np.isnan(true[..., 0])], atol=0.01)
        colours = rows(path, f"/images/{name}/result", "Points2D:colors")
        assert {len(set(row)) for row in colours.values() if row} <= {1, 2}


def test_bones_join_joints_that_are_there(recording, simulation):
    path, _ = recording
    model = body_model("coco-17")
    camera, _ = rgb_cameras(simulation)[0]
    drawn = rows(path, f"/images/{camera.name}/keypoints/bones", "LineStrips2D:strips")
    for frame in camera.frames:
        there = np.isfinite(frame.pixels[..., 0])
        assert len(drawn[frame.stamp]) == there[:, model.links].all(axis=-1).sum()


def test_each_image_has_a_view_and_each_camera_a_pyramid_of_its_lens(recording, simulation):
    path, content = recording
    assert content.images == {"camera_0": (1920, 1080), "camera_1": (1920, 1080)}
    views = [view for view in _views(cameras(content)) if isinstance(view, rrb.Spatial2DView)]
    assert [view.name for view in views] == ["camera_0", "camera_1"]
    chunks = rerun.chunk.RrdReader(str(path)).stream().to_chunks()
    names = {c.entity_path: c.to_record_batch().schema.names for c in chunks}
    assert "Pinhole:image_from_camera" in names["/world/cameras/camera_0/view"]
    assert any(name.startswith("EncodedImage") for name in _components(path, "camera_0"))
    assert any(name.startswith("VideoStream") for name in _components(path, "camera_0"))


def _components(path, camera):
    entity = f"/images/{camera}/picture"
    chunks = rerun.chunk.RrdReader(str(path)).stream().filter(content=entity).to_chunks()
    return {name for chunk in chunks for name in chunk.to_record_batch().schema.names}


def _views(container):
    for part in container.contents:
        yield from _views(part) if isinstance(part, rrb.Container) else [part]


def test_a_recording_shows_its_keypoints_and_the_pictures_beneath(tmp_path):
    """The images of a camera are those in its optical frame; grey ones are of depth."""
    log, target = tmp_path / "log.mcap", tmp_path / "log.rrd"
    rig = {"kinds": ("depth", "rgb")}
    params = SimulateParams.model_validate({"cameras": 2, "seconds": 1.0, "rig": rig})
    write_log(tmp_path / "plain.mcap", params)
    with McapReader(tmp_path / "plain.mcap") as plain, McapWriter(log) as writer:
        ids = {i: writer.adopt(c, plain.schema(c)) for i, c in plain.channels.items()}
        text = STORE.generate_msgdef(IMAGE)[0]
        channel = writer.add_channel("/image", writer.add_schema(IMAGE, text.encode()))
        for frame_id in ("camera_1", "elsewhere"):
            writer.write(channel, params.start, picture_message(frame_id, params.start))
        for message in plain.messages():
            writer.write_message(ids[message.channel_id], message)
        writer.commit()
    assert run(["view", str(log), "--save", str(target), "--layout", "cameras", "-q"]) == 0
    images = {"camera_1": list(simulate(params).keypoints)}
    for name, frames in images.items():
        drawn = rows(target, f"/images/{name}/keypoints", "Points2D:positions")
        assert {frame.stamp for frame in frames} <= set(drawn)
    (picture,) = rows(target, "/images/camera_1/picture", "EncodedImage:blob").values()
    assert picture
    assert not rows(target, "/images/elsewhere/picture", "EncodedImage:blob")


def test_a_video_begins_with_the_first_keypoints_of_its_camera(tmp_path, capsys):
    log, film, target = tmp_path / "log.mcap", tmp_path / "film.mp4", tmp_path / "log.rrd"
    rig = {"kinds": ("rgb",)}
    params = SimulateParams.model_validate({"cameras": 1, "seconds": 1.0, "rig": rig})
    write_log(log, params)
    video = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"VP90"), 30, (32, 18))
    for _ in range(10):
        video.write(np.zeros((18, 32, 3), np.uint8))
    video.release()
    command = ["view", str(log), "--save", str(target), "-q", "-f", "--images"]
    assert run([*command, f"camera_0={film}"]) == 0
    stamps = sorted(rows(target, "/images/camera_0/picture", "VideoFrameReference:timestamp"))
    assert stamps[0] == next(simulate(params).keypoints).stamp
    assert np.allclose(np.diff(stamps), 1e9 / 30, atol=2)
    assert len(stamps) == 10
    assert run([*command, f"left={film}"]) == 2
    assert "no RGB camera 'left' (there are: camera_0)" in capsys.readouterr().err
    assert run([*command, f"camera_0={log}"]) == 2
    assert "no video that the viewer plays" in capsys.readouterr().err


@pytest.fixture(scope="module")
def keypoints(tmp_path_factory):
    """A log of one RGB camera without pictures, and its first time."""
    log = tmp_path_factory.mktemp("log") / "log.mcap"
    rig = {"kinds": ("rgb",)}
    params = SimulateParams.model_validate({"cameras": 1, "seconds": 0.5, "rig": rig})
    write_log(log, params)
    return log, params.start


def write_film(path, stamp, *images):
    """Write raw images: topic, width and height, encoding, bytes."""
    raw = "sensor_msgs/msg/Image"
    time = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = STORE.types["std_msgs/msg/Header"](time, "camera_0")
    with McapWriter(path) as writer:
        schema = writer.add_schema(raw, STORE.generate_msgdef(raw)[0].encode())
        channels = {topic: writer.add_channel(topic, schema) for topic, *_ in images}
        for topic, (width, height), encoding, size in images:
            data = np.zeros(size, np.uint8)
            message = STORE.types[raw](header, height, width, encoding, 0, 3 * width, data)
            writer.write(channels[topic], stamp, bytes(STORE.serialize_cdr(message, raw)))
        writer.commit()


def test_a_picture_that_claims_more_than_it_has_is_named(keypoints, tmp_path, capsys):
    (log, start), film, target = keypoints, tmp_path / "film.mcap", tmp_path / "log.rrd"
    write_film(film, start, ("/image", (100_000, 100_000), "rgb8", 10))
    assert run(["view", str(log), "--save", str(target), "-q", "--images", str(film)]) == 2
    fault = f"{film}: /image: an image of 100000 x 100000 pixels has only 10 bytes"
    assert fault in capsys.readouterr().err
    assert not target.exists()


@pytest.mark.parametrize("others", [[], ["16UC1"], ["16UC1", "rgb8"]])
def test_pictures_of_an_unknown_encoding_are_counted_where_a_camera_has_no_others(
    others, keypoints, tmp_path, capsys
):
    (log, start), film, target = keypoints, tmp_path / "film.mcap", tmp_path / "log.rrd"
    unknown = [("/image", (4, 3), "foo16", 36)] * 7
    write_film(film, start, *unknown, *((f"/{name}", (4, 3), name, 36) for name in others))
    assert run(["view", str(log), "--save", str(target), "-q", "--images", str(film)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == ("rgb8" not in others)
    for line in said:
        assert line.startswith(
            f"hiros: warning: {film}: /image: 7 images of camera_0 not drawn: 'foo16' is none of "
        )


def picture_message(frame_id, stamp):
    """A black CompressedImage of 4 x 3 px."""
    _, data = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint8))
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = types["std_msgs/msg/Header"](time, frame_id)
    return bytes(STORE.serialize_cdr(types[IMAGE](header, "png", data), IMAGE))


def test_a_result_shows_who_the_keypoints_became(tmp_path):
    log, out, target = (tmp_path / name for name in ("log.mcap", "out.mcap", "log.rrd"))
    scene = {"people": 1, "cameras": 3, "seconds": 1.0, "rig": {"kinds": ("rgb",)}}
    params = SimulateParams.model_validate(scene)
    write_log(log, params)
    assert run(["process", str(log), "-o", str(out), "-q"]) == 0
    assert run(["view", str(out), "--save", str(target), "--layout", "cameras", "-q"]) == 0
    lens = simulate(params).intrinsics["camera_0"]
    seen = rows(target, "/images/camera_0/keypoints", "Points2D:positions")
    drawn = rows(target, "/images/camera_0/result", "Points2D:positions")
    stamps = [min(drawn, key=lambda t, s=stamp: abs(t - s)) for stamp in seen]
    apart = [
        np.linalg.norm(np.mean(drawn[near], axis=0) - np.mean(found, axis=0))
        for near, found in zip(stamps, seen.values(), strict=True)
        if drawn[near] and found
    ]
    assert len(apart) > 20
    assert np.median(apart) < 0.05 * lens.size[1]
    chunks = list(rerun.chunk.RrdReader(str(target)).stream().to_chunks())
    paths = {chunk.entity_path for chunk in chunks}
    assert "/detections/rgb_cameras" in paths
    places, trail = (
        rows(target, f"/filtered/person_0{part}", "Points3D:positions") for part in ("", "/trail")
    )
    shown = [stamp for stamp in trail if len(trail[stamp])]
    hips = [np.mean(places[stamp][11:13], axis=0) for stamp in shown]  # in the order of COCO
    assert np.allclose(hips, [trail[stamp][0] for stamp in shown], atol=1e-5)
    assert len(shown) > 20
    assert "/world/cameras/camera_0" in paths
    assert "/world/cameras/rgb_cameras" not in paths  # together they stand nowhere
    assert _first_time(chunks) == _first_time(
        [chunk for chunk in chunks if chunk.entity_path == "/filtered/person_0"]
    )  # the viewer opens there, and somebody is to be seen


def _first_time(chunks):
    """Return the earliest stamp of all rows that have one, but for those of events."""
    batches = [c.to_record_batch() for c in chunks if not (c.is_static or c.entity_path == "/log")]
    return min(batch.column("stamp").to_numpy(zero_copy_only=False).min() for batch in batches)
