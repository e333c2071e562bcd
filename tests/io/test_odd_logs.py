"""Recordings with something wrong in them: a run says so, and nothing is lost in silence."""

from __future__ import annotations

import re
import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest
from mcap.writer import Writer
from odd_logs import believed, changed, later, scaled

from hiros_cli.app import run as command
from hiros_mcap.config import load_config
from hiros_mcap.errors import LogError
from hiros_mcap.io.container import Channel, McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.systems import SYSTEMS

SECOND = 1_000_000_000


def run(source, folder, change):
    return process(changed(source, folder / "odd.mcap", change))


def noted(summary, pattern):
    return [note for note in summary.notes if re.search(pattern, note)]


def warned(summary, pattern):
    return [text for text in summary.warnings if re.search(pattern, text)]


def clock_set_back(frame, sent):
    return later(frame, -100 * SECOND) if sent >= 70 and frame.source == "camera_1" else frame


UNJUDGED = ["input.clocks=off"]


def test_messages_that_come_too_late_are_skipped_ones_of_their_camera(whole_crossing, tmp_path):
    source = changed(whole_crossing, tmp_path / "odd.mcap", clock_set_back)
    summary = process(source, config=load_config(None, UNJUDGED))
    lost = {camera.topic: dict(camera.skipped) for camera in summary.cameras}
    assert lost["/camera_1/skeletons"] == {"too late to be merged": 77}
    assert lost["/camera_0/skeletons"] == lost["/camera_2/skeletons"] == {}
    assert all(c.messages == c.used + sum(c.skipped.values()) for c in summary.cameras)
    assert summary.skipped == 77
    assert summary.warnings[0].startswith("/camera_1/skeletons: 52 % of 147 messages not used")
    assert "--set track.reorder=3" in summary.warnings[0]


def test_a_clock_that_is_set_back_costs_nothing(whole_crossing, tmp_path):
    summary = run(whole_crossing, tmp_path, clock_set_back)
    assert summary.skipped == 0
    (warning,) = summary.warnings
    assert warning.startswith("the clock of camera_1 was set back by 100.00 s, 2.")


@pytest.mark.parametrize("system", ["hiros", "malaguti"])
def test_a_strict_run_refuses_messages_that_come_too_late(system, whole_crossing, tmp_path):
    source = changed(whole_crossing, tmp_path / "odd.mcap", clock_set_back)
    options = ProcessOptions(system=system, strict=True)
    config = load_config(None, UNJUDGED, system=system)
    with pytest.raises(LogError, match=r"/camera_1.*77 messages skipped: too late to be merged"):
        process(source, tmp_path / "out.mcap", options=options, config=config)
    assert [path.name for path in tmp_path.iterdir()] == ["odd.mcap"]


@pytest.mark.parametrize("stamp", [0, -5 * SECOND])
def test_a_time_that_cannot_be_is_that_of_the_log(stamp, crossing, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        summary = run(
            crossing, tmp_path, lambda f, _: f.replace(stamp=stamp, stamps=0 * f.stamps + stamp)
        )
    assert len(summary.people) == 2
    assert summary.skipped == 0
    assert noted(
        summary, "/camera_0/skeletons: 59 messages without a time, or with one before 1970"
    )
    (warning,) = warned(summary, "have no time, or one before 1970")
    assert warning.startswith("/camera_0/skeletons, /camera_1/skeletons, /camera_2/skeletons: 176 ")
    assert "of 176 messages" in warning
    assert "log times instead" in warning


def test_few_messages_without_a_time_are_a_note(crossing, tmp_path):
    def sometimes(frame, sent):
        return frame.replace(stamp=0, stamps=0 * frame.stamps) if sent % 31 == 30 else frame

    summary = run(crossing, tmp_path, sometimes)
    assert noted(summary, "/camera_0/skeletons: 1 message without a time")
    assert not warned(summary, "have no time")


def test_channels_that_name_no_frame_are_told(crossing, tmp_path):
    log = changed(crossing, tmp_path / "odd.mcap", lambda f, _: f.replace(frame_id="", source=""))
    with pytest.raises(LogError, match="name no frame, but do not see the same people"):
        process(log)
    (remark,) = [text for text in overview_of(log).remarks if "without a coordinate frame" in text]
    assert "/camera_0/skeletons, /camera_1/skeletons, /camera_2/skeletons" in remark
    assert "does not use the log's transforms" in remark
    assert not noted(process(crossing), "name no")


def test_negative_confidences_are_not_given_and_large_ones_are_1(crossing, tmp_path):
    negative = run(crossing, tmp_path, lambda f, _: believed(f, -1.0))
    assert len(negative.people) == 2
    assert noted(negative, r"/camera_0/skeletons: \d+ negative confidences taken as missing")
    percent = run(crossing, tmp_path, lambda f, _: believed(f, 99.0))
    assert len(percent.people) == 2
    assert noted(percent, r"/camera_0/skeletons: \d+ confidences above 1 taken as 1")


def test_nobody_is_found_because_of_the_confidences(crossing, tmp_path):
    summary = run(crossing, tmp_path, lambda f, _: believed(f, 0.0))
    assert summary.people == ()
    assert warned(summary, "every marker has confidence 0")
    assert noted(summary, r"\d+ detections ignored: seen too briefly or by too few cameras")


def test_nobody_is_found_because_of_the_unit(crossing, tmp_path):
    summary = run(crossing, tmp_path, lambda f, _: scaled(f, 1000.0))
    assert summary.people == ()
    assert warned(summary, "looks like millimetres")
    assert not noted(summary, "confidence 0")


def test_nobody_is_found_because_of_too_few_joints(crossing, tmp_path):
    def three(frame, _):
        markers = frame.markers.copy()
        markers[:, 3:] = np.nan
        return frame.replace(markers=markers)

    summary = run(crossing, tmp_path, three)
    assert summary.people == ()
    (warning,) = summary.warnings
    assert re.search(r"nobody was found, .*: \d+ detections .* fewer markers than", warning)


def test_a_message_years_ahead_is_told(crossing, tmp_path):
    def ahead(frame, sent):
        return later(frame, 10**8 * SECOND) if sent == 50 and frame.source == "camera_2" else frame

    summary = run(crossing, tmp_path, ahead)
    assert summary.skipped == 0
    assert summary.warnings[0].startswith("camera_2: 1 message with a wrong time (by up to 3.2 ye")


@pytest.mark.parametrize("schema", ["foxglove.Pose", "Example", "a/b/c/d", ""])
def test_channels_of_other_programs_do_no_harm(schema, walking, tmp_path):
    log = tmp_path / "foreign.mcap"
    with open_log(walking) as source, log.open("wb") as file:
        writer = Writer(file)
        writer.start()
        foreign = writer.register_schema(schema, "jsonschema", b"{}")
        pose = writer.register_channel("/pose", "json", foreign)
        ids = {}
        for known in source.reader.channels.values():
            definition = source.reader.schema(known)
            assert definition is not None
            own = writer.register_schema(definition.name, definition.encoding, definition.data)
            ids[known.id] = writer.register_channel(known.topic, "cdr", own)
        for message in source.reader.messages():
            time = message.log_time
            writer.add_message(ids[message.channel_id], time, bytes(message.data), time)
            writer.add_message(pose, time, b"{}", time)
        writer.finish()
    assert len(process(log).people) == 1
    assert command(["info", str(log)]) == 0


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("messages", [True, False])
def test_an_empty_room_gives_an_empty_result(system, messages, short, tmp_path):
    source, out = tmp_path / "empty.mcap", tmp_path / "out.mcap"

    def nobody(frame, _):
        return frame.replace(people=frame.people.at(slice(0, 0)))

    changed(short, source, nobody, keep=messages)
    summary = process(source, out, options=ProcessOptions(system=system))
    assert summary.people == ()
    assert any("the room is empty" in text for text in (*summary.notes, *summary.warnings))
    with McapReader(out) as reader:
        copied = {channel.topic for channel in reader.channels.values()}
        assert copied >= {"/camera_0/skeletons", "/camera_1/skeletons", "/tf_static"}
        assert sum(camera.messages for camera in summary.cameras) == (87 if messages else 0)


def test_the_largest_ids_times_and_numbers_are_read_and_copied(walking, tmp_path):
    source, out = tmp_path / "large.mcap", tmp_path / "out.mcap"
    largest = {"sequence": 2**32 - 1, "publish_time": 2**64 - 1}
    with McapReader(walking) as reader, McapWriter(source) as writer:
        for channel in reader.channels.values():
            schema = reader.schema(channel)
            assert schema is not None
            schema = replace(schema, id=65536 - schema.id)
            writer.define(schema)
            writer.define(replace(channel, id=65536 - channel.id, schema_id=schema.id))
        writer.define(
            Channel(id=9, topic="/nothing", message_encoding="json", schema_id=0, metadata={})
        )
        for m in reader.messages():
            writer.write(65536 - m.channel_id, m.log_time, m.data, **largest)
        writer.write(9, 2**64 - 1, b"{}", **largest)
        writer.commit()
    summary = process(source, out, options=ProcessOptions(keep=("*",)))
    assert len(summary.people) == 1
    with McapReader(out) as reader:
        topics = {channel.topic: i for i, channel in reader.channels.items()}
        (m,) = reader.messages({topics["/nothing"]})
        assert (m.log_time, m.publish_time, m.sequence) == (2**64 - 1, 2**64 - 1, 2**32 - 1)
        assert reader.counts[topics["/hiros/filtered"]] > 40


def test_a_message_logged_at_time_0_needs_no_more_memory(walking, tmp_path):
    source = tmp_path / "zero.mcap"
    with McapReader(walking) as reader, McapWriter(source) as writer:
        writer.copy_definitions(reader, reader.channels)
        for m in reader.messages():
            topic = reader.channels[m.channel_id].topic
            is_first = topic == "/camera_0/skeletons" and not writer.counts[m.channel_id]
            writer.write(m.channel_id, 0 if is_first else m.log_time, m.data)
        writer.commit()
    tracemalloc.start()
    overview_of(source)
    assert tracemalloc.get_traced_memory()[1] < 2**27
    tracemalloc.stop()


@pytest.mark.parametrize("system", ["fuse", "hiros", "fuse-realtime", "hiros-realtime"])
@pytest.mark.parametrize("topics", [("/camera_0/*",), ("/camera_0/*", "/camera_1/*")])
def test_rounded_stamps_show_nobody_twice_at_one_time(walking, tmp_path, system, topics):
    """A camera at 200 Hz, or one that stamps in steps of 0.1 s: two messages have one stamp."""

    def rounded(frame, n):
        return frame.replace(
            stamp=frame.stamp // 10**8 * 10**8, stamps=frame.stamps // 10**8 * 10**8
        )

    source = changed(walking, tmp_path / "rounded.mcap", rounded)
    options = ProcessOptions(system, topics=topics)
    summary = process(source, tmp_path / "out.mcap", options=options)
    with open_log(tmp_path / "out.mcap", topics=["/hiros/filtered"], output_prefix="/none") as log:
        stamps = [frame.stamp for frame in log.frames()]
    assert len(set(stamps)) == len(stamps) > 5
    assert "stamped as those merged before" in summary.warnings[0]
    assert command(["export", str(tmp_path / "out.mcap"), "-o", str(tmp_path / "out.trc")]) == 0
