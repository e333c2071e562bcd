"""Left and right decided over time: mirrored views come right, honest ones stay as they are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from builders import FAULTLESS, at_once, moved, same
from scipy.spatial.transform import Rotation

from hiros_mcap.body.forward_cues import CUES, FacingMarkers
from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, by_frame, frames_of, join
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.body_model import MODEL, SLOT, SYMMETRY
from hiros_mcap.skeletons import UNTRACKED, SkeletonModel
from hiros_mcap.stages.detections import sides
from hiros_mcap.stages.detections.body_axes import follow_line
from hiros_mcap.stages.detections.facing_evidence import (
    BINS,
    FacingPast,
    FacingTables,
    MeasuredViews,
    write_evidence,
)
from hiros_mcap.stages.detections.sides import SidesParams, decide_sides, knows_sides
from hiros_mcap.systems import Run, system

LIVE = SidesParams(lookahead=0.0)
PERIOD = 1 / 30


@cache
def truth(seconds, warp=""):
    """Somebody walks about the room; ``warp`` "backwards" lets time run back from 3 s on."""
    simulation = simulate(SimulateParams.model_validate({**FAULTLESS, "seed": 3}))
    t = np.arange(round(seconds / PERIOD)) * PERIOD
    shown = np.where(t < 3, t, 6 - t) if warp == "backwards" else t
    start = simulation.params.start
    stamps = [start + round(k * PERIOD * 1e9) for k in range(len(t))]
    frames = simulation.truth_at(start + (shown * 1e9).astype(np.int64) + 10**9)
    return tuple(
        replace(frame, stamp=stamp, log_time=stamp)
        for stamp, frame in zip(stamps, frames, strict=True)
    )


def views(seconds, change=None, *, cameras=2, warp=""):
    """The cameras' views of person 0, one message after the other, 3 ms apart."""
    frames = []
    for k, frame in enumerate(truth(seconds, warp)):
        for camera in range(cameras):
            stamp = frame.stamp + 3_000_000 * camera
            own = replace(frame, stamp=stamp, log_time=stamp, source=f"c{camera}")
            own = own.replace(markers=frame.markers.copy(), links=frame.links.copy())
            frames.append(change(own, camera, k * PERIOD) if change else own)
    return frames


def mirror(frame):
    return frame.replace(markers=frame.markers[:, SYMMETRY.mirror].copy())


def turned_toes(frame):
    """Mirror the labels, and let the toes point backwards."""
    out = mirror(frame)
    for side in ("LEFT", "RIGHT"):
        ankle, foot = out.markers[:, SLOT[f"ANKLE_{side}"]], out.markers[:, SLOT[f"FOOT_{side}"]]
        foot[:, :2] = 2 * ankle[:, :2] - foot[:, :2]
    return out


def faces_away(frame, camera):
    """Whether the person turns the back to a camera far away on the x axis or the y axis."""
    hips = frame.positions[0, [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]], :2]
    x, y = hips[1] - hips[0]
    return bool(((-y, x)[camera]) < 0)


def decided(frames, params=None, events=None):
    return list(at_once(decide_sides)(frames, MODEL, params, events))


def same_markers(one, other):
    return np.array_equal(one.markers, other.markers, equal_nan=True)


def right(frames, seconds, warp=""):
    """Share of the frames whose hips are on the right sides."""
    hips = [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]]
    true = {f.stamp: f.positions[0, hips] for f in truth(seconds, warp)}
    good = []
    for frame in frames:
        own = true[max(stamp for stamp in true if stamp <= frame.stamp)]
        good.append(np.linalg.norm(frame.positions[0, hips] - own) < 0.05)
    return float(np.mean(good))


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_honest_views_stay_as_they_are(params):
    frames, events = views(4), Events()
    results = decided(frames, params, events)
    assert len(results) == len(frames) and events.total("flip") == 0
    assert all(map(same_markers, results, frames))


@pytest.mark.parametrize("cameras", [1, 2, 3])
@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_a_flip_of_all_cameras_is_not_believed(params, cameras):
    def flip(frame, _, t):
        return mirror(frame) if 1.5 <= t < 2.8 else frame

    events = Events()
    assert right(decided(views(5, flip, cameras=cameras), params, events), 5) == 1
    assert events.counts["flip", "c0"] == pytest.approx(39, abs=1)


@pytest.mark.parametrize("wrong", [mirror, turned_toes])
@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_cameras_that_mirror_all_who_turn_away(params, wrong):
    def from_behind(frame, camera, _):
        return wrong(frame) if faces_away(frame, camera) else frame

    frames = views(12, from_behind)
    assert right(frames, 12) < 0.8
    assert right(decided(frames, params), 12) > 0.95


def test_walking_backwards_is_believed():
    results = decided(views(6, warp="backwards"))
    assert right(results, 6, "backwards") == 1


def test_toes_that_follow_the_label_are_turned_round():
    def one_mirrors(frame, camera, _):
        return turned_toes(frame) if camera == 0 else frame

    toes = SLOT["FOOT_LEFT"]
    result, honest = decided(views(4, one_mirrors))[-2:]
    gap = result.positions[0, toes, :2] - honest.positions[0, toes, :2]
    assert np.linalg.norm(gap) < 0.06


def test_physical_toes_stay():
    def one_mirrors(frame, camera, _):
        return mirror(frame) if camera == 0 else frame

    result, honest = decided(views(4, one_mirrors))[-2:]
    assert np.array_equal(result.positions, honest.positions)


def test_links_of_mirrored_views_are_unknown():
    frames = views(3, lambda frame, _, t: mirror(frame) if t > 2 else frame)
    results = decided(frames)
    assert not np.isnan(results[0].orientations).any()
    assert np.isnan(results[-1].links).all() and np.isnan(results[-1].link_confidences).all()


def turned(frame, degrees):
    """Turn a person about the upright line through the hips."""
    hips = frame.positions[0, [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]]].mean(axis=0) * [1, 1, 0]
    turn = Rotation.from_euler("z", degrees, degrees=True)
    (out,) = moved(moved([frame], Rotation.identity(), -hips), turn, hips)
    return replace(out, source=frame.source)


SLAVED = 2.5
"""s in which a detector shows that its toes follow its labels: camera 0 is wrong all the time."""


def slaved(frame, camera, t):
    """Return what such a detector reports: its lines tell nothing of turns either."""
    return turned_toes(frame) if camera == 0 and t < SLAVED else frame


def swinging(frame, camera, t):
    """Let the line through shoulders and hips swing round to the other labelling, after that."""
    angle = min(max((t - SLAVED - 0.5) * 600, 0.0), 180.0)
    frame = slaved(frame, camera, t)
    return turned(frame, angle) if angle < 90 else mirror(turned(frame, angle - 180))


def largest_turn(frames):
    """Largest change of the facing from one frame of camera 0 to the next, degrees."""
    hips = [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]]
    across = np.array(
        [np.diff(f.positions[0, hips, :2], axis=0)[0] for f in frames if f.source == "c0"]
    )
    angles = np.degrees(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))
    return float(np.abs(np.diff(angles)).max())


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_the_facing_does_not_jump_while_the_line_swings_round(params):
    frames = views(4.5, swinging)
    results = [f for f in decided(frames, params) if f.stamp > frames[0].stamp + SLAVED * 1e9]
    assert right(results[-30:], 4.5) == 1
    assert largest_turn(results) < 60


def test_a_trunk_at_a_right_angle_is_turned_towards_the_facing():
    def askew(frame, camera, t):
        return turned(frame, 80) if camera == 0 and t > 3.8 else slaved(frame, camera, t)

    frames = views(4, askew)
    result, honest = decided(frames)[-2:]
    hips = [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]]
    a, b = (np.diff(f.positions[0, hips, :2], axis=0)[0] for f in (result, honest))
    assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > np.cos(np.radians(20))
    middles = [f.positions[0, SYMMETRY.lateral].mean(axis=1) for f in (result, frames[-2])]
    np.testing.assert_allclose(*middles, atol=1e-9)
    hands = SLOT["WRIST_LEFT"], SLOT["WRIST_RIGHT"]
    assert np.array_equal(result.positions[0, hands], frames[-2].positions[0, hands])
    assert np.isnan(result.links).all() and not np.isnan(honest.links).all()


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_labels_that_go_round_with_a_person_are_honest(params):
    """Whatever toes have shown before: no trunk is turned any more."""

    def go_round(frame, camera, t):
        angle = 240 * min(max(t - SLAVED - 0.5, 0), 3) + (80 if camera == 0 and t > 8 else 0)
        return turned(slaved(frame, camera, t), angle)

    frames = views(8.2, go_round)
    assert all(map(same_markers, decided(frames, params)[-12:], frames[-12:]))


def test_the_first_view_keeps_its_labels():
    """Nothing but that view speaks of the facing."""
    frames = [turned_toes(frame) for frame in views(0.1, cameras=1)]
    assert same_markers(decided(frames, LIVE)[0], frames[0])


def test_ids_may_come_after_earlier_frames_of_the_same_arrays():
    whole = join([Block.of(f) for f in views(8, lambda f, c, t: mirror(f) if t > 2 else f)])
    ids = whole.people.ids.copy()
    whole.people.ids[:] = UNTRACKED

    def feed():
        for i, (begin, end) in enumerate(whole.rows.tolist()):
            whole.people.ids[begin:end] = ids[begin:end]
            yield whole.select([i])

    out = list(frames_of(decide_sides(feed(), MODEL)))
    assert all(len(frame.ids) and (frame.ids != UNTRACKED).all() for frame in out)


def test_many_views_are_passed_on_in_several_blocks(monkeypatch):
    """As one block, what fast cameras see in a second would take much memory."""
    frames = views(5, lambda f, c, t: mirror(f) if c == 0 and t % 2 > 1 else f)
    whole = decided(frames)
    monkeypatch.setattr(sides, "_MOST", 20)
    parts = [join([Block.of(f) for f in frames[k : k + 8]]) for k in range(0, len(frames), 8)]
    out = list(decide_sides(parts, MODEL))
    assert max(len(block.people.ids) for block in out) < 20 + 8
    assert all(map(same_markers, frames_of(out), whole))


@pytest.mark.parametrize("params", [SidesParams(lookahead=1.0), LIVE])
def test_blocks_may_be_cut_anywhere(params):
    frames = views(5, lambda f, c, t: mirror(f) if c == 0 and t % 2 > 1 else f)
    whole = join([Block.of(frame) for frame in frames])
    together = frames_of(decide_sides([whole], MODEL, params))
    assert all(map(same, together, by_frame(decide_sides)(frames, MODEL, params)))


def test_a_live_decision_does_not_know_the_future():
    frames = views(3, lambda f, c, t: mirror(f) if t > 1.5 else f)
    assert all(map(same, decided(frames[:90], LIVE), decided(frames, LIVE)))


def test_frames_come_in_order_when_they_are_decided():
    frames, params, fed = views(8), SidesParams(lookahead=1.0), [0]

    def feed():
        for frame in frames:
            fed[0] = frame.stamp
            yield Block.of(frame)

    waits, stamps = [], []
    for frame in frames_of(decide_sides(feed(), MODEL, params)):
        assert frame.log_time == fed[0]
        waits.append((fed[0] - frame.stamp) * 1e-9)
        stamps.append(frame.stamp)
    assert stamps == [frame.stamp for frame in frames]
    assert max(waits) < 2.1 and min(waits[:100]) > 0.95


def test_z_need_not_point_up():
    """Frames of cameras look along z, and y points down."""

    def from_behind(frame, camera, _):
        return mirror(frame) if faces_away(frame, camera) else frame

    frames, turn = views(8, from_behind), Rotation.from_euler("x", -90, degrees=True)
    results = decided(moved(frames, turn, np.zeros(3)))
    assert right(moved(results, turn.inv(), np.zeros(3)), 8) > 0.95


# People who are not upright.


def down_and_up(frame, t):
    """Fall forwards from 1 s to 2 s, roll over from 2.5 s to 4.5 s, get up from 5 s to 6 s."""
    hips = frame.positions[0, [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]]]
    across = (hips[1] - hips[0]) / np.linalg.norm(hips[1] - hips[0])
    lies = np.interp(t, [1, 2, 5, 6], [0, 90, 90, 0])
    rolled = np.interp(t, [2.5, 4.5], [0, 360])
    turn = Rotation.from_rotvec(-lies * across, degrees=True)
    turn = turn * Rotation.from_euler("z", rolled, degrees=True)
    middle = hips.mean(axis=0)
    (out,) = moved(moved([frame], Rotation.identity(), -middle), turn, middle * [1, 1, 0.3])
    return replace(out, source=frame.source)


@cache
def floor_views(cameras=2, begin=0.0):
    """As :func:`views`, of somebody who is on the floor; ``begin`` s of it are left out."""
    return views(8 - begin, lambda frame, _, t: down_and_up(frame, t + begin), cameras=cameras)


@pytest.mark.parametrize("begin", [0.0, 2.0, 3.5])
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_honest_views_of_people_on_the_floor_stay(params, cameras, begin):
    frames = floor_views(cameras=cameras, begin=begin)
    assert all(map(same_markers, decided(frames, params), frames))


@pytest.mark.parametrize(("begin", "cameras"), [(1.2, 1), (2.6, 2), (3.6, 1), (5.0, 2)])
@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_a_flip_on_the_floor_is_not_believed(params, cameras, begin):
    honest = floor_views(cameras=cameras)
    flipped = range(round(begin / PERIOD) * cameras, round((begin + 1) / PERIOD) * cameras)
    results = decided([mirror(f) if k in flipped else f for k, f in enumerate(honest)], params)
    assert all(
        np.array_equal(a.positions, b.positions) for a, b in zip(results, honest, strict=True)
    )


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_a_spin_exchanges_nothing(params):
    frames = views(4, lambda frame, _, t: turned(frame, 600 * min(max(t - 1.5, 0), 1.5)))
    assert all(map(same_markers, decided(frames, params), frames))


def turned_axes(speed, trust):
    """Degrees by which the axes turn in a second with a line of that speed, degrees/s."""
    line, axes, total = np.full(3, np.nan), np.eye(3), 0.0
    for k in range(31):
        angle = np.radians(speed) * k * PERIOD - total
        total += follow_line(line, angle, 1.0, PERIOD, trust, axes)
    assert np.arctan2(axes[0, 1], axes[0, 0]) == pytest.approx(
        (total + np.pi) % (2 * np.pi) - np.pi
    )
    return float(np.degrees(total))


def test_axes_follow_slow_turns_and_fast_ones_apart():
    """A line that swings back slowly takes no axes along while nothing is known of labels."""
    assert turned_axes(150, (0, 1)) == pytest.approx(0)
    assert turned_axes(600, (0, 1)) > 450
    assert turned_axes(150, (1, 1)) > 130 and turned_axes(600, (1, 1)) > 570
    assert turned_axes(600, (0, 0)) == 0


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_labels_decide_after_the_trunk_was_hidden(params):
    """Meanwhile, somebody may have turned round or rolled over in any way."""

    def hidden(frame, _, t):
        if 2 <= t < 3.5:
            for part in ("SHOULDER", "HIP"):
                frame.markers[:, [SLOT[f"{part}_LEFT"], SLOT[f"{part}_RIGHT"]]] = np.nan
        return turned(frame, 180) if t >= 3.5 else frame

    frames = views(5, hidden)
    assert all(map(same_markers, decided(frames, params), frames))


ARMS = {f"{part}_{side}" for part in ("SHOULDER", "ELBOW", "WRIST") for side in ("LEFT", "RIGHT")}


@pytest.mark.parametrize("trunk", [{"SPINE_NAVAL", "NECK"}, {"NECK", "HEAD"}, {"NOSE"}])
@pytest.mark.parametrize("cameras", [{0, 1}, {1}])
def test_a_flip_of_somebody_at_a_desk_is_not_believed(trunk, cameras):
    hidden = [k for k, name in enumerate(MODEL.marker_names) if name not in ARMS | trunk]

    def sit(frame, camera, t):
        frame = mirror(frame) if 1.5 <= t < 2.8 else frame
        if camera in cameras:
            frame.markers[:, hidden] = np.nan
        return frame

    events = Events()
    decided(views(5, sit), SidesParams(), events)
    assert [events.counts["flip", f"c{k}"] for k in (0, 1)] == pytest.approx([39, 39], abs=1)


def test_without_a_trunk_the_views_vote():
    names = [name for name in MODEL.marker_names if name in ARMS]
    assert knows_sides(MODEL) and not knows_sides(SkeletonModel.of(names, []))


def test_nothing_is_done_without_names_of_sides():
    model = SkeletonModel.of([f"m{k}" for k in range(32)], [])
    frames = views(1)
    out = decide_sides(map(Block.of, frames), model)
    assert all(map(same, frames_of(out), frames))


def test_it_can_be_turned_off():
    frames = views(1, lambda f, c, t: mirror(f))
    out = decide_sides(map(Block.of, frames), MODEL, SidesParams(over_time=False))
    assert all(map(same, frames_of(out), frames))


@pytest.mark.parametrize("params", [SidesParams(), LIVE])
def test_people_without_markers_or_ids_pass(params):
    def lose(frame, camera, t):
        frame.markers[:, :: camera + 1 if t < 1 else 1] = np.nan
        return frame.replace(ids=np.array([-1 if t > 0.5 else 0], np.int32))

    frames = views(2, lose)
    assert all(map(same_markers, decided(frames, params), frames))


def test_a_message_that_is_very_late_passes():
    frames = views(8, lambda f, c, t: mirror(f) if c == 0 and t > 1 else f)
    late = [*frames[:30], *frames[32:400], *frames[30:32], *frames[400:]]
    assert [f.stamp for f in decided(late, SidesParams(lookahead=1.0))] == [f.stamp for f in late]


def test_cues_are_found_by_their_names():
    kinect = ["Head", "Neck", "ElbowLeft", "ShoulderLeft", "WristLeft", "AnkleRight", "FootRight"]
    cues = FacingMarkers.of(SkeletonModel.of(kinect, []))
    found = [(CUES[cue], *(kinect[k] for k in rest if k >= 0)) for cue, *rest in cues.vectors]
    arm = ("elbow", "ShoulderLeft", "WristLeft", "ElbowLeft")
    assert found == [("head", "Neck", "Head"), arm, ("toe", "AnkleRight", "FootRight")]


def merged(preset, frames):
    """Merge tracked frames as hiros does with a preset."""
    stages = system("hiros").stages(
        Run(MODEL, load_config(preset=preset, system="hiros"), fixed_frame="world")
    )
    return [f.positions[0] for f in frames_of(stages["merged"](map(Block.of, frames)))]


def test_hiros_decides_over_time_and_the_paper_votes():
    frames = views(6, lambda f, c, t: mirror(f) if t > 2 else f)
    swapped, kept = merged("paper", frames)[-1], merged("default", frames)[-1]
    hips = SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]
    assert np.linalg.norm(swapped[hips[0]] - kept[hips[1]]) < 0.05
    assert load_config(preset="realtime", system="hiros").sides.lookahead == 0


def test_labels_count_in_proportion_to_the_line_that_they_rest_on():
    views = MeasuredViews.allocate(2)
    views.facing[:], views.widths[:], views.weights[:] = [1.0, 0.0], [0.5, 0.25], 1.0
    past = FacingPast.empty()._replace(widths=np.array([0.5]))
    evidence = np.zeros((2, BINS))
    write_evidence(views, past, FacingTables.make(), evidence)
    full, short = evidence[:, : BINS // 2] - evidence[:, BINS // 2 :]
    assert short == pytest.approx(full / 2)
    assert full[0] > 0.1
