"""``hiros info`` of files of every kind, and ``hiros process`` of those without detections."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from mcap_logs import KINDS

from hiros_cli.app import run
from hiros_mcap.config import load_config
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.regression.suite import write_golden
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import ProcessOptions, process

FEATURES = (
    "use_chunking", "use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas",
    "attachment", "metadata", "schema",
)  # fmt: skip


def foreign(path, messages=10, **features):
    """Write a log of no skeletons by the mcap library, with and without features of the format."""
    own = {name: features.pop(name, True) for name in ("attachment", "metadata", "schema")}
    indexes = IndexType.ALL if features.get("use_summary_offsets", True) else IndexType.NONE
    with path.open("wb") as file:
        writer = Writer(file, index_types=indexes, **features)
        writer.start("", "somebody")
        if messages:
            schema = writer.register_schema("Example", "c", b"\4\5\6") if own["schema"] else 0
            channel = writer.register_channel("example", "a", schema, {"foo": "bar"})
        for k in range(messages):
            writer.add_message(channel, 10**9 * k, b"\1\2\3", 1, k)
        if own["attachment"]:
            writer.add_attachment(2, 1, "myFile", "application/octet-stream", b"\1\2")
        if own["metadata"]:
            writer.add_metadata("myMetadata", {"foo": "bar"})
        writer.finish()
    return path


@pytest.mark.parametrize("messages", [0, 1, 10])
def test_any_mcap_is_shown_and_none_without_skeletons_processed(messages, tmp_path, capsys):
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    combinations = list(itertools.product((False, True), repeat=len(FEATURES)))
    for chosen in combinations[messages::29]:  # all of them take a minute
        foreign(log, messages, **dict(zip(FEATURES, chosen, strict=True)))
        assert run(["info", str(log)]) == 0, chosen
        assert run(["process", str(log), "-o", str(out)]) == 2, chosen
        (line,) = capsys.readouterr().err.splitlines()
        assert "has no SkeletonGroup channel" in line
    assert not out.exists()


def test_a_camera_that_stops_or_begins_late_has_a_gap(whole_crossing, tmp_path):
    log, begin = tmp_path / "log.mcap", None
    with whole_crossing.open("rb") as file, log.open("wb") as target:
        writer, ids = Writer(target), dict[str, int]()
        writer.start()
        for schema, channel, message in make_reader(file).iter_messages():
            begin = begin or message.log_time
            seconds = (message.log_time - begin) * 1e-9
            if channel.topic == "/camera_1/skeletons" and not 1.5 < seconds < 3.0:
                continue
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                ids[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    gaps = {camera.name: camera.longest_gap_s for camera in overview_of(log).cameras}
    assert gaps["camera_1"] == pytest.approx(2.0, abs=0.1)
    assert max(gaps["camera_0"], gaps["camera_2"]) < 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_channels_have_rates_and_times(kind, tmp_path):
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, **KINDS[kind])
        writer.start()
        pose = writer.register_schema("foxglove.Pose", "protobuf", b"...")
        for topic, encoding, schema in (("/p", "protobuf", pose), ("/j", "json", 0)):
            channel = writer.register_channel(topic, encoding, schema)
            for k in range(5 if topic == "/p" else 1):
                writer.add_message(channel, 3 * 10**9 + k * 500_000_000, b"{}", 0)
        writer.finish()
    j, p = overview_of(tmp_path / "log.mcap").channels
    assert (p.topic, p.type, p.encoding, p.messages) == ("/p", "foxglove.Pose", "protobuf", 5)
    assert (p.rate_hz, p.seconds) == (2.0, 2.0)
    assert (j.type, j.encoding, j.messages, j.seconds) == ("", "json", 1, 0.0)


@pytest.fixture(scope="module")
def result(crossing, tmp_path_factory):
    """The result of the crossing with one changed parameter."""
    path = tmp_path_factory.mktemp("info") / "out.mcap"
    config = load_config(
        overrides=["merge.max_position_delta=0.4"], preset="realtime", system="hiros"
    )
    process(crossing, path, config=config, options=ProcessOptions("hiros"))
    return path


def assert_two_people(overview, topic):
    assert [(p.topic, p.id) for p in overview.people] == [(topic, 0), (topic, 1)]
    assert all(1.8 < p.seconds < 2.1 and 57 <= p.frames <= 61 for p in overview.people)


def test_a_result_tells_how_it_was_made(result, capsys):
    overview = overview_of(result)
    assert overview.kind == "result"
    assert_two_people(overview, "/hiros/filtered")
    assert overview.run is not None
    assert (overview.run.system, overview.run.preset) == ("hiros", "realtime")
    assert overview.run.stages == ("tracked", "merged", "optimized", "filtered")
    assert [(c.name, c.value, c.default) for c in overview.run.changed] == [
        ("merge.max_position_delta", "0.4", "0.2")
    ]
    filtered = next(c for c in overview.channels if c.topic == "/hiros/filtered")
    assert 29 < filtered.rate_hz < 31  # of the data; results are logged many at once
    assert run(["info", str(result)]) == 0
    assert "changed: merge.max_position_delta = 0.4 (preset: 0.2)" in capsys.readouterr().out


def test_results_alone_golden_files_and_truths_say_what_they_are(result, crossing, tmp_path):
    alone, golden, true = (tmp_path / f"{name}.mcap" for name in ("alone", "golden", "true"))
    process(crossing, alone, options=ProcessOptions(keep=()))
    write_golden(result, golden)
    with McapReader(crossing) as reader, McapWriter(true) as writer:
        (ident,) = (c.id for c in reader.channels.values() if c.topic == "/truth/skeletons")
        writer.copy_definitions(reader, [ident])
        for message in reader.messages({ident}):
            writer.write(ident, message.log_time, bytes(message.data))
        writer.commit()
    found = [overview_of(path) for path in (alone, golden, true)]
    assert [overview.kind for overview in found] == ["result", "golden", "truth"]
    for overview, topic in zip(
        found, ("/hiros/filtered", "/hiros/filtered", "/truth/skeletons"), strict=True
    ):
        assert_two_people(overview, topic)


def test_warnings_of_the_run_are_kept_in_the_result(tmp_path, crossing):
    extrinsics = tmp_path / "cameras.toml"
    pose = "translation = [0.0, 0.0, 2.5]\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n"
    extrinsics.write_text("".join(f'[[camera]]\nframe = "camera_{k}"\n{pose}' for k in range(3)))
    process(
        crossing,
        tmp_path / "o.mcap",
        options=ProcessOptions(extrinsics=extrinsics, calibrate="off"),
    )
    run_row = overview_of(tmp_path / "o.mcap").run
    assert run_row is not None
    assert any("stand at the same place" in text for text in run_row.warnings)


def test_missing_checksums_are_told(tmp_path, capsys):
    for name, checked in (("with", True), ("without", False)):
        with (tmp_path / name).open("wb") as file:
            writer = Writer(file, enable_crcs=checked, enable_data_crcs=checked)
            writer.start()
            writer.add_message(writer.register_channel("/a", "json", 0), 1, b"{}", 1)
            writer.finish()
        assert run(["info", str(tmp_path / name)]) == 0
        assert ("no checksums" in capsys.readouterr().out) is not checked


def test_a_folder_shows_its_true_size(crossing, tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "bag_0.mcap").write_bytes(crossing.read_bytes())
    assert overview_of(folder).megabytes == pytest.approx(crossing.stat().st_size / 1e6)


def results_of(path):
    with McapReader(path) as reader:
        found: dict[str, list[bytes]] = {}
        for message in reader.messages():
            topic = reader.channels[message.channel_id].topic
            found.setdefault(topic, []).append(bytes(message.data))
        return found


def test_processing_a_result_gives_that_of_the_recording(crossing, tmp_path, capsys):
    one, two = tmp_path / "one.mcap", tmp_path / "two.mcap"
    assert run(["process", str(crossing), "-o", str(one), "-q"]) == 0
    assert run(["process", str(one), "-o", str(two), "--topic", "*camera*", "--topic", "/*o*"]) == 0
    assert run(["process", str(one), "-o", str(two)]) == 0
    assert "holds results of hiros already" in capsys.readouterr().out
    assert results_of(two) == results_of(one)
    with open_log(two) as log:
        assert len(log.cameras) == 3


def test_results_are_never_taken_for_cameras(result, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    assert run(["process", str(result), "-o", str(out), "--topic", "/hiros/*"]) == 2
    assert "names only results of hiros" in capsys.readouterr().err
    assert not out.exists()


def test_markers_for_rviz_span_the_time_of_the_skeletons(tmp_path):
    out = tmp_path / "out.mcap"
    source = Path(__file__).parents[2] / "sample_data/one_person_walking.mcap"
    process(source, out, options=ProcessOptions(markers=True))
    rows = {row.topic: row for row in overview_of(out).channels}
    skeletons = rows["/hiros/filtered"]
    for name in ("markers", "labels", "joint_states"):
        assert rows[f"/hiros/{name}"].seconds == skeletons.seconds
