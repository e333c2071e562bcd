"""Random skeleton models, frames and messages, and the generic libraries that judge the codec."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import hiros_schemas
from hiros_mcap.skeletons import Frame, SkeletonModel

NAMES = ("", "pelvis", "Kopf", "左手", "épaule gauche", "🦵", "a" * 70)
STATE_FIELDS = (
    ("pose", "position", "xyz"),
    ("pose", "orientation", "xyzw"),
    ("velocity", "linear", "xyz"),
    ("velocity", "angular", "xyz"),
    ("acceleration", "linear", "xyz"),
    ("acceleration", "angular", "xyz"),
)
QUIET, PAYLOAD, NEGATIVE = 0x7FF8000000000000, 0x7FF8DEADBEEF0001, 0xFFF8000000000042


def random_ids(rng, n):
    """Distinct int32, the extremes among them."""
    wide = rng.integers(-(2**31), 2**31, 2 * n + 2).tolist()
    pool = dict.fromkeys([-(2**31), 2**31 - 1, -1, 0, *wide])
    return tuple(sorted(list(pool)[:n] if rng.random() < 0.3 else list(pool)[-n:])) if n else ()


def random_model(rng, n_markers, n_links):
    """Any names, sparse ids, links between any markers, some to a marker that is not there."""
    ends = rng.integers(-1, max(n_markers, 1) if n_markers else 0, (2, n_links)).tolist()
    return SkeletonModel(
        marker_ids=random_ids(rng, n_markers),
        marker_names=tuple(rng.choice(NAMES) + str(k) for k in range(n_markers)),
        link_ids=random_ids(rng, n_links),
        link_names=tuple(str(rng.choice(NAMES)) for _ in range(n_links)),
        link_parents=tuple(ends[0]),
        link_children=tuple(ends[1]),
        max_markers=int(rng.integers(2**32)),
        max_links=int(rng.integers(2**32)),
    )


def random_numbers(rng, *shape):
    """Numbers of every size, with NaN of several bit patterns, infinities and -0."""
    bits = (rng.normal(size=shape) * 10.0 ** rng.integers(-300, 300, shape)).view(np.uint64)
    odd = [QUIET, PAYLOAD, NEGATIVE, 0x7FF0000000000000, 0x8000000000000000]
    chosen = np.where(rng.random(shape) < 0.4, rng.choice(np.array(odd, np.uint64), shape), bits)
    return chosen.view(np.float64)


def random_frame(rng, model, n_people):
    """A frame with random numbers; a third of the markers and links are absent."""
    p, m, n = n_people, model.n_markers, model.n_links
    frame = Frame.empty(p, model, source="camera ٣", frame_id="map")
    for values, confidences, width in (
        (frame.markers, frame.marker_confidences, m),
        (frame.links, frame.link_confidences, n),
    ):
        present = rng.random((p, width)) < 0.67
        values[present] = random_numbers(rng, p, width, 19)[present]
        confidences[present] = rng.random((p, width))[present]
    return frame.replace(
        stamp=int(rng.integers(-(2**31) * 10**9, 2**31 * 10**9)),
        ids=rng.integers(-(2**31), 2**31, p).astype(np.int32),
        stamps=rng.integers(-(2**31) * 10**9, 2**31 * 10**9, p),
        confidences=random_numbers(rng, p),
        boxes=random_numbers(rng, p, 22),
    )


def random_case(seed, most=12):
    """A model and a frame of it, small enough for the generic library."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, int(rng.integers(most + 1)), int(rng.integers(most + 1)))
    return model, random_frame(rng, model, int(rng.integers(7)))


def state(values):
    """A KinematicState as the generic writer takes it."""
    numbers = iter(values.tolist())
    message: dict[str, Any] = {}
    for outer, inner, axes in STATE_FIELDS:
        message.setdefault(outer, {})[inner] = {axis: next(numbers) for axis in axes}
    return message


def time(stamp):
    return {"sec": stamp // 10**9, "nanosec": stamp % 10**9}


def message_of(frame, model):
    """The frame as a SkeletonGroup for the generic writer."""
    people = [skeleton(frame, model, p) for p in range(frame.n_people)]
    header = {"stamp": time(frame.stamp), "frame_id": frame.frame_id}
    return {"header": header, "skeletons": people}


def skeleton(frame, model, p):
    ids = (*model.marker_ids, next(k for k in range(-1, -9, -1) if k not in model.marker_ids))
    given = (~np.isnan(frame.markers[p]).all(-1)) | ~np.isnan(frame.marker_confidences[p])
    given_links = (~np.isnan(frame.links[p]).all(-1)) | ~np.isnan(frame.link_confidences[p])
    box = frame.boxes[p]
    return {
        "id": int(frame.ids[p]),
        "src_time": time(int(frame.stamps[p])),
        "src_frame": frame.source,
        "max_markers": model.max_markers,
        "max_links": model.max_links,
        "confidence": float(frame.confidences[p]),
        "bounding_box": {
            "center": state(box),
            **dict(zip(("height", "length", "width"), box[19:].tolist(), strict=True)),
        },
        "markers": [
            {
                "id": model.marker_ids[k],
                "name": model.marker_names[k],
                "confidence": float(frame.marker_confidences[p, k]),
                "center": state(frame.markers[p, k]),
            }
            for k in np.flatnonzero(given)
        ],
        "links": [
            {
                "id": model.link_ids[k],
                "name": model.link_names[k],
                "parent_marker": ids[model.link_parents[k]],
                "child_marker": ids[model.link_children[k]],
                "confidence": float(frame.link_confidences[p, k]),
                "center": state(frame.links[p, k]),
            }
            for k in np.flatnonzero(given_links)
        ],
    }


@cache
def generic_writer(text=""):
    """mcap-ros2-support's encoder for a schema text, the published one by default."""
    from mcap_ros2._dynamic import serialize_dynamic

    name = hiros_schemas.SKELETON_GROUP
    return serialize_dynamic(name, text or hiros_schemas.text(name))[name]


@cache
def generic_reader():
    """mcap-ros2-support's decoder for the published schema."""
    from mcap_ros2._dynamic import generate_dynamic

    name = hiros_schemas.SKELETON_GROUP
    return generate_dynamic(name, hiros_schemas.text(name))[name]


@cache
def rosbags_types():
    """rosbags' store of ROS 2 types with ours."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name in hiros_schemas.NAMES:
        types = get_types_from_msg(hiros_schemas.text(name), name)
        store.register({key: value for key, value in types.items() if key not in store.types})
    return store


def big_endian(data):
    """The same message with its bytes the other way round, written by rosbags."""
    store, name = rosbags_types(), hiros_schemas.SKELETON_GROUP
    message = store.deserialize_cdr(data, name)
    return bytes(store.serialize_cdr(message, name, little_endian=False))


def numbers(message):
    """The numbers of a KinematicState that a generic decoder gave."""
    return [
        getattr(getattr(getattr(message, outer), inner), axis)
        for outer, inner, axes in STATE_FIELDS
        for axis in axes
    ]


def frame_of(message, model):
    """A message of a generic decoder, as a frame."""
    header, people = message.header, message.skeletons
    sources = {person.src_frame for person in people}
    common = sources.pop() if len(sources) == 1 else ""
    frame = Frame.empty(len(people), model).replace(
        stamp=header.stamp.sec * 10**9 + header.stamp.nanosec,
        source=common or header.frame_id,
        frame_id=header.frame_id or common,
    )
    for p, person in enumerate(people):
        frame.ids[p] = person.id
        frame.stamps[p] = person.src_time.sec * 10**9 + person.src_time.nanosec
        frame.confidences[p] = person.confidence
        box = person.bounding_box
        frame.boxes[p] = [*numbers(box.center), box.height, box.length, box.width]
        for marker in person.markers:
            slot = model.marker_ids.index(marker.id)
            frame.markers[p, slot] = numbers(marker.center)
            frame.marker_confidences[p, slot] = marker.confidence
        for link in person.links:
            slot = model.link_ids.index(link.id)
            frame.links[p, slot] = numbers(link.center)
            frame.link_confidences[p, slot] = link.confidence
    return frame


def same(a, b):
    """Whether two frames agree to the bit, log times apart."""
    arrays = ("confidences", "markers", "marker_confidences", "links", "link_confidences", "boxes")
    return (
        (a.stamp, a.source, a.frame_id) == (b.stamp, b.source, b.frame_id)
        and np.array_equal(a.ids, b.ids)
        and np.array_equal(a.stamps, b.stamps)
        and all(getattr(a, k).tobytes() == getattr(b, k).tobytes() for k in arrays)
    )
