import itertools

import numpy as np
import pytest
from generators import generic_writer, message_of, same
from mcap_logs import tf_bytes, write_log

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import ChannelInfo, add_skeleton_channel, select_skeletons
from hiros_mcap.io.codec import Decoder, Encoder, ModelBuilder
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.log import DAMAGED, STALE, open_log
from hiros_mcap.skeletons import Frame, SkeletonModel

MODEL = SkeletonModel.of(("a", "b", "c"), (("ab", 0, 1), ("bc", 1, 2)))
NONE = (0.0, 0.0, 0.0, 1.0)
ENCODER = Encoder(MODEL)


def seen(camera=0, stamp=1000, n=1, frame_id=None, value=None):
    """A detection: marker a at (value, 0, 0), or at the stamp; others stand a metre apart."""
    name = f"camera_{camera}"
    frame = Frame.empty(n, MODEL, stamp=stamp, source=name, frame_id=frame_id or name)
    frame.markers[:, :, :3] = (stamp if value is None else value) / 1000
    frame.markers[:, :, :3] += np.arange(n)[:, None, None]
    frame.links[:, :, :3] = 0
    return frame


class Maker:
    """Writes a log message by message."""

    def __init__(self, path, **options):
        self.path, self.ids = path, {}
        self.writer = McapWriter(path, **options)
        self.time = itertools.count(10, 10)

    def __enter__(self):
        self.writer.__enter__()
        return self

    def __exit__(self, kind, *rest):
        if kind is None:
            self.writer.commit()
        self.writer.__exit__(kind, *rest)

    def add(self, frame, topic=None, data=None):
        """Write a frame, or bytes instead of it, on the topic of its camera."""
        topic = topic or f"/{frame.source}/skeletons"
        if topic not in self.ids:
            self.ids[topic] = add_skeleton_channel(self.writer, topic)
        self.writer.write(self.ids[topic], next(self.time), data or ENCODER.encode(frame))

    def transforms(self, *rows, topic="/tf_static"):
        """Write a tf message; rows are (stamp, parent, child, translation, xyzw)."""
        if topic not in self.ids:
            text = hiros_schemas.text(hiros_schemas.TF_MESSAGE).encode()
            schema = self.writer.add_schema(hiros_schemas.TF_MESSAGE, text)
            self.ids[topic] = self.writer.add_channel(topic, schema)
        self.writer.write(self.ids[topic], next(self.time), tf_bytes(*rows))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.mcap"


@pytest.fixture
def two_cameras(path):
    with Maker(path) as log:
        log.transforms((0, "world", "camera_0", (1, 0, 0), NONE))
        for stamp in range(1000, 1500, 100):
            log.add(seen(0, stamp))
            log.add(seen(1, stamp + 30))
        log.transforms((0, "world", "camera_1", (0, 2, 0), NONE))
    return path


def test_the_span_is_that_of_the_skeletons_and_not_of_a_latched_transform(path):
    first = 5_000_000_000
    with Maker(path, chunk_size=1) as log:
        log.time = itertools.chain([0], itertools.count(first, 10))
        log.transforms((0, "world", "camera_0", (1, 0, 0), NONE))
        for stamp in range(1000, 1500, 100):
            log.add(seen(0, stamp))
        log.add(seen(0, 1500), topic="/hiros/filtered")
    with open_log(path) as log:
        assert log.span == (first, first + 40)
    with open_log(path, topics=["/hiros/*"], output_prefix="/none") as log:
        assert log.span == (first, first + 40)


def test_the_span_of_a_file_of_results_alone_is_theirs(path):
    with Maker(path) as log:
        log.add(seen(0, 1000), topic="/hiros/filtered")
        log.add(seen(0, 1500), topic="/hiros/filtered")
    with open_log(path, topics=["/hiros/*"], output_prefix="/none") as log:
        assert log.span == (10, 20)


def frames_of(path, **options):
    with open_log(path, **options) as log:
        read = log.read(fixed=False)
        return list(read.frames()), read


def test_a_log_gives_every_detection_in_the_order_of_log_times(two_cameras):
    frames, read = frames_of(two_cameras)
    assert [f.stamp for f in frames] == [s + d for s in range(1000, 1500, 100) for d in (0, 30)]
    assert [f.source for f in frames] == ["camera_0", "camera_1"] * 5
    assert all(f.frame_id == f.source for f in frames)
    assert read.log.model == MODEL
    assert read.log.fixed_frame == "world"


def test_transforms_that_come_late_hold_for_the_whole_log(two_cameras):
    with open_log(two_cameras) as log:
        first, second, *_ = transform_to_fixed(log.frames(), log.transforms, log.fixed_frame)
    np.testing.assert_allclose(first.positions[0, 0], [2, 1, 1])
    np.testing.assert_allclose(second.positions[0, 0], [1.03, 3.03, 1.03])


def test_detections_are_the_frames_in_the_fixed_frame(two_cameras):
    with open_log(two_cameras) as log:
        moved = list(transform_to_fixed(log.frames(), log.transforms, log.fixed_frame))
        detections = list(log.detections())
    assert len(moved) == len(detections) == 10
    for a, b in zip(moved, detections, strict=True):
        assert same(a, b)


def test_detections_of_a_camera_that_moves_follow_it(path):
    with Maker(path) as log:
        log.transforms((0, "world", "camera_0", (0, 0, 0), NONE), topic="/tf")
        log.add(seen(0, 1000))
        log.transforms((1000, "world", "camera_0", (1, 0, 0), NONE), topic="/tf")
        log.add(seen(0, 500))
    with open_log(path) as log:
        first, second = log.detections()
    np.testing.assert_allclose(first.positions[0, 0], [2, 1, 1])
    np.testing.assert_allclose(second.positions[0, 0], [1, 0.5, 0.5])


def test_every_message_is_accounted_for(path):
    with Maker(path) as log:
        for stamp in (1000, 1000, 2000):
            log.add(seen(0, stamp))
        log.add(seen(0), data=b"\0\1\0\0junk")
    frames, read = frames_of(path)
    account = read.accounts["/camera_0/skeletons"]
    assert (len(frames), account.read, account.used) == (2, 4, 2)
    assert account.skipped == {STALE: 1, DAMAGED: 1}
    assert "message ends" in account.first_error


@pytest.mark.parametrize("confidence", [0.5, -1.0, 1.5])
def test_a_repeat_is_noticed_however_it_was_decoded_and_moved(path, confidence):
    """A confidence out of range has a message decoded on its own."""
    both = seen(0, 2000, n=2)
    both.markers[0] = seen(0, 1000).markers[0]
    both.stamps[0] = 1000
    both.marker_confidences[1] = confidence
    with Maker(path) as log:
        log.transforms((0, "world", "camera_0", (1.0, 2.0, 3.0), (0.6, 0.0, 0.0, 0.8)))
        log.add(seen(0, 1000))
        log.add(both)
    with open_log(path) as log:
        read = log.read()
        frames = list(read.frames())
        assert [(f.n_people, f.frame_id) for f in frames] == [(1, "world"), (1, "world")]
        assert frames[1].stamps.tolist() == [2000]
        assert read.accounts["/camera_0/skeletons"].stale == 1


def test_what_differs_in_time_place_or_camera_is_no_repeat(path):
    with Maker(path) as log:
        log.add(seen(0, 1000, value=5))
        log.add(seen(0, 2000, value=5))
        log.add(seen(0, 2000, value=6))
        log.add(seen(1, 2000, value=6, frame_id="camera_0"))
    assert len(frames_of(path)[0]) == 4


def test_a_camera_that_sees_nobody_still_gives_a_frame(path):
    with Maker(path) as log:
        for stamp in (1000, 2000):
            log.add(seen(0, stamp, n=0))
        log.add(seen(0, 3000))
    frames, _ = frames_of(path)
    assert [(f.n_people, f.stamp, f.source) for f in frames] == [
        (0, 1000, "camera_0"),
        (0, 2000, "camera_0"),
        (1, 3000, "camera_0"),
    ]


def test_a_log_does_not_change_while_it_is_read(two_cameras):
    with open_log(two_cameras) as log:
        facts, whole = vars(log).copy(), list(log.frames())
        left = log.only(["/camera_0/skeletons"])
        moved = log.with_poses({"camera_0": {0: Rigid.identity()}}, log.fixed_frame)
        assert [f.source for f in left.frames()] == ["camera_0"] * 5
        assert not same(next(moved.detections()), next(log.detections()))
        first, second = log.read(fixed=False), log.read(fixed=False)
        for (_, a), (_, b) in zip(first, second, strict=True):  # at the same time
            assert len(a) == len(b)
        assert first.accounts == second.accounts
        assert list(map(str, log.frames())) == list(map(str, whole))
        assert {name: vars(log)[name] for name in facts} == facts


def test_the_stamp_is_source_time_or_header_time_or_log_time(path):
    for_header, for_log = seen(0, 1000, value=2), seen(0, 0, value=3)
    for_header.stamps[:] = 0
    with Maker(path) as log:
        log.add(seen(0, 1000).replace(stamps=np.array([700]), stamp=1000))
        log.add(for_header)
        log.add(for_log)
    assert [f.stamp for f in frames_of(path)[0]] == [700, 1000, 30]


def test_the_stamp_is_the_latest_time_of_the_people(path):
    with Maker(path) as log:
        log.add(seen(0, 2000, n=3).replace(stamps=np.array([700, 900, 0])))
    (frame,), _ = frames_of(path)
    assert (frame.stamp, frame.stamps.tolist()) == (900, [700, 900, 0])


def test_cameras_of_one_name_go_by_their_topics(path):
    with Maker(path) as log:
        for topic in ("/left", "/right"):
            log.add(seen(0).replace(source="sensor", frame_id="world"), topic)
    frames, read = frames_of(path)
    assert [f.source for f in frames] == ["/left", "/right"]
    assert read.log.fixed_frame == "world"


def test_several_cameras_may_share_a_channel(path):
    people = [seen(k, 1000 + k).replace(frame_id="world") for k in (0, 1)]
    messages = [ENCODER.encode(frame) for frame in people]
    with Maker(path) as log:
        for frame, data in zip(people, messages, strict=True):
            log.add(frame, "/all", data)
    assert [f.source for f in frames_of(path)[0]] == ["camera_0", "camera_1"]


def test_the_model_is_complete_even_when_markers_come_late(path):
    partial = seen(0)
    partial.markers[:, 2] = partial.links[:, 1] = np.nan
    with Maker(path) as log:
        for stamp in range(5):
            log.add(partial.replace(stamp=stamp))
        log.add(seen(0, 3000))
    frames, read = frames_of(path)
    assert read.log.model == MODEL
    assert np.isnan(frames[0].positions[0, 2]).all()
    assert not np.isnan(frames[-1].positions).any()


def test_a_camera_of_another_skeleton_may_see_nobody_at_first(path):
    other = SkeletonModel.of(("c", "b", "a"), (("cb", 0, 1), ("ba", 1, 2)))
    with Maker(path) as log:
        for k in range(3):
            log.add(seen(0, 1000 + k))
            log.add(seen(1), data=Encoder(other).encode(seen(1, 1000 + k, n=k)))
    frames, read = frames_of(path)
    assert [frame.n_people for frame in frames if frame.source == "camera_1"] == [0, 1, 2]
    assert read.accounts["/camera_1/skeletons"].used == 3


def test_a_camera_whose_joints_have_no_common_names_is_refused(path):
    other = SkeletonModel.of(("x", "y", "z"), (("ab", 0, 1), ("bc", 1, 2)))
    with Maker(path) as log:
        log.add(seen(0))
        log.add(seen(1), data=Encoder(other).encode(seen(1)))
    with pytest.raises(
        LogError, match=r"its markers \(a, b, c, ...\) have fewer than 3 names in common"
    ):
        open_log(path)


@pytest.mark.parametrize("odd", range(3))
def test_of_three_cameras_the_one_with_odd_names_is_refused(path, odd):
    other = SkeletonModel.of(("x", "y", "z"), (("ab", 0, 1), ("bc", 1, 2)))
    with Maker(path) as log:
        for camera in range(3):
            data = Encoder(other if camera == odd else MODEL).encode(seen(camera))
            log.add(seen(camera), data=data)
    with pytest.raises(LogError, match=rf"/camera_{odd}/skeletons: its markers \(x, y, z"):
        open_log(path)


# -- the same, however it was read -------------------------------------------------------------


def odd_message(rng, stamp):
    """A message of camera 0, 1 or both: plain, out of range, repeated, damaged or of nobody."""
    kind = rng.integers(8)
    frame = seen(rng.integers(2), stamp * (kind != 4), n=int(rng.integers(3)), value=7)
    frame.stamps[:] = rng.choice([0, -5, 40, 41], len(frame.stamps))
    frame.marker_confidences[:] = rng.choice([0.5, -1.0, 1.5, np.nan])
    if kind == 1:
        frame.markers[:, 1, 0] = np.inf
    data = ENCODER.encode(frame)
    if kind == 2:
        data = data[: len(data) // 2]
    if kind == 3 and frame.n_people == 2:
        message = message_of(frame, MODEL)
        message["skeletons"][1]["src_frame"] = "other"
        data = bytes(generic_writer()(message))
    return f"/camera_{rng.integers(2)}/skeletons", data


def odd_log(path, chunk_size):
    """A log of such messages, two of each time."""
    rng = np.random.default_rng(2)
    with Maker(path, chunk_size=chunk_size) as log:
        log.transforms((0, "world", "camera_0", (1, 0, 0), (0.6, 0.0, 0.0, 0.8)))
        log.transforms((0, "world", "camera_1", (0, 1, 0), NONE), topic="/tf")
        log.time = iter(np.arange(200) // 2)
        for k in range(2):
            log.add(seen(k, 1, value=9))
        last = {}
        for stamp in range(10, 110):
            topic, data = odd_message(rng, stamp)
            last[topic] = last.get(topic, data) if rng.random() < 0.2 else data
            log.add(None, topic, last[topic])
    return path


def everything(path, **options):
    """Frames and accounts of a log, as the cameras see them and in the fixed frame."""
    with open_log(path, **options) as log:
        readings = log.read(fixed=False), log.read()
        return [(list(one.frames()), one.accounts) for one in readings]


@pytest.mark.parametrize("together", [0, 4000, 1 << 22])
@pytest.mark.parametrize("most", [0, 5000, 1 << 26])
def test_frames_and_accounts_do_not_depend_on_how_messages_are_batched(
    tmp_path, monkeypatch, together, most
):
    wanted = everything(odd_log(tmp_path / "whole.mcap", 1 << 22))
    monkeypatch.setattr(McapReader.batches, "__defaults__", (None, together, None))
    monkeypatch.setattr(Decoder, "_MOST", most)
    found = everything(odd_log(tmp_path / "cut.mcap", 1000))
    for (frames, accounts), (expected, books) in zip(found, wanted, strict=True):
        assert accounts == books
        pairs = zip(frames, expected, strict=True)
        assert all(same(a, b) and a.log_time == b.log_time for a, b in pairs)
    account = wanted[0][1]["/camera_0/skeletons"]
    assert account.stale
    assert account.untimed
    assert len(account.cleaned) == 3
    assert set(account.skipped) == {STALE, DAMAGED}
    assert account.read == account.used + sum(account.skipped.values())


def test_chunks_that_overlap_are_put_in_order(path):
    """Each camera's messages are in chunks of their own."""
    times = {0: range(10, 100, 10), 1: range(15, 105, 10)}
    with Maker(path, chunk_size=3000) as log:
        for camera, stamps in times.items():
            log.time = iter(stamps)
            for stamp in stamps:
                log.add(seen(camera, stamp))
    with McapReader(path) as file:
        assert len(file.contents.chunks) > 3
    frames, _ = frames_of(path)
    assert [f.log_time for f in frames] == sorted([*times[0], *times[1]])
    assert [f.source for f in frames] == ["camera_0", "camera_1"] * 9


def test_a_repeat_is_one_of_the_previous_message_only(path):
    with Maker(path) as log:
        for stamp in (1000, 2000, 1000):
            log.add(seen(0, stamp))
    frames, read = frames_of(path)
    assert [f.stamp for f in frames] == [1000, 2000, 1000]
    assert read.accounts["/camera_0/skeletons"].stale == 0


def test_people_without_a_time_are_never_repeats(path):
    nobody_knows_when = seen(0, 1000).replace(stamps=np.zeros(1, np.int64))
    with Maker(path) as log:
        for _ in range(3):
            log.add(nobody_knows_when)
    assert len(frames_of(path)[0]) == 3


def test_of_a_repeated_message_only_people_with_a_time_are_repeats(path):
    both = seen(0, 1000, n=2).replace(stamps=np.array([1000, 0]), ids=np.array([5, 6], np.int32))
    with Maker(path) as log:
        log.add(both)
        log.add(both)
    frames, read = frames_of(path)
    assert [f.ids.tolist() for f in frames] == [[5, 6], [6]]
    assert read.accounts["/camera_0/skeletons"].stale == 1


def test_a_message_of_several_cameras_is_used_if_one_of_them_has_something_new(path):
    def shared(stamps):
        message = message_of(seen(0, 1000, n=2).replace(stamps=np.array(stamps)), MODEL)
        message["skeletons"][1]["src_frame"] = "other"
        return bytes(generic_writer()(message))

    with Maker(path) as log:
        for stamps in ((1000, 1000), (1000, 2000), (1000, 2000)):
            log.add(None, "/all", shared(stamps))
    frames, read = frames_of(path)
    account = read.accounts["/all"]
    assert [f.source for f in frames] == ["camera_0", "other", "other"]
    assert (account.read, account.used, account.stale) == (3, 2, 1)
    assert account.skipped == {STALE: 1}


@pytest.mark.parametrize("late", [2**63, 2**64 - 1])
def test_a_message_beyond_the_times_that_frames_hold_is_skipped_and_counted(path, late):
    with Maker(path) as log:
        log.time = iter((10, late))
        log.add(seen(0, 1000))
        log.add(seen(0, 10**18))  # a stamp that fits the others would count
    with open_log(path) as log:
        read = log.read(fixed=False)
        assert [frame.log_time for frame in read.frames()] == [10]
        (account,) = read.accounts.values()
        assert account.skipped == {"log time after the year 2262": 1}
        assert log.span == (10, 10)


@pytest.mark.parametrize("claimed", [3, 9])
def test_the_model_grows_with_every_new_marker_until_it_is_complete(path, claimed):
    """Detectors that claim more markers than they show have the whole log looked through."""
    wide = SkeletonModel(*(getattr(MODEL, f) for f in SkeletonModel.__match_args__[:6]), claimed, 2)
    parts = [seen(0, 1000 + k) for k in range(30)]
    for k, frame in enumerate(parts):
        frame.markers[:, k // 10 + 1 :] = np.nan
        frame.links[:] = np.nan
    whole = seen(0, 3000)
    with Maker(path, chunk_size=2000) as log:
        for frame in [*parts, whole]:
            log.add(None, "/camera_0/skeletons", Encoder(wide).encode(frame))
    frames, read = frames_of(path)
    assert read.log.model == wide
    assert len(frames) == 31


def test_only_messages_that_teach_something_are_learnt_from(path, monkeypatch):
    learnt = []
    add = ModelBuilder.add
    monkeypatch.setattr(ModelBuilder, "add", lambda *args: learnt.append(1) or add(*args))
    wide = SkeletonModel.of((*"abcd",), (("ab", 0, 1), ("bc", 1, 2)))
    frame = Frame.empty(1, wide, stamp=1, source="camera_0", frame_id="camera_0")
    frame.markers[:, :3, :3] = 0.0
    with Maker(path, chunk_size=2000) as log:
        for _ in range(30):
            log.add(None, "/camera_0/skeletons", Encoder(wide).encode(frame))
    assert frames_of(path)[1].log.model.n_markers == 3
    assert len(learnt) == 1


# -- choice of channels ------------------------------------------------------------------------


@pytest.fixture
def results(path):
    with Maker(path) as log:
        for topic in ("/camera_0/skeletons", "/hiros/merged", "/truth/skeletons", "/hirosaki"):
            log.add(seen(0).replace(source="", frame_id="world"), topic)
    return path


def test_results_and_truth_are_not_read_unless_asked_for(results):
    def topics(**options):
        with open_log(results, **options) as log:
            return [camera.channel.topic for camera in log.cameras]

    assert topics() == ["/camera_0/skeletons", "/hirosaki"]
    assert topics(topics=["/truth/*", "/cam*"]) == ["/camera_0/skeletons", "/truth/skeletons"]
    assert "/hiros/merged" in topics(output_prefix="/other")


def test_a_glob_that_fits_no_channel_is_an_error_that_lists_the_channels(results):
    with pytest.raises(LogError, match=r"matches '/nobody'; its channels: /camera_0/skeletons \("):
        open_log(results, topics=["/cam*", "/nobody"])


def test_a_log_of_results_only_is_an_error(path):
    with Maker(path) as log:
        log.add(seen(0), "/truth/skeletons")
    with pytest.raises(LogError, match="only results below /hiros or truths below /truth"):
        open_log(path)


def test_a_log_without_skeletons_is_an_error_that_lists_the_channels(path):
    with pytest.raises(LogError, match=r"no SkeletonGroup channel.*/a \(pkg/msg/Type, 20\)"):
        open_log(write_log(path))


@pytest.mark.parametrize(
    ("counts", "taken"), [((3, 0, 1), "ac"), ((0, 0, 0), "abc"), ((1, 1, 1), "abc")]
)
def test_a_channel_without_messages_is_no_camera_unless_none_has_any(counts, taken):
    kind = hiros_schemas.SKELETON_GROUP
    infos = [ChannelInfo(k, f"/{'abc'[k]}", kind, "cdr", n, {}) for k, n in enumerate(counts)]
    assert [info.topic[1:] for info in select_skeletons(infos)] == [*taken]


def test_a_log_of_an_empty_room_has_frames_of_nobody(path):
    with Maker(path) as log:
        log.add(seen(0, n=0))
    with open_log(path) as log:
        assert log.remarks[0] == "the room is empty: no camera sees anybody"
        assert [frame.n_people for frame in log.frames()] == [0]


def test_a_channel_of_another_encoding_is_left_out_with_a_warning(path):
    with Maker(path) as log:
        log.add(seen(0))
        text = hiros_schemas.text(hiros_schemas.SKELETON_GROUP).encode()
        schema = log.writer.add_schema(hiros_schemas.SKELETON_GROUP, text)
        log.writer.write(log.writer.add_channel("/s", schema, encoding="json"), 0, b"{}")
    with open_log(path) as log:
        assert len(list(log.frames())) == 1
        assert log.warnings[0].startswith("/s: 1 message not used, encoded as 'json'")
    with open_log(path, topics=["/camera_0/*"]) as log:
        assert len(list(log.frames())) == 1
        assert not any("encoded" in text for text in log.warnings)
    with pytest.raises(LogError, match="/s: is encoded as 'json'.* other channels with --topic"):
        open_log(path, topics=["/s"])


# -- transforms of a log -----------------------------------------------------------------------


def test_a_camera_without_transform_is_an_error_when_the_frame_is_asked_for(path):
    with Maker(path) as log:
        log.transforms((0, "world", "camera_0", (1, 0, 0), NONE))
        log.add(seen(0))
        log.add(seen(1))
    with open_log(path) as log, pytest.raises(LogError, match=r"log\.mcap: .*camera_1 in camera_1"):
        _ = log.fixed_frame
    with (
        open_log(path, fixed_frame="world") as log,
        pytest.raises(LogError, match="from the frame 'camera_1' to 'world'"),
    ):
        _ = log.fixed_frame


def test_a_named_fixed_frame_is_used(two_cameras):
    with open_log(two_cameras, fixed_frame="camera_1") as log:
        first, *_ = transform_to_fixed(log.frames(), log.transforms, log.fixed_frame)
    np.testing.assert_allclose(first.positions[0, 0], [2, -1, 1])


def test_a_damaged_transform_is_fatal(path):
    with Maker(path) as log:
        log.add(seen(0))
        log.transforms()
        log.writer.write(log.ids["/tf_static"], 99, b"\0\1\0\0\5\0\0\0")
    with pytest.raises(LogError, match=r"log\.mcap: /tf_static: a tf message is damaged"):
        open_log(path)


# -- files -------------------------------------------------------------------------------------


def test_a_rosbag2_folder_with_one_log_is_that_log(two_cameras, tmp_path):
    assert len(frames_of(tmp_path)[0]) == 10
    (tmp_path / "second.mcap").write_bytes(two_cameras.read_bytes())
    with pytest.raises(LogError, match="folder with 2 MCAP files; name one, or join them"):
        open_log(tmp_path)


def test_a_damaged_container_is_fatal_even_in_the_middle(two_cameras):
    with McapReader(two_cameras) as reader:
        chunk = reader.contents.chunks[-1]
    whole = bytearray(two_cameras.read_bytes())
    whole[chunk.data_offset + 9] ^= 4
    two_cameras.write_bytes(whole)
    with pytest.raises(LogError, match="checksum"):
        frames_of(two_cameras)


def test_messages_of_the_generic_library_are_read(path):
    header = {"stamp": {"sec": 3, "nanosec": 7}, "frame_id": "/camera_0"}
    data = bytes(generic_writer()({"header": header, "skeletons": []}))
    with Maker(path) as log:
        log.add(seen(0))
        log.add(None, "/camera_0/skeletons", data)
    _, frame = frames_of(path)[0]
    assert (frame.stamp, frame.frame_id, frame.source) == (3_000_000_007, "camera_0", "camera_0")
