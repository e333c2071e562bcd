"""Copies are no evidence: a person twice in a message, a topic that repeats another one."""

from __future__ import annotations

import numpy as np
import pytest
from odd_logs import changed

from hiros_cli.app import run
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import POSITION


def frames_of(path):
    with open_log(path) as log:
        read = log.read()
        return list(read.frames()), read


def twice(frame, shift=0.0, joints=slice(None)):
    """Every person a second time, so far away, with some of the joints."""
    n = frame.n_people
    doubled = frame.select([*range(n), *range(n)])
    markers = np.full_like(doubled.markers, np.nan)
    markers[:n], markers[n:, joints] = frame.markers, frame.markers[:, joints]
    markers[n:, :, POSITION] += shift
    return doubled.replace(markers=markers, ids=np.arange(2 * n, dtype=frame.ids.dtype))


@pytest.mark.parametrize("joints", [slice(None), slice(5, 20)])
@pytest.mark.parametrize("first", [False, True])
def test_a_person_twice_in_a_message_is_one(joints, first, crossing, tmp_path):
    def change(frame, _):
        doubled, n = twice(frame, joints=joints), frame.n_people
        return doubled.select([*range(n, 2 * n), *range(n)]) if first else doubled

    frames, read = frames_of(changed(crossing, tmp_path / "log.mcap", change))
    expected, _ = frames_of(crossing)
    for frame, other in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.markers[..., :3], other.markers[..., :3])
    notes = [n for a in read.accounts.values() for n in a.notes(read.log.model.marker_names)]
    assert any("another one in the same message has the same joints" in n for n in notes)


@pytest.mark.parametrize("last", [6, 7, 8, 9])
def test_three_joints_at_the_same_places_tell_a_copy_and_two_do_not(last, crossing, tmp_path):
    joints = slice(5, last)
    log = changed(crossing, tmp_path / "log.mcap", lambda f, _: twice(f, joints=joints))
    for frame, other in zip(frames_of(log)[0], frames_of(crossing)[0], strict=True):
        shown = np.isfinite(other.markers[:, joints, 0]).sum(axis=1)
        assert frame.n_people == other.n_people + np.isin(shown, [1, 2]).sum()


def test_people_who_stand_close_are_two(crossing, tmp_path):
    close = changed(crossing, tmp_path / "log.mcap", lambda f, _: twice(f, 0.02))
    for frame, other in zip(frames_of(close)[0], frames_of(crossing)[0], strict=True):
        assert frame.n_people == 2 * other.n_people


def with_relays(source, target, change=lambda frame: frame, prefix="/relay", every=1):
    """Copy a log; each camera is also published a moment later on another topic."""
    with open_log(source) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        decoder, encoder = Decoder(log.model, exact=True), Encoder(log.model)
        relays = {}
        for message in log.reader.messages():
            topic, data = log.reader.channels[message.channel_id].topic, bytes(message.data)
            writer.write(message.channel_id, message.log_time, data)
            if topic.startswith("/camera_"):
                if topic not in relays:
                    relays[topic] = add_skeleton_channel(writer, prefix + topic)
                (frame,) = decoder.decode_message(data, message.log_time)
                if writer.counts[message.channel_id] % every == 0:
                    data = encoder.encode(change(frame))
                    writer.write(relays[topic], message.log_time + 20_000_000, data)
        writer.commit()
    return target


def restamped(frame):
    """As a node publishes it that sets its own time, and rounds to float32."""
    markers = frame.markers.astype(np.float32).astype(np.float64)
    return frame.replace(stamp=frame.stamp + 5_000_000, markers=markers)


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("change", [lambda frame: frame, restamped])
def test_a_topic_that_repeats_another_is_left_out(change, every, crossing, tmp_path, capsys):
    path = with_relays(crossing, tmp_path / "log.mcap", change, every=every)
    with open_log(path) as log, open_log(crossing) as original:
        assert log.cameras[0].sources == original.cameras[0].sources
        assert len(log.cameras) == len(original.cameras)
    assert run(["info", str(path)]) == 0
    assert "left out, a copy of /camera_0/skeletons" in capsys.readouterr().out


def test_a_camera_that_sees_the_same_people_elsewhere_is_no_copy(crossing, tmp_path):
    def change(frame):
        markers = frame.markers.copy()
        markers[..., 0] += 0.05
        return frame.replace(markers=markers)

    path = with_relays(crossing, tmp_path / "log.mcap", change, prefix="/other")
    with open_log(path) as log, open_log(crossing) as original:
        assert len(log.cameras) == 2 * len(original.cameras)


def test_stages_that_show_the_same_are_no_copies(crossing, tmp_path):
    with_relays(crossing, tmp_path / "log.mcap", prefix="/hiros/relay")
    with open_log(tmp_path / "log.mcap", topics=["*"], output_prefix="/none") as log:
        topics = [camera.channel.topic for camera in log.cameras]
    assert sum(topic.startswith("/hiros/") for topic in topics) == 3
