"""Colour and depth images of a ball in a cluttered room, and logs of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import hiros_schemas
from hiros_mcap.body.rotations import Rigid, rotate
from hiros_mcap.skeletons import Floats

RADIUS = 0.12
WIDTH, HEIGHT, FOCAL = 160, 120, 130.0
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]])
STORE = get_typestore(Stores.ROS2_HUMBLE)
RED, WALL, BRICK, FLOOR = (30, 30, 200), (190, 185, 180), (40, 60, 150), (90, 110, 80)  # BGR


def camera_at(angle, distance=2.2):
    """Optical frame (z forward, y down) in the world, looking at (0, 0, 1) from all around."""
    place = np.array([distance * np.cos(angle), distance * np.sin(angle), 1.6])
    z = np.array([0, 0, 1.0]) - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    matrix = np.stack([x, np.cross(z, x), z], axis=1)
    return Rigid(Rotation.from_matrix(matrix).as_quat(), place)


def render(ball, seed=0, *, noise=0.005, wrong=0.1, radius=RADIUS, clutter=True):
    """Ray-cast a ball (centre in the camera's frame) before a wall: BGR (H, W, 3), depth (H, W), m.

    ``wrong`` is the share of depth pixels that are holes, and again that of stray depths. The
    clutter is a flat box of the ball's very colour, and a brick-coloured one.
    """
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - 79.5) / FOCAL, (rows - 59.5) / FOCAL, np.ones((HEIGHT, WIDTH))], -1)
    depth = np.full((HEIGHT, WIDTH), 4.0)
    color = np.empty((HEIGHT, WIDTH, 3))
    color[:] = np.where((rows > 90)[..., None], FLOOR, WALL)
    if clutter:
        for left, tone in ((5, RED), (130, BRICK)):
            color[70:95, left : left + 25], depth[70:95, left : left + 25] = tone, 2.5
    if ball is not None:
        a, b = np.sum(rays**2, -1), rays @ ball
        inside = b**2 - a * (ball @ ball - radius**2)
        z = (b - np.sqrt(np.maximum(inside, 0))) / a
        hit = (inside > 0) & (z < depth)
        normals = (rays * z[..., None] - ball) / radius
        light = np.clip(-normals @ [0.3, 0.6, 0.7], 0.0, 1.0)
        depth[hit] = z[hit]
        color[hit] = (0.5 + 0.5 * light[hit, None]) * RED
    color += rng.normal(0, 4, color.shape)
    depth += rng.normal(0, noise, depth.shape)
    strays = rng.random(depth.shape) < wrong
    depth[strays] += rng.uniform(-0.5, 0.5, strays.sum())
    depth[rng.random(depth.shape) < wrong] = np.nan
    return np.clip(color, 0, 255).astype(np.uint8), depth


def header(stamp, frame):
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](time, frame)


def image(head, pixels, encoding):
    """Image with rows padded by 4 bytes."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, 4)))
    kind = STORE.types["sensor_msgs/msg/Image"]
    return kind(head, height, width, encoding, 0, rows.shape[1], rows.reshape(-1))


def compressed(head, pixels, form, extension, start=b""):
    data = np.frombuffer(start + cv2.imencode(extension, pixels)[1].tobytes(), np.uint8)
    return STORE.types["sensor_msgs/msg/CompressedImage"](head, form, data)


def millimetres(depth):
    return np.nan_to_num(1000 * depth).round().astype("<u2")


def camera_info(head, matrix=K):
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    kind = STORE.types["sensor_msgs/msg/CameraInfo"]
    p = np.hstack([matrix, np.zeros((3, 1))]).reshape(-1)
    flat = matrix.reshape(-1).astype(float)
    args = (head, HEIGHT, WIDTH, "plumb_bob", np.zeros(5), flat, np.eye(3).reshape(-1), p)
    return kind(*args, 0, 0, roi)


def point(head, place):
    kind = STORE.types["geometry_msgs/msg/PointStamped"]
    return kind(head, STORE.types["geometry_msgs/msg/Point"](*map(float, place)))


def write_messages(path, messages, *, static=b""):
    """Write (topic, log time, message) by the mcap library, and the bytes of a /tf_static."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        if static:
            text = hiros_schemas.text(hiros_schemas.TF_MESSAGE).encode()
            schema = writer.register_schema(hiros_schemas.TF_MESSAGE, "ros2msg", text)
            writer.add_message(writer.register_channel("/tf_static", "cdr", schema), 1, static, 1)
        for topic, time, message in sorted(messages, key=lambda m: m[1]):
            name = message.__msgtype__
            if topic not in channels:
                text = STORE.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(STORE.serialize_cdr(message, name))
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def ball_path(n):
    """(n, 3) where somebody carries the ball about (0, 0, 1)."""
    t = np.linspace(0, 9, n)[:, None]
    return np.sin(t * [1.0, 0.73, 1.9] + [0, 1, 2]) * [0.5, 0.5, 0.3] + [0, 0, 1.0]


Encoder = Callable[[Any, Floats], Any]


def images_of(
    k,
    camera,
    path,
    colour=lambda head, pixels: image(head, pixels[:, :, ::-1], "rgb8"),
    depth=lambda head, metres: image(head, millimetres(metres), "16UC1"),
):
    """Return the messages of camera k, whose images come 2 ms apart."""
    frame, found = f"camera_{k}_optical", []
    for i, place in enumerate(path):
        stamp = 10**18 + i * 33_333_333
        seen = rotate(camera.inverse().xyzw, place) + camera.inverse().translation
        pixels, metres = render(seen, 100 * k + i)
        found += [
            (f"/camera_{k}/color/image_raw", stamp, colour(header(stamp, frame), pixels)),
            (
                f"/camera_{k}/depth/image_raw",
                stamp + 1,
                depth(header(stamp + 2_000_000, frame), metres),
            ),
        ]
    found += [
        (f"/camera_{k}/{kind}/camera_info", 10**18, camera_info(header(10**18, frame)))
        for kind in ("color", "depth")
    ]
    return found


def centres_of(cameras, path, noise=0.002):
    rng, found = np.random.default_rng(0), []
    for k, camera in enumerate(cameras):
        back = camera.inverse()
        for i, place in enumerate(path):
            stamp = 10**18 + i * 33_333_333 + k
            seen = rotate(back.xyzw, place) + back.translation + rng.normal(0, noise, 3)
            found.append((f"/ball_{k}", stamp, point(header(stamp, f"camera_{k}"), seen)))
    return found


def write_bag(path, messages):
    """Write a ROS 1 bag (path ends in .bag) or a SQLite bag by the rosbags library."""
    from rosbags import rosbag1, rosbag2

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC) if is_ros1 else STORE
    bag = rosbag1.Writer(path) if is_ros1 else rosbag2.Writer(path, version=8)
    with bag:
        channels: dict[str, Any] = {}
        for topic, time, message in sorted(messages, key=lambda m: m[1]):
            name = message.__msgtype__
            if topic not in channels:
                channels[topic] = bag.add_connection(topic, name, typestore=store)
            if is_ros1:
                data = STORE.cdr_to_ros1(STORE.serialize_cdr(message, name), name)
            else:
                data = store.serialize_cdr(message, name)
            bag.write(channels[topic], time, bytes(data))
