"""A message that shows nobody says nothing about frames, transforms, stamps and other cameras."""

from __future__ import annotations

import detector_logs as made
import numpy as np
import pytest
from odd_logs import changed, later
from test_live import AS_KNOWN, LIVE, recorded, results, run_live, send
from whole_commands import first_seconds

from hiros_mcap.io.log import open_log
from hiros_mcap.running.overview import overview_of
from hiros_mcap.running.pipeline import process

ODD = [("azure", name) for name in made.ODD_AZURE] + [("zed", name) for name in made.ODD_ZED]
MAKERS = {"azure": (made.azure, made.ODD_AZURE), "zed": (made.zed("zed-38"), made.ODD_ZED)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.mcap"
    return made.scene(path, people=2, cameras=3, seconds=1.2, action="cross")


@pytest.fixture(scope="module")
def rows(scene):
    """Rows of each detector's healthy log."""
    return {name: list(make(scene)) for name, (make, _) in MAKERS.items()}


@pytest.fixture(scope="module")
def healthy_people(scene, rows, tmp_path_factory):
    """Whom each detector's healthy log shows, as ``people_of`` gives them."""
    folder = tmp_path_factory.mktemp("healthy")
    return {
        name: people_of(made.write_ros2(folder / name, scene, lambda _, name=name: rows[name]))
        for name in rows
    }


def write_odd(folder, scene, rows, detector, name):
    odd = MAKERS[detector][1][name]
    return made.write_odd(folder / "odd.mcap", scene, lambda _: rows[detector], odd)


@pytest.mark.parametrize(("detector", "name"), ODD)
def test_odd_messages_are_read_alike_from_a_file_and_live(detector, name, scene, rows, tmp_path):
    log = write_odd(tmp_path, scene, rows, detector, name)
    summary = process(log, tmp_path / "out.mcap", config=AS_KNOWN, options=LIVE)
    live, data = run_live(send(log, recorded(log)))
    assert summary.warnings == live.warnings == ()
    assert len(summary.people) == len(live.people) == 2
    assert results(data) == results((tmp_path / "out.mcap").read_bytes())


@pytest.mark.parametrize(("detector", "name"), ODD)
def test_odd_messages_change_nothing_for_the_other_cameras(
    detector, name, scene, rows, healthy_people, tmp_path
):
    shown = people_of(write_odd(tmp_path, scene, rows, detector, name))
    expected = healthy_people[detector]
    assert shown.keys() <= expected.keys()
    assert {key for key in expected if key[0] != "camera_0"} <= shown.keys()
    for key, positions in shown.items():
        there = ~np.isnan(positions)
        assert there.mean() > 0.9
        np.testing.assert_array_equal(positions[there], expected[key][there])


def people_of(path):
    """Camera and stamp of each frame with people -> their positions in the world."""
    with open_log(path) as log:
        assert log.fixed_frame == "world"
        return {(f.source, f.stamp): f.positions for f in log.detections() if f.n_people}


def nobody(frame, name, stamp):
    """A message without people."""
    people = frame.people.at(slice(0, 0))
    return frame.replace(people=people, frame_id=name, source=name, stamp=stamp)


def absent(frame, name, stamp):
    """A message with people of whom no joint is there."""
    people = frame.people.copy()
    people.markers[:] = people.links[:] = np.nan
    return frame.replace(people=people, frame_id=name, stamp=stamp)


@pytest.fixture(scope="module")
def brief(crossing, tmp_path_factory):
    """The first second of two people who cross."""
    return first_seconds(crossing, 1.0, tmp_path_factory.mktemp("brief") / "crossing.mcap")


@pytest.fixture(scope="module")
def people_of_brief(brief):
    return people_of(brief)


WHEN = {
    "first": lambda source, sent: sent == 0 and source == "camera_0",
    "first of all": lambda source, sent: sent == 0,
    "in between": lambda source, sent: sent % 4 == 2,
    "one camera": lambda source, sent: source == "camera_2",
}


@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize("name", ["", "elsewhere", "camera_0"])
@pytest.mark.parametrize(("empty", "stamp"), [(nobody, 0), (nobody, 5), (absent, 0)])
def test_who_shows_nobody_names_no_frame_and_no_time(
    when, name, empty, stamp, brief, people_of_brief, tmp_path
):
    def change(frame, sent):
        return empty(frame, name, stamp) if WHEN[when](frame.source, sent) else frame

    log = changed(brief, tmp_path / "odd.mcap", change)
    summary = process(log)
    assert len(summary.people) == 2
    assert summary.warnings == ()
    assert not any("without a time" in note for note in summary.notes)
    assert overview_of(log).fault == ""
    shown = people_of(log)
    assert all(np.array_equal(people_of_brief[key], shown[key], equal_nan=True) for key in shown)


def test_the_clock_of_a_camera_is_that_of_its_other_messages(crossing, tmp_path):
    """It may be any; a message of nobody without a stamp has its time by it."""

    def change(frame, sent):
        frame = later(frame, -100_000_000_000) if frame.source == "camera_1" else frame
        return nobody(frame, "", 0) if sent % 4 == 0 else frame

    log = changed(crossing, tmp_path / "odd.mcap", change)
    with open_log(log) as opened:
        lags = {f.log_time - f.stamp for f in opened.frames() if f.source == "camera_1"}
    assert max(lags) - min(lags) < 200_000_000
    (warning,) = process(log).warnings
    assert "camera_1" in warning
    assert "100.0" in warning


def test_info_names_who_shows_nobody(crossing, tmp_path):
    def change(frame, sent):
        empty = frame.source == "camera_2" or (frame.source == "camera_0" and sent < 3)
        return nobody(frame, "", 0) if empty else frame

    remarks = overview_of(changed(crossing, tmp_path / "odd.mcap", change)).remarks
    assert "/camera_2/skeletons: nobody is in view in the whole log" in remarks
    assert "/camera_0/skeletons: nobody is in view at the beginning, for 3 messages" in remarks


@pytest.mark.parametrize("name", ["", "elsewhere"])
def test_a_camera_that_sees_somebody_late_joins_a_live_run(name, crossing, tmp_path):
    def change(frame, sent):
        late = frame.source == "camera_1" and sent < 40
        return nobody(frame, name, 0) if late else frame

    log = changed(crossing, tmp_path / "odd.mcap", change)
    summary, _ = run_live(send(log, recorded(log)))
    used = {camera.topic: camera.used for camera in summary.cameras}
    assert summary.warnings == ()
    assert min(used.values()) > 40
    assert len(summary.people) == 2
