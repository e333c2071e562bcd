"""MarkerArray, JointState and Log, as other programs decode them."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from poses import posed
from rosbags.typesys import Stores, get_typestore
from stick_figures import MODEL, SECOND, START, at, person, seen

import hiros_schemas
from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.evaluate.logs import read_channel
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.export.markers import (
    JOINTS,
    LABELS,
    LOG,
    MARKERS,
    MarkerExport,
    limb_chains,
    marker_array,
)
from hiros_mcap.io.export.run_summary import SummaryExport
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import body_model
from hiros_mcap.skeletons import Frame, SkeletonModel

Messages = dict[str, list[Any]]


@pytest.fixture(scope="module")
def output(whole_crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("markers") / "out.mcap"
    process(whole_crossing, out, options=ProcessOptions(markers=True))
    return out


@pytest.fixture(scope="module")
def messages(output):
    """Decoded by mcap-ros2-support."""
    found: Messages = defaultdict(list)
    with output.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = [MARKERS, LABELS, JOINTS, LOG]
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics):
            found[channel.topic].append(message)
    return found


def test_bones_lie_where_the_joints_are(output, messages):
    frames, model, _ = read_channel(output, "/hiros/filtered")
    chains = limb_chains(model)
    assert len(messages[MARKERS]) == len(frames) == 150
    for frame, array in zip(frames, messages[MARKERS], strict=True):
        by_person: dict[str, list[Any]] = defaultdict(list)
        for marker in array.markers:
            assert (marker.type, marker.action) == (4, 0)
            assert marker.header.frame_id == "world"
            turn = marker.pose.orientation
            assert (turn.x, turn.y, turn.z, turn.w) == (0, 0, 0, 1)
            stamp = marker.header.stamp
            assert stamp.sec * 1_000_000_000 + stamp.nanosec == frame.stamp
            by_person[marker.ns].append(marker)
        for row, who in enumerate(frame.ids.tolist()):
            strips = by_person[f"person {who}"]
            assert len(strips) == len(chains)
            for chain, strip in zip(chains, strips, strict=True):
                points = np.array([[p.x, p.y, p.z] for p in strip.points])
                assert np.allclose(points, frame.positions[row, list(chain)], rtol=0, atol=4e-6)


def test_everybody_has_a_label_and_a_colour(messages):
    for array in messages[LABELS]:
        assert sorted(marker.text for marker in array.markers) == ["0", "1"]
        colours = {(m.color.r, m.color.g, m.color.b) for m in array.markers}
        assert len(colours) == 2
        assert {m.color.a for m in array.markers} == {1.0}  # opaque
        assert all(m.pose.position.z > 1.4 for m in array.markers)


def test_joint_states_are_the_signed_angles(output, messages):
    frames, model, _ = read_channel(output, "/hiros/filtered")
    poses = np.stack([frame.positions[frame.ids.tolist().index(1)] for frame in frames])
    angles = anatomical_angles(model, poses)
    for state, row in zip(messages[JOINTS], angles, strict=True):
        named = dict(zip(state.name, state.position, strict=True))
        for angle, value in zip(ANGLE_NAMES, row, strict=True):
            name = f"person_1/{angle.replace(' ', '_')}"
            assert (name in named) == (not np.isnan(value))
            assert named.get(name, np.nan) == pytest.approx(value, abs=1e-4, nan_ok=True)


def test_joint_states_go_on_beyond_half_a_turn(tmp_path):
    with McapWriter(tmp_path / "out.mcap") as writer:
        export = MarkerExport(writer, body_model.MODEL, Events())
        for k in range(18):
            frame = Frame.empty(1, body_model.MODEL, stamp=at(k), frame_id="world")
            frame.ids[:], frame.markers[0, :, :3] = 3, posed(pelvis=(0, 0, 20.0 * k))[0]
            export.write(Block.of(frame))
        writer.commit()
    found = [dict(zip(s.name, s.position, strict=True)) for s in decoded(tmp_path / "out.mcap")]
    turned = np.degrees([angles["person_3/pelvis_rotation"] for angles in found])
    np.testing.assert_allclose(np.diff(turned), 20, atol=1e-6)


def decoded(path, topic=JOINTS):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [message for *_, message in reader.iter_decoded_messages(topics=[topic])]


def test_what_happened_is_logged(messages):
    texts = [(entry.level, entry.name, entry.msg) for entry in messages[LOG]]
    assert (20, "hiros", "limbs calibrated person 0: 76 frames") in texts
    assert any("track born person 1" in text for _, _, text in texts)
    times = [(entry.stamp.sec, entry.stamp.nanosec, entry.msg) for entry in messages[LOG]]
    assert len(set(times)) == len(times)


def test_a_dashboard_shows_who_is_there_once_a_second_and_when_somebody_comes(tmp_path):
    with McapWriter(tmp_path / "out.mcap") as writer:
        summary = SummaryExport(writer, Events())
        for k in range(42):
            ids = [4, 7][: (k >= 5) + (k >= 10)]
            frame = seen([person(3 * i) for i in range(len(ids))], at(k), ids=ids)
            summary.write(Block.of(frame))
        writer.commit()
    shown = []
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, logged, message in reader.iter_decoded_messages():
            people, events = message.status
            texts = [value.value for value in people.values]
            frame = round((logged.log_time - at(0)) / (at(1) - at(0)))
            shown.append((frame, people.message, texts))
            assert (events.message, events.level) == ("none", 0)
    assert shown == [
        (0, "0 people", []),
        (5, "1 person", ["for 0.0 s"]),
        (10, "2 people", ["for 0.2 s", "for 0.0 s"]),
        (41, "2 people", ["for 1.2 s", "for 1.0 s"]),  # 30 periods are a little less than 1 s
    ]


def test_a_dashboard_is_told_after_a_second_and_not_sooner(tmp_path):
    with McapWriter(tmp_path / "out.mcap") as writer:
        summary = SummaryExport(writer, Events())
        for ns in (0, SECOND - 1, SECOND, 2 * SECOND - 1, 2 * SECOND):
            summary.write(Block.of(seen([person()], START + ns, ids=[4])))
        writer.commit()
    with McapReader(tmp_path / "out.mcap") as reader:
        assert [m.log_time - START for m in reader.messages()] == [0, SECOND, 2 * SECOND]


@pytest.mark.parametrize(
    "name", [hiros_schemas.MARKER_ARRAY, hiros_schemas.JOINT_STATE, hiros_schemas.LOG]
)
def test_definitions_are_those_of_ros(name):
    store = get_typestore(Stores.ROS2_HUMBLE)
    assert hiros_schemas.type_hash(name) == store.hash_rihs01(name)


def test_rosbags_decodes_the_same(output, messages):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with output.open("rb") as file:
        raw = [m.data for _, _, m in make_reader(file).iter_messages(topics=[MARKERS])]
    for data, decoded in zip(raw[:20], messages[MARKERS][:20], strict=True):
        other: Any = store.deserialize_cdr(data, hiros_schemas.MARKER_ARRAY)
        assert [m.id for m in other.markers] == [m.id for m in decoded.markers]
        assert bytes(store.serialize_cdr(other, hiros_schemas.MARKER_ARRAY)) == data


def test_chains_run_from_branching_to_branching():
    assert limb_chains(MODEL) == ((0, 1), (0, 4), (0, 5), (1, 2, 6), (1, 3, 7))
    assert limb_chains(SkeletonModel.of(["a", "b", "c"], [("", 0, 1), ("", 1, 2)])) == ((0, 1, 2),)
    assert limb_chains(SkeletonModel.of(["a"], [])) == ()


def test_a_missing_joint_splits_a_chain_and_nobody_is_no_marker():
    store = get_typestore(Stores.ROS2_HUMBLE)
    frame = seen([person()], at(0), ids=[3])
    frame.markers[0, 2] = np.nan
    array: Any = store.deserialize_cdr(
        marker_array(frame, limb_chains(MODEL)), hiros_schemas.MARKER_ARRAY
    )
    assert [len(marker.points) for marker in array.markers] == [2, 2, 2, 3]
    empty: Any = store.deserialize_cdr(
        marker_array(frame.replace(ids=np.array([-1], np.int32)), limb_chains(MODEL)),
        hiros_schemas.MARKER_ARRAY,
    )
    assert empty.markers == []
