"""A joint at exactly 0 0 0 of its camera was not seen: detectors mark so what they do not see."""

from __future__ import annotations

import json

import detector_logs as made
import numpy as np
import pytest
from detector_files import trc_text
from odd_logs import believed, changed

from hiros_cli.app import run
from hiros_mcap.evaluate import load_truth
from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.joints.importing import import_joints
from hiros_mcap.io.log import open_log
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import process
from hiros_mcap.skeletons import POSITION, People

HAND = "HAND_LEFT"


def hidden(frame, sent, value, names, confidence=np.nan):
    """A third of the time, the left hand and its neighbours are not seen."""
    people = frame.people.copy()
    slots = [names.index(name) for name in ("HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT")]
    if sent % 3 == 0:
        people.markers[:, slots] = np.nan
        people.markers[:, slots, POSITION] = value
        people.marker_confidences[:, slots] = confidence
    return frame.replace(people=people)


def frames_of(path):
    with open_log(path) as log:
        return list(log.detections()), log.model


@pytest.fixture(scope="module")
def names(crossing):
    return frames_of(crossing)[1].marker_names


@pytest.mark.parametrize("confidence", [0.0, 1.0, np.nan])
def test_a_joint_at_0_is_as_if_it_were_left_out(confidence, names, crossing, tmp_path):
    zeros = changed(
        crossing, tmp_path / "zeros.mcap", lambda f, k: hidden(f, k, 0.0, names, confidence)
    )
    absent = changed(crossing, tmp_path / "nan.mcap", lambda f, k: hidden(f, k, np.nan, names))
    (shown, model), (expected, _) = frames_of(zeros), frames_of(absent)
    ends = np.isin(model.links, [names.index(n) for n in (HAND, "HANDTIP_LEFT", "THUMB_LEFT")])
    for k, (frame, other) in enumerate(zip(shown, expected, strict=True)):
        np.testing.assert_array_equal(frame.markers, other.markers)
        links = other.links.copy()
        gone = np.isnan(other.positions[:, names.index(HAND), 0])
        links[np.ix_(gone, ends.any(axis=1))] = np.nan
        np.testing.assert_array_equal(frame.links, links), k
    assert len(process(zeros).people) == 2


def test_a_joint_at_0_is_counted_by_camera(names, crossing, tmp_path):
    log = changed(crossing, tmp_path / "zeros.mcap", lambda f, k: hidden(f, k, 0.0, names, 1.0))
    text = "33 % of HAND_LEFT, 33 % of HANDTIP_LEFT, 33 % of THUMB_LEFT at exactly 0 0 0"
    for notes in (process(log).notes, overview_of(log).remarks):
        found = [note for note in notes if text in note.replace("34 %", "33 %")]
        assert [note.split(":")[0] for note in found] == [
            f"/camera_{k}/skeletons" for k in range(3)
        ]


def test_a_joint_near_0_is_seen(names, crossing, tmp_path):
    log = changed(crossing, tmp_path / "near.mcap", lambda f, k: hidden(f, k, 1e-9, names))
    for frame in (f for f in frames_of(log)[0] if f.n_people):
        assert not np.isnan(frame.positions[:, names.index(HAND)]).any()


def spare(frame, _):
    """Six places for people, as the Kinect v2 has; those not needed are 0 throughout."""
    people = People.absent(6, frame.markers.shape[1], frame.links.shape[1])
    for array, given in zip(people, frame.people, strict=True):
        array[:] = 0
        array[6 - frame.n_people :] = given
    return frame.replace(people=people)


@pytest.mark.parametrize("confidence", [None, 1.0])
def test_a_body_of_zeros_is_nobody(confidence, crossing, tmp_path):
    def change(frame, sent):
        frame = spare(frame, sent)
        return frame if confidence is None else believed(frame, confidence)

    log = changed(crossing, tmp_path / "spare.mcap", change)
    summary = process(log)
    assert len(summary.people) == 2
    assert summary.warnings == ()
    assert any("left out: no joint in them, or all at exactly 0 0 0" in n for n in summary.notes)
    healthy, shown = frames_of(crossing)[0], frames_of(log)[0]
    assert [f.n_people for f in healthy] == [f.n_people for f in shown]


@pytest.mark.parametrize("kind", ["azure", "zed", "azure in a ros1 bag"])
def test_every_detector_marks_joints_so(kind, tmp_path):
    scene = made.scene(tmp_path / "scene.mcap", people=1, cameras=2, seconds=0.5)
    zeroed = [
        (topic, hidden(frame, 0, 0.0, list(scene.names))) for topic, frame in scene.detections
    ]
    scene = made.Scene(scene.path, zeroed, scene.names, scene.others)
    if kind.endswith("bag"):
        log = made.write_ros1_bag(tmp_path / "log.bag", scene)
    else:
        make = made.azure if kind == "azure" else made.zed("zed-70")
        log = made.write_ros2(tmp_path / "log.mcap", scene, make)
    frames, model = frames_of(log)
    thumb = made.joints_of(model.marker_names).index(("thumb", "left"))
    assert sum(frame.n_people for frame in frames) > 20
    for frame in frames:
        assert np.isnan(frame.positions[:, thumb]).all()
        assert not np.isnan(frame.positions[:, 0]).any()


CSV = """time,person,joint,x,y,z,confidence
0,0,PELVIS,1,2,3,1
0,0,NECK,1,2,3.5,1
0,0,HAND_LEFT,0,0,0,1
0,1,PELVIS,0,0,0,0
0,1,NECK,0,0,0,0
0.1,0,PELVIS,1,2,3,1
0.1,0,NECK,1,2,3.5,1
0.1,0,HAND_LEFT,1,2,3.2,1
"""


def trc(rows, names):
    return trc_text(rows, names, np.arange(len(rows)) / 10)


ROWS = np.array([[[1, 2, 3], [1, 2, 3.5], [0, 0, 0]], [[1, 2, 3], [1, 2, 3.5], [1, 2, 3.2]]])
JOINTS = ["PELVIS", "NECK", HAND]


def write_npy(path):
    np.save(path, ROWS)
    return 'names = ["PELVIS", "NECK", "HAND_LEFT"]\n[time]\nrate = 10\n'


def write_json(path):
    frames = [
        {"time": t / 10, "people": [{"id": 0, "joints": dict(zip(JOINTS, row, strict=True))}]}
        for t, row in enumerate(ROWS.tolist())
    ]
    path.write_text(json.dumps({"frames": frames}))
    return ""


WRITERS = {
    ".csv": lambda path: path.write_text(CSV) and "",
    ".trc": lambda path: path.write_text(trc(ROWS, JOINTS)) and "",
    ".npy": write_npy,
    ".json": write_json,
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_an_imported_joint_at_0_was_not_seen(suffix, tmp_path):
    source, mapping = tmp_path / f"room{suffix}", tmp_path / "room.toml"
    mapping.write_text('axes = ["x", "-z", "y"]\n' + WRITERS[suffix](source))
    notes: list[str] = []
    import_joints([source], tmp_path / "log.mcap", mapping, note=notes.append)
    frames, model = frames_of(tmp_path / "log.mcap")
    hand = model.marker_names.index(HAND)
    assert [frame.n_people for frame in frames] == [1, 1]
    assert np.isnan(frames[0].positions[0, hand]).all()
    assert frames[1].positions[0, hand].tolist() == [1, -3.2, 2]
    assert notes == [f"{source}: 50 % of HAND_LEFT at exactly 0 0 0, taken as not seen"]


def test_import_prints_what_it_took_for_unseen(tmp_path, capsys):
    (tmp_path / "room.csv").write_text(CSV)
    assert run(["import", str(tmp_path / "room.csv"), "-o", str(tmp_path / "log.mcap")]) == 0
    assert "note: " in (out := capsys.readouterr().out)
    assert "50 % of HAND_LEFT at exactly 0 0 0" in " ".join(out.split())


def write_truth_csv(path):
    cells = (
        f"{t / 10},{name},{x},{y},{z}"
        for t, row in enumerate(ROWS.tolist())
        for name, (x, y, z) in zip(JOINTS, row, strict=True)
    )
    path.write_text("\n".join(["time,marker,x,y,z", *cells, ""]))


@pytest.mark.parametrize("suffix", [".trc", ".csv"])
def test_a_true_joint_at_0_is_not_known(suffix, tmp_path):
    path = tmp_path / f"truth{suffix}"
    path.write_text(trc(ROWS, JOINTS)) if suffix == ".trc" else write_truth_csv(path)
    truth = load_truth(path)
    assert np.isnan(truth.positions[0, 0, 2]).all()
    assert np.isnan(truth.positions).sum() == 3
    assert truth.notes == (f"{path}: 50 % of HAND_LEFT at exactly 0 0 0, taken as not seen",)


def test_the_pelvis_of_a_truth_that_counts_from_it_is_known(tmp_path):
    path = tmp_path / "truth.trc"
    path.write_text(trc(ROWS[1:] - [[1, 2, 3]] * np.ones((2, 1, 1)), JOINTS))
    truth = load_truth(path)
    assert not np.isnan(truth.positions).any()
    assert truth.notes == ()


def test_a_true_joint_at_0_in_a_log_is_not_known(names, crossing, tmp_path):
    path = tmp_path / "truth.mcap"
    with open_log(crossing, topics=["/truth/*"], output_prefix="/none") as log:
        assert load_truth(log.reader).notes == ()
    with open_log(crossing) as log, McapWriter(path) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        decoder, encoder = Decoder(log.model, exact=True), Encoder(log.model)
        for message in log.reader.messages():
            topic, data = log.reader.channels[message.channel_id].topic, bytes(message.data)
            if topic.startswith("/truth"):
                (frame,) = decoder.decode_message(data, message.log_time)
                data = encoder.encode(hidden(frame, 0, 0.0, names))
            writer.write(message.channel_id, message.log_time, data)
        writer.commit()
    truth = load_truth(path)
    assert truth.model is not None
    assert np.isnan(truth.positions[:, :, truth.model.marker_names.index(HAND)]).all()
    assert "100 % of HAND_LEFT" in truth.notes[0]
