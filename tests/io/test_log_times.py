"""Log times that cannot be right: what the stamps say counts."""

from __future__ import annotations

import numpy as np
import pytest
from generators import generic_writer, message_of
from stick_figures import MODEL, person, seen

import hiros_schemas
from hiros_mcap.evaluate.logs import evaluate_log, find_truth, start_of
from hiros_mcap.io.container import McapReader, McapWriter, Message
from hiros_mcap.io.container.live_input import McapInput
from hiros_mcap.io.container.records import Schema
from hiros_mcap.io.live_log import open_live
from hiros_mcap.io.log import open_log, open_reader
from hiros_mcap.io.log_times import StampPlace, right_log_times, stamp_of, stamp_place
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import process

SECOND = 1_000_000_000
TEN_YEARS = 315_576_000 * SECOND
CAMERA = "/camera_1/skeletons"
SITUATIONS = {
    "first .2 s": lambda topic, after, time, n: 0 if after < 0.2 else time,
    "first 1 s": lambda topic, after, time, n: 0 if after < 1 else time,
    "first message": lambda topic, after, time, n: 0 if (topic, n) == (CAMERA, 0) else time,
    "one in the middle": lambda topic, after, time, n: 0 if (topic, n) == (CAMERA, 15) else time,
    "every fifth": lambda topic, after, time, n: 0 if "camera" in topic and n % 5 == 2 else time,
    "all": lambda topic, after, time, n: 0,
    "one camera": lambda topic, after, time, n: 0 if topic == CAMERA else time,
    "last .5 s": lambda topic, after, time, n: 0 if after > 1.5 else time,
    "ten years ahead": lambda topic, after, time, n: time + TEN_YEARS * (after < 1),
    "one camera ahead": lambda topic, after, time, n: time + TEN_YEARS * (topic == CAMERA),
    "booted in 1970": lambda topic, after, time, n: (
        time - 1_699_999_990 * SECOND if after < 1 else time
    ),
    "five minutes early": lambda topic, after, time, n: time - 300 * SECOND * (after < 0.5),
    "year 2554": lambda topic, after, time, n: 2**64 - 1 if topic == CAMERA else time,
}


def logged(source, target, situation, *, by_time=False, **options):
    """Copy a log with other log times; ``by_time`` in their order, else as the messages came."""
    with McapReader(source) as reader, McapWriter(target, **options) as writer:
        writer.copy_definitions(reader, reader.channels)
        start, rows, counts = start_of(source), [], dict.fromkeys(reader.channels, 0)
        for m in reader.messages():
            topic, after = reader.channels[m.channel_id].topic, (m.log_time - start) / SECOND
            time = situation(topic, after, m.log_time, counts[m.channel_id])
            counts[m.channel_id] += 1
            rows.append((time, m.channel_id, bytes(m.data)))
        for time, channel, data in sorted(rows, key=lambda row: row[0]) if by_time else rows:
            writer.write(channel, time, data)
        writer.commit()
    return target


def error(path):
    truth = find_truth(path)
    assert truth is not None
    return evaluate_log(path, truth, ["/hiros/filtered"])["/hiros/filtered"].scores.mean


@pytest.fixture(scope="module")
def healthy(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("healthy") / "out.mcap"
    process(crossing, out)
    return error(out), overview_of(crossing)


@pytest.mark.parametrize("name", SITUATIONS)
def test_the_stamp_counts_and_info_counts_what_was_logged_elsewhere(
    crossing, healthy, tmp_path, name
):
    source = logged(crossing, tmp_path / "log.mcap", SITUATIONS[name])
    summary = process(source, tmp_path / "out.mcap")
    assert error(tmp_path / "out.mcap") == pytest.approx(healthy[0], abs=0.5)
    assert not summary.warnings
    told = overview_of(source)
    assert told.seconds == pytest.approx(healthy[1].seconds, abs=0.1)
    assert not told.clocks
    (remark,) = [remark for remark in told.remarks if "the stamps fit" in remark]
    assert f"of {CAMERA}" in remark
    assert remark in summary.notes
    assert overview_of(tmp_path / "out.mcap").seconds == pytest.approx(told.seconds, abs=0.2)


@pytest.mark.parametrize("name", ["first 1 s", "every fifth", "ten years ahead"])
def test_the_order_of_the_file_does_not_matter(crossing, healthy, tmp_path, name):
    source = logged(
        crossing, tmp_path / "log.mcap", SITUATIONS[name], by_time=True, chunk_size=20000
    )
    process(source, tmp_path / "out.mcap")
    assert error(tmp_path / "out.mcap") == pytest.approx(healthy[0], abs=0.5)


@pytest.mark.parametrize("name", ["first .2 s", "all", "one camera", "every fifth"])
def test_live_input_has_the_usual_log_times(crossing, tmp_path, name):
    def delays(path):
        with path.open("rb") as file:
            log = open_live(McapInput(file.fileno(), "live"))
            frames = list(log.frames())
        return [(frame.log_time - frame.stamp) / SECOND for frame in frames], log.remarks

    usual, nothing = delays(crossing)
    mended, remarks = delays(logged(crossing, tmp_path / "log.mcap", SITUATIONS[name]))
    assert len(mended) == len(usual)
    assert np.abs(np.array(mended) - np.array(usual)).max() < 0.5
    assert [r for r in remarks if f"of {CAMERA}" in r] and not [r for r in nothing if "stamps" in r]


def test_simulated_time_that_begins_late_is_mended(crossing):
    """Stamps from 52 s on; the first second is logged at 0, less than a minute before."""
    stamps = 52 * SECOND + np.arange(100) * SECOND // 30
    log_times = np.where(stamps < 53 * SECOND, 0, stamps + 5_000_000)
    all_alike = np.zeros(100, np.int64), log_times, stamps, np.ones(100, bool), np.zeros(100, bool)
    assert (right_log_times(*all_alike) == stamps + 5_000_000).all()


def test_a_message_without_a_stamp_goes_beside_its_neighbour():
    """An empty room: the Azure Kinect driver publishes no marker, so no header."""
    stamps = 1_700_000_000 * SECOND + np.arange(60) * SECOND // 30
    log_times = stamps.copy()
    stamps[[0, 20]] = log_times[[0, 20]] = 0
    same = np.zeros(60, np.int64), log_times, stamps, np.ones(60, bool), np.zeros(60, bool)
    right = right_log_times(*same)
    assert right[0] == log_times[1]
    assert right[20] == log_times[19]


@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "abcd"])
def test_where_a_header_has_no_time_that_of_the_first_person_counts(frame_id):
    group = message_of(seen([person()], 7 * SECOND), MODEL)
    group["header"] = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame_id}
    message = Message(1, 0, generic_writer()(group), 0, 0)
    assert stamp_of(message, StampPlace(4, True)) == 7 * SECOND


@pytest.mark.parametrize(
    ("name", "place"),
    [
        (hiros_schemas.SKELETON_GROUP, 4),
        (hiros_schemas.MARKER_ARRAY, 8),
        (hiros_schemas.TF_MESSAGE, 8),
        (hiros_schemas.LOG, 4),
        ("geometry_msgs/msg/Pose", 0),
    ],
)
def test_where_a_stamp_lies(name, place):
    schema = Schema(1, hiros_schemas.text(name).encode(), "ros2msg", name)
    assert stamp_place(schema, "cdr") == place
    assert stamp_place(schema, "json") == 0


def test_a_latched_transform_at_time_0_and_late_deliveries_stay(crossing, tmp_path):
    def situation(topic, after, time, n):
        return 0 if topic == "/tf_static" else time + 20 * SECOND * (topic == CAMERA and n == 9)

    source = logged(crossing, tmp_path / "log.mcap", situation, by_time=True)
    with McapReader(source) as plain, open_reader(source) as mended:
        assert [m.log_time for m in plain.messages()] == [m.log_time for m in mended.messages()]
        assert not mended.remarks


def test_a_stamp_that_does_not_fit_either_is_not_believed(crossing, tmp_path):
    with open_log(crossing) as log:
        stamps = np.array([frame.stamp for frame in log.frames()])
    log_times = stamps + 5_000_000
    log_times[10], stamps[10] = 0, stamps[10] + TEN_YEARS
    kept = np.zeros(len(stamps), np.int64), log_times, stamps
    right = right_log_times(*kept, np.ones(len(stamps), bool), np.zeros(len(stamps), bool))
    assert (right == log_times).all()
