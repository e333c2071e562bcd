"""The cameras' poses of a causal run: refined slowly, by what was seen before."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from odd_logs import later
from test_live import AS_KNOWN, LIVE, recorded, results, run_live, send
from test_pose_alignment import turned, write

from hiros_mcap.calibrate.camera_views import sightings_of
from hiros_mcap.calibrate.refinement import refine_poses
from hiros_mcap.calibrate.survey import SPACING_NS
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.io.camera_clock import ClockFault
from hiros_mcap.io.log import open_log
from hiros_mcap.running import pose_follower
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.pose_alignment import PoseAlignment
from hiros_mcap.running.pose_follower import PoseFollower
from hiros_mcap.simulate import RigParams, SimulateParams, simulate
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.stages.known_cameras import KnownCameras


@pytest.fixture(scope="module")
def scene():
    params = {"people": 1, "cameras": 3, "seconds": 12.0, "seed": 5, "rig": {"rate": 15.0}}
    return simulate(SimulateParams.model_validate(params))


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """Logs with true poses and with one that is off by two degrees."""
    folder = tmp_path_factory.mktemp("poses")
    true = {camera.name: camera.pose for camera in scene.cameras}
    frames = list(scene.detections)
    write(folder / "true.mcap", scene, frames, true)
    off = true | {"camera_2": turned(true["camera_2"], 2.0, 0.0)}
    write(folder / "off.mcap", scene, frames, off)
    return folder


def followed(log, blocks):
    alignment, clocks = PoseAlignment(), ClockFollower({}, [], 0.0)
    follower = PoseFollower(log.read(), alignment, KnownCameras(), clocks, movable=True)
    return list(frames_of(follower.correct(blocks))), alignment


def assert_same(ones, others):
    for one, other in zip(ones, others, strict=True):
        np.testing.assert_array_equal(one.markers, other.markers)
        np.testing.assert_array_equal(one.links, other.links)


def test_a_wrong_pose_is_found_and_left_in_small_steps(folder):
    with open_log(folder / "off.mcap") as log:
        given, (found, alignment) = list(log.detections()), followed(log, log.blocks())
    ways = {
        f.log_time: np.nanmax(np.abs(b.positions - f.positions))
        for f, b in zip(given, found, strict=True)
        if f.source == "camera_2" and f.n_people
    }
    assert alignment.cameras[2].verdict == "improved"
    assert alignment.cameras[2].moved_deg == pytest.approx(2.0, abs=0.4)
    start = min(ways)
    assert all(way == 0.0 for time, way in ways.items() if time < start + 2.9e9)
    assert max(way for time, way in ways.items() if time < start + 5e9) > 0.02
    assert ways[max(ways)] > 0.02
    assert np.abs(np.diff(list(ways.values()))).max() < 0.02


@pytest.mark.parametrize("movable", [True, False])
def test_wrong_poses_are_not_taken_for_wrong_clocks(tmp_path, movable):
    rig = RigParams(orientation_error=0.55, position_error=0.009)
    params = SimulateParams(cameras=3, action="roam", seconds=5.0, seed=51, rig=rig)
    write_log(tmp_path / "lab.mcap", params)
    faults: list[ClockFault] = []
    with open_log(tmp_path / "lab.mcap") as log:
        clocks = ClockFollower({}, faults, 0.0)
        follower = PoseFollower(
            log.read(), PoseAlignment(), KnownCameras(), clocks, movable=movable
        )
        for _ in follower.correct(log.blocks()):
            pass
    assert faults == []


@pytest.mark.parametrize("ahead", [0.06, -0.06])
def test_a_clock_that_log_times_hide_is_proved_by_the_people_and_stays_so(ahead, folder):
    """A camera's stamps and log times are off alike; comparison after comparison tells the same."""
    ns = round(1e9 * ahead)
    with open_log(folder / "true.mcap") as log:
        frames = [
            later(f, ns).replace(log_time=f.log_time + ns) if f.source == "camera_2" else f
            for f in log.detections()
        ]
        frames.sort(key=lambda frame: frame.log_time)
        clocks, known = ClockFollower({}, [], 0.0), KnownCameras()
        follower = PoseFollower(log.read(), PoseAlignment(), known, clocks, movable=True)
        start, told = frames[0].log_time, {}
        for block in follower.correct(map(Block.of, frames)):
            seconds = (int(block.log_times[0]) - start) // 10**9
            told[seconds] = clocks.proved("camera_2") - clocks.proved("camera_0")
    assert told[1] == 0.0
    assert [told[s] for s in (5, 7, 9, 11)] == pytest.approx([-ahead] * 4, abs=0.015)


def test_detections_come_nearer_to_where_the_true_pose_puts_them(folder):
    with open_log(folder / "true.mcap") as true, open_log(folder / "off.mcap") as log:
        wanted, given = list(true.detections()), list(log.detections())
        found, _ = followed(log, log.blocks())
    last = [k for k, f in enumerate(wanted) if f.source == "camera_2" and f.n_people][-15:]

    def miss(frames):
        ways = [frames[k].positions - wanted[k].positions for k in last]
        return float(np.nanmean(np.linalg.norm(np.concatenate(ways), axis=-1)))

    assert miss(found) < 0.8 * miss(given)


def test_a_few_messages_of_a_second_are_compared_and_spread_over_it(folder, monkeypatch):
    compared = {}

    def seen(block, chosen, start):
        for k in chosen:
            if block.sizes[k]:
                compared.setdefault(block.source(k), []).append(int(block.stamps[k]))
        return sightings_of(block, chosen, start)

    monkeypatch.setattr(pose_follower, "sightings_of", seen)
    with open_log(folder / "true.mcap") as log:
        followed(log, log.blocks())
    assert len(compared) == 3
    for stamps in compared.values():
        gaps = np.diff(stamps)
        assert gaps.min() >= SPACING_NS
        assert np.median(gaps) < SPACING_NS + 55e6  # the next message comes after 50 ms


def test_a_block_is_cut_where_the_result_of_a_comparison_comes_in(folder):
    with open_log(folder / "true.mcap") as log:
        whole = join(list(log.blocks()))
        clocks = ClockFollower({}, [], 0.0)
        follower = PoseFollower(log.read(), PoseAlignment(), KnownCameras(), clocks, movable=True)
        follower._start = start = int(whole.log_times[0])
        begins = [int(part.log_times[0]) - start for part in follower._parts(whole)]
    times = whole.log_times - start
    ready = [round((seconds + 0.3) * 1e9) for seconds in (3, 4, 6, 8, 10)]
    assert begins[-5:] == [times[times >= each].min() for each in ready]


def test_only_the_people_of_the_last_seconds_are_compared(folder, monkeypatch):
    compared: list[float] = []

    def noting(views, *rest, **how):
        compared.append(min(t.seconds[0] for view in views for t in view.tracks))
        return refine_poses(views, *rest, **how)

    monkeypatch.setattr(pose_follower, "refine_poses", noting)
    monkeypatch.setattr(pose_follower, "_WINDOW_S", 6.0)
    with open_log(folder / "true.mcap") as log:
        followed(log, log.blocks())
    # After 3, 4, 6, 8 and 10 s.
    assert compared == pytest.approx([0.0, 0.0, 0.0, 2.0, 4.0], abs=0.5)


def test_the_run_goes_on_while_poses_are_compared(folder, monkeypatch):
    start, seen = threading.Event(), []

    def waiting(*what, **how):
        assert start.wait(60)
        return refine_poses(*what, **how)

    def noting(frames):
        for frame in frames:
            seen.append(frame.log_time)
            if seen[-1] - seen[0] > 3.2e9:  # messages go on behind the first comparison, at 3 s
                start.set()
            yield Block.of(frame)

    monkeypatch.setattr(pose_follower, "refine_poses", waiting)
    with open_log(folder / "off.mcap") as log:
        _, alignment = followed(log, noting(log.detections()))
    assert alignment.cameras[2].verdict == "improved"


def test_a_comparison_at_the_end_of_a_log_counts(folder):
    with open_log(folder / "off.mcap") as log:
        frames = list(log.detections())
        end = frames[0].log_time + 3_100_000_000  # the first comparison begins after 3 s
        shorter = [Block.of(frame) for frame in frames if frame.log_time < end]
        _, alignment = followed(log, shorter)
    assert [camera.name for camera in alignment.cameras] == [f"camera_{k}" for k in range(3)]


def test_a_comparison_after_a_pause_counts_at_once(folder):
    with open_log(folder / "off.mcap") as log:
        frames = list(log.detections())
        times = [frame.log_time - frames[0].log_time for frame in frames]
        # Cameras pause while the first comparison would begin, and its result come in.
        kept = [
            Block.of(frame)
            for frame, time in zip(frames, times, strict=True)
            if time < 3.9e9 and not 2.9e9 < time < 3.5e9
        ]
        alignment, clocks = PoseAlignment(), ClockFollower({}, [], 0.0)
        follower = PoseFollower(log.read(), alignment, KnownCameras(), clocks, movable=True)
        for block in follower.correct(kept):
            if int(block.log_times[0]) > frames[0].log_time + 3_500_000_000:
                assert len(alignment.cameras) == 3
                return
    pytest.fail("no message came after the pause")


def test_it_does_not_matter_how_messages_come_in_blocks(folder):
    with open_log(folder / "off.mcap") as log:
        frames = list(log.detections())
        whole = join([Block.of(frame) for frame in frames])
        one_by_one, in_one = followed(log, map(Block.of, frames))[0], followed(log, [whole])[0]
        assert_same(one_by_one, in_one)
        assert_same(one_by_one, followed(log, log.blocks())[0])
    assert any((a.markers != b.markers).any() for a, b in zip(frames, in_one, strict=True))


def test_what_comes_later_changes_nothing(folder):
    with open_log(folder / "off.mcap") as log:
        frames = list(log.detections())
        some = frames[: len(frames) * 9 // 10]
        early, whole = (followed(log, map(Block.of, each))[0] for each in (some, frames))
    assert_same(early, whole[: len(early)])


def test_true_poses_stay(folder):
    with open_log(folder / "true.mcap") as log:
        given, (found, alignment) = list(log.detections()), followed(log, log.blocks())
    assert_same(given, found)
    assert [camera.verdict for camera in alignment.cameras] == ["good"] * 3
    assert not alignment.replaced


def test_a_pipe_is_corrected_as_a_file_is(folder, tmp_path):
    path = folder / "off.mcap"
    in_file = process(path, tmp_path / "auto.mcap", config=AS_KNOWN, options=LIVE)
    by_file = results((tmp_path / "auto.mcap").read_bytes())
    live, out = run_live(send(path, recorded(path)))
    assert results(out) == by_file
    assert live.poses == in_file.poses
    assert in_file.poses[2].used
    options = ProcessOptions("hiros-realtime", calibrate="off")
    assert process(path, tmp_path / "off.mcap", options=options).poses == ()
    assert results((tmp_path / "off.mcap").read_bytes()) != by_file
