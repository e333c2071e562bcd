"""The simulator: true bodies are bodies, and every fault is what was asked for."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from scipy.spatial.transform import Rotation

from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate import DetectorParams, RigParams, SimulateParams, simulate
from hiros_mcap.simulate.actions import ACTIONS
from hiros_mcap.simulate.body_model import SLOT
from hiros_mcap.simulate.chance import coloured, episodes
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import ACCELERATION, ANGULAR_ACCELERATION, ANGULAR_VELOCITY, VELOCITY

OFF = {
    "noise": 0.0, "occlusion": 0.0, "flips": 0.0, "dropouts": 0.0, "clock_jitter": 0.0,
    "calibration_error": 0.0, "phantoms": 0.0,
}  # fmt: skip


def perfect(**changes):
    return simulate(SimulateParams.model_validate({"seconds": 1.5, "cameras": 2, **OFF, **changes}))


def in_room(simulation):
    """Source and markers (P, M, 3) in the world of every detection."""
    rooms = []
    for frame in simulation.detections:
        pose = simulation.transforms[frame.source]
        points = frame.positions @ _matrix(pose.xyzw).T + pose.translation
        rooms.append((frame.source, points))
    return rooms


def _matrix(xyzw):
    return Rotation.from_quat(xyzw).as_matrix()


@pytest.mark.parametrize("action", sorted(ACTIONS))
def test_bodies_have_constant_limbs_and_move_smoothly(action):
    truth = list(perfect(action=action, people=2).truth)
    poses = np.stack([frame.positions for frame in truth])
    parents, children = perfect().model.links.T
    lengths = np.linalg.norm(poses[:, :, parents] - poses[:, :, children], axis=-1)
    assert np.ptp(lengths, axis=0).max() < 1e-9
    assert not np.isnan(poses).any()
    speed = np.linalg.norm(np.diff(poses, axis=0), axis=-1).max() * 30
    assert speed < 12


def poses_of(action, **changes):
    """(T, M, 3) one person facing x for 8 s."""
    scene = {"action": action, "facing": 0.0, "seconds": 8.0, "cameras": 1, **changes}
    return np.stack([frame.positions[0] for frame in perfect(**scene).truth])


def test_a_lunge_puts_one_foot_far_ahead_and_bends_both_knees():
    poses = poses_of("lunge")
    feet = poses[:, [SLOT["FOOT_LEFT"], SLOT["FOOT_RIGHT"]]]
    stride = feet[:, 0, 0] - feet[:, 1, 0]
    assert stride.max() == pytest.approx(0.72, abs=0.01)
    assert stride.min() == pytest.approx(-0.72, abs=0.01)
    low = poses[:, SLOT["PELVIS"], 2]
    assert 0.2 < np.ptp(low) < 0.35
    knees = poses[np.argmin(low), [SLOT["KNEE_LEFT"], SLOT["KNEE_RIGHT"]], 2]
    assert knees.min() < 0.36 < 0.4 < knees.max()  # one near the floor, one over its foot
    planted = feet[..., 2] < feet[..., 2].min() + 0.002  # toes on the floor do not slide
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1)[planted[1:] & planted[:-1]]
    assert np.quantile(speed, 0.9) < 0.003


def test_hands_go_up_over_the_head_and_down_to_the_hips():
    poses = poses_of("hands_up_down")
    for side in ("LEFT", "RIGHT"):
        above = poses[:, SLOT[f"WRIST_{side}"], 2] - poses[:, SLOT["HEAD"], 2]
        assert above.max() > 0.2
        assert above.min() < -0.5


def test_who_walks_in_place_lifts_both_feet_and_stays():
    poses = poses_of("walk_in_place")
    for side in ("LEFT", "RIGHT"):
        assert 0.1 < np.ptp(poses[:, SLOT[f"FOOT_{side}"], 2]) < 0.3
    assert np.ptp(poses[:, SLOT["PELVIS"], :2], axis=0).max() < 0.1


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def upright(poses):
    """(T,) Vertical part of the direction from pelvis to neck: 1 upright, 0 level."""
    return unit(poses[:, SLOT["NECK"]] - poses[:, SLOT["PELVIS"]])[:, 2]


@pytest.mark.parametrize("action", ["crawl", "get_up", "roll", "kick", "spin"])
@pytest.mark.parametrize("height", [1.2, 1.9])
def test_bodies_of_any_size_stay_above_the_floor(action, height):
    poses = poses_of(action, heights=(height, height), seconds=12.0)
    assert poses[..., 2].min() > -0.03


def test_who_crawls_moves_on_hands_and_knees():
    poses = poses_of("crawl")
    assert np.abs(upright(poses)).max() < 0.25
    way = np.linalg.norm(np.diff(poses[:, SLOT["PELVIS"], :2], axis=0), axis=-1).sum()
    assert way / 8 == pytest.approx(0.35, abs=0.05)
    for part, most in (("KNEE", 0.12), ("WRIST", 0.14)):
        heights = poses[:, [SLOT[f"{part}_LEFT"], SLOT[f"{part}_RIGHT"]], 2]
        assert heights.max() < most
    hands = poses[:, [SLOT["WRIST_LEFT"], SLOT["WRIST_RIGHT"]]]
    planted = hands[..., 2] < hands[..., 2].min() + 0.02
    speed = np.linalg.norm(np.diff(hands, axis=0), axis=-1)[planted[1:] & planted[:-1]] * 30
    assert np.median(speed) < 0.1
    assert 0.5 < planted.mean() < 0.8


def test_who_gets_up_lies_on_the_back_stands_and_lies_again():
    poses = poses_of("get_up", seconds=13.0)
    up = upright(poses)
    lying, standing = np.abs(up) < 0.2, poses[:, SLOT["PELVIS"], 2] > 0.8
    assert lying.sum() > 45
    assert standing.sum() > 30
    nose = unit(poses[:, SLOT["NOSE"]] - poses[:, SLOT["HEAD"]])[:, 2]
    assert nose[lying].min() > 0.8
    assert up[standing].max() > 0.99
    assert poses[lying, :, 2].max() < 0.55


def test_who_rolls_shows_every_side_to_the_ceiling_and_stays_level():
    poses = poses_of("roll")
    assert np.abs(upright(poses)).max() < 0.2
    across = unit(poses[:, SLOT["SHOULDER_LEFT"]] - poses[:, SLOT["SHOULDER_RIGHT"]])[:, 2]
    nose = unit(poses[:, SLOT["NOSE"]] - poses[:, SLOT["HEAD"]])[:, 2]
    assert across.max() > 0.95 > -0.95 > across.min()
    assert nose.max() > 0.95 > -0.95 > nose.min()


@pytest.mark.parametrize("seed", range(4))
def test_a_kick_accelerates_hip_knee_and_ankle_to_40_to_80(seed):
    scene = {"action": "kick", "seconds": 7.0, "truth_rate": 200.0, "seed": seed}
    truth = list(perfect(**scene).truth)
    accelerations = np.stack([frame.markers[0, :, ACCELERATION] for frame in truth], axis=1)
    peaks = np.linalg.norm(accelerations, axis=-1).max(axis=1)
    for part in ("HIP", "KNEE", "ANKLE"):
        for side in ("LEFT", "RIGHT"):
            assert 38 < peaks[SLOT[f"{part}_{side}"]] < 82, (part, side)


@pytest.mark.parametrize("seed", range(4))
def test_a_dancer_now_and_then_spins_at_550_to_670_degrees_a_second(seed):
    scene = {"action": "spin", "seconds": 12.0, "seed": seed}
    truth = list(perfect(**scene).truth)
    rates = np.degrees([frame.links[0, 0, ANGULAR_VELOCITY][2] for frame in truth])
    assert 540 < rates.max() < 680
    assert -680 < rates.min() < -540
    assert np.mean(np.abs(rates) < 100) > 0.6


@pytest.mark.parametrize("facing", [0.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("action", ["squat", "walk_in_place"])
def test_everybody_on_a_spot_faces_where_he_is_told_to(action, facing):
    pose = poses_of(action, facing=facing, seconds=0.1)[0]
    across = pose[SLOT["SHOULDER_LEFT"]] - pose[SLOT["SHOULDER_RIGHT"]]
    ahead = np.degrees(np.arctan2(across[1], across[0])) - 90
    assert (ahead - facing + 180) % 360 - 180 == pytest.approx(0, abs=12)


def test_without_faults_the_cameras_see_the_truth():
    simulation = perfect(people=1, action="wave")
    stamps = {frame.stamps[0] for frame in simulation.detections if frame.n_people}
    poses = {f.stamp: f.positions[0] for f in simulation.truth}
    rooms = in_room(simulation)
    assert len(stamps) > 60
    nearest = min(
        np.nanmax(np.abs(points[0] - pose))
        for _, points in rooms if len(points)
        for pose in poses.values()
    )  # fmt: skip
    assert nearest < 0.02  # a camera's instant is never exactly one of the truth's


def test_four_cameras_in_the_corners_beside_motion_capture_of_another_rate():
    """The room of Malaguti et al. (IV): cameras at 30 Hz and 2.5 m, markers at 50 Hz."""
    rig = {"height": 2.5, "radius": 3.6}
    simulation = perfect(cameras=4, people=2, action="cross", seconds=3, rig=rig, truth_rate=50)
    places = np.stack([pose.translation for pose in simulation.transforms.values()])
    assert places[:, 2] == pytest.approx(np.full(4, 2.5))
    bearings = np.sort(np.degrees(np.arctan2(places[:, 1], places[:, 0])))
    assert np.diff(bearings) == pytest.approx(np.full(3, 90.0))
    true = [frame.stamp for frame in simulation.truth]
    assert np.diff(true) == pytest.approx(np.full(len(true) - 1, 20_000_000), abs=1)
    for camera in simulation.transforms:
        assert sum(f.source == camera for f in simulation.detections) == pytest.approx(90, abs=1)
    assert max(frame.n_people for frame in simulation.detections) == 2


def test_pairs_stand_face_the_cameras_and_now_and_then_change_places():
    rig = {"apart": 45.0}
    scene = perfect(action="pass", people=2, seconds=40.0, rig=rig, seed=3)
    poses = np.stack([frame.positions for frame in scene.truth])  # (T, 2, M, 3)
    apart = np.diff(poses[:, :, SLOT["PELVIS"], :2], axis=1)[:, 0]
    assert np.linalg.norm(apart, axis=-1) == pytest.approx(0.8, abs=0.1)
    across = poses[:, :, SLOT["HIP_LEFT"], :2] - poses[:, :, SLOT["HIP_RIGHT"], :2]
    beside = np.sign((apart * across[:, 0]).sum(-1))[np.abs(apart @ [0, 1]) > 0]
    assert {-1.0, 1.0} <= set(beside)  # each of the two is on the left for a time
    ahead = across.mean(axis=(0, 1)) @ [[0, -1], [1, 0]]
    places = np.stack([pose.translation[:2] for pose in scene.transforms.values()])
    assert unit(ahead) @ unit(places.mean(axis=0)) > 0.7
    steps = np.linalg.norm(np.diff(poses[:, :, SLOT["PELVIS"]], axis=0), axis=-1).max(axis=1) * 30
    assert 0.3 < np.mean(steps < 0.1) < 0.8


def test_all_cameras_pause_in_the_middle_of_the_log():
    simulation = perfect(seconds=6.0, cameras=3, rig={"pause": 2.0})
    stamps = np.array([frame.stamps[0] for frame in simulation.detections if frame.n_people])
    assert np.diff(np.sort(stamps)).max() * 1e-9 == pytest.approx(2.0, abs=0.05)


KINECT = {"kind": "kinect"}


def kinect(**changes):
    """(n, M, 3) errors in the room and (n, M, 3) truth of everybody whom a Kinect sees."""
    scene = {"detector": KINECT, "cameras": 1, "rig": {"fov": (150.0, 150.0)}, **changes}
    pairs = zip(in_room(perfect(**scene)), in_room(perfect(**{**scene, "noise": 0.0})), strict=True)
    seen = [(a[0] - b[0], b[0]) for (_, a), (_, b) in pairs if len(a) and len(b)]
    return tuple(np.stack(parts) for parts in zip(*seen, strict=True))


def test_a_kinect_without_faults_sees_the_truth_and_is_sure_of_it():
    for ideal, frame in zip(perfect().detections, perfect(detector=KINECT).detections, strict=True):
        assert frame.positions == pytest.approx(ideal.positions, abs=1e-9)
        assert frame.orientations == pytest.approx(ideal.orientations, abs=1e-9)
        assert (frame.marker_confidences == 1.0).all()


def test_a_kinect_errs_by_whole_limbs_not_by_joints():
    errors, _ = kinect(noise=1.0, action="free_static", seconds=60.0)
    errors -= np.median(errors, axis=0)

    def together(a, b):
        return np.corrcoef(errors[:, SLOT[a]].ravel(), errors[:, SLOT[b]].ravel())[0, 1]

    assert together("WRIST_LEFT", "HAND_LEFT") > 0.85
    assert together("ANKLE_LEFT", "FOOT_LEFT") > 0.7
    assert abs(together("WRIST_LEFT", "WRIST_RIGHT")) < 0.4


def test_a_kinect_keeps_to_a_pose_and_then_changes_its_mind():
    errors, _ = kinect(noise=1.0, action="free_static", seconds=60.0)
    steps = 1000 * np.linalg.norm(np.diff(errors, 2, axis=0), axis=-1)[:, SLOT["HAND_RIGHT"]]
    assert np.median(steps) < 15
    assert np.quantile(steps, 0.99) > 200


def test_a_kinect_changes_its_mind_when_somebody_moves():
    """Two people: one stands, the other one walks round him for half of the time."""
    scene = {"action": "pass", "people": 2, "seconds": 60.0, "cameras": 1, "detector": KINECT}
    truth, seen = (list(perfect(noise=n, **scene).detections) for n in (0.0, 1.0))
    pairs = [(a.positions, b.positions) for a, b in zip(truth, seen, strict=True)]
    pairs = [(a, b) for a, b in pairs if len(a) == len(b) == 2]
    errors = np.stack([b - a for a, b in pairs])
    walks = np.linalg.norm(np.diff([a[:, 0] for a, _ in pairs], axis=0), axis=-1) > 0.005
    changes = np.linalg.norm(np.diff(errors, axis=0), axis=-1).mean(axis=-1)
    assert changes[walks].mean() > 3 * changes[~walks].mean()


def test_a_kinect_sees_shoulders_too_narrow_from_the_side_hardly_ever_too_wide():
    rig = {"poses": ((3.5, 0.0, 1.5, -0.5, -0.5, 0.5, 0.5),)}
    errors, truth = kinect(noise=1.0, action="walk", seconds=60.0, facing=90.0, rig=rig)
    ends = [SLOT["SHOULDER_LEFT"], SLOT["SHOULDER_RIGHT"]]
    true, seen = (
        np.linalg.norm(np.diff(p[:, ends], axis=1), axis=-1) for p in (truth, truth + errors)
    )
    off = seen / true - 1
    assert np.mean(off < -0.2) > 0.03
    assert np.mean(off > 0.2) < 0.1 * np.mean(off < -0.2)


def test_a_kinect_turns_links_with_their_limbs():
    scene = {"action": "free_static", "seconds": 5.0, "noise": 1.0, "cameras": 1}
    scene["detector"] = {**KINECT, "joint": 0.0}
    model = perfect().model
    link = model.link_names.index("ELBOW_LEFT")
    a, b = model.links[link]
    for frame in perfect(**scene).detections:
        if frame.n_people:
            turn = Rotation.from_quat(frame.orientations[0, link])
            bone = turn.inv().apply(frame.positions[0, b] - frame.positions[0, a])
            assert unit(bone) == pytest.approx([0, -1, 0], abs=1e-6)


@pytest.mark.parametrize(("facing", "least", "most"), [(0.0, 0.0, 0.0), (180.0, 0.35, 0.55)])
def test_a_kinect_takes_backs_for_fronts(facing, least, most):
    """One camera on the x axis; the person faces it or turns the back to it."""
    rig = {"poses": ((3.5, 0.0, 1.5, -0.5, -0.5, 0.5, 0.5),)}
    scene = {"action": "free_static", "seconds": 120.0, "facing": facing, "cameras": 1, "rig": rig}
    across = [
        frame.positions[0, SLOT["HIP_RIGHT"], 0] - frame.positions[0, SLOT["HIP_LEFT"], 0]
        for frame in perfect(flips=1.0, detector=KINECT, **scene).detections
        if frame.n_people
    ]
    as_if_from_behind = np.mean(np.array(across) > 0)
    exchanged = as_if_from_behind if facing == 0.0 else 1 - as_if_from_behind
    assert least <= exchanged <= most


def test_a_kinect_loses_and_misjudges_who_is_covered():
    scene = {"action": "pass", "people": 2, "seconds": 60.0, "rig": {"apart": 45.0}}
    whole = list(perfect(**scene, detector=KINECT).detections)
    faulty = list(perfect(**scene, detector=KINECT, occlusion=1.0, dropouts=1.0).detections)
    missing = sum(f.n_people for f in whole) - sum(f.n_people for f in faulty)
    assert 0.01 < missing / sum(f.n_people for f in whole) < 0.15
    by_stamp = {(f.source, f.stamp): f for f in whole}
    off = [
        np.linalg.norm(f.positions - by_stamp[f.source, f.stamp].positions, axis=-1).max()
        for f in faulty
        if f.n_people == 2
    ]
    assert np.median(off) == 0.0
    assert np.max(off) > 0.2


def test_velocities_and_accelerations_are_derivatives_of_the_true_motion():
    """Differences over 2 ms of one second of a throw."""
    stamps = _instants()[1] + np.array([-1, 0, 1]) * 1_000_000
    before, now, after = perfect(action="throw").truth_at(stamps)
    step = 0.002
    moved = (after.positions - before.positions) / step
    assert now.markers[..., VELOCITY] == pytest.approx(moved, abs=1e-3)
    change = after.markers[..., VELOCITY] - before.markers[..., VELOCITY]
    assert now.markers[..., ACCELERATION] == pytest.approx(change / step, abs=0.1)
    turned = [Rotation.from_quat(frame.orientations[0]) for frame in (before, after)]
    angular = (turned[1] * turned[0].inv()).as_rotvec() / step
    assert now.links[0, :, ANGULAR_VELOCITY] == pytest.approx(angular, abs=1e-3)
    assert np.abs(angular).max() > 0.5
    change = after.links[0, :, ANGULAR_VELOCITY] - before.links[0, :, ANGULAR_VELOCITY]
    assert now.links[0, :, ANGULAR_ACCELERATION] == pytest.approx(change / step, abs=0.1)


def test_link_noise_has_the_deviation_that_was_asked_for():
    """2 degrees per axis, and nothing else."""
    quiet = {"orientation_coloured": 0.0, "orientation_bias": 0.0, "orientation_white": 2.0,
             "extremities": 1.0, "range_growth": 0.0}  # fmt: skip
    scene = {"action": "free_static", "seconds": 3}
    noisy = perfect(noise=1.0, detector=DetectorParams.model_validate(quiet), **scene)
    errors = [
        (Rotation.from_quat(a.orientations[0]) * Rotation.from_quat(b.orientations[0]).inv())
        for a, b in zip(noisy.detections, perfect(**scene).detections, strict=True)
        if a.n_people and b.n_people
    ]
    degrees = np.degrees(np.stack([error.as_rotvec() for error in errors]))
    assert np.std(degrees) == pytest.approx(2.0, rel=0.05)


def test_a_bad_clock_shifts_what_the_camera_stamps_not_when_it_arrives():
    right, wrong = (perfect(cameras=3, rig=RigParams(clock_offset=s)) for s in (0.0, 0.05))
    for good, bad in zip(right.cameras, wrong.cameras, strict=True):
        (own,) = {int(x) for x in bad.stamped - good.stamped}
        assert own != 0
        assert set(bad.sent - good.sent) == {own}
        assert np.array_equal(bad.logged, good.logged)


def test_published_orientations_are_off_by_the_deviation_in_degrees():
    rig = RigParams(orientation_error=3.0, position_error=0.0)
    cameras = perfect(cameras=32, calibration_error=1.0, rig=rig).cameras
    off = [
        (Rotation.from_quat(c.published.xyzw) * Rotation.from_quat(c.pose.xyzw).inv()).as_rotvec()
        for c in cameras
    ]
    assert np.degrees(np.std(off)) == pytest.approx(3.0, rel=0.2)


def test_noise_has_the_spread_that_was_asked_for():
    quiet = {"coloured": 0.0, "bias": 0.0, "white": 0.01, "extremities": 1.0, "range_growth": 0.0}
    detector = DetectorParams.model_validate(quiet)
    noisy = in_room(perfect(noise=1.0, detector=detector, action="free_static", seconds=3))
    still = in_room(perfect(action="free_static", seconds=3))
    pairs = zip(noisy, still, strict=True)
    error = np.concatenate([(a - b).ravel() for (_, a), (_, b) in pairs if a.shape == b.shape])
    assert np.std(error[~np.isnan(error)]) == pytest.approx(0.01, rel=0.05)


def test_coloured_noise_has_a_deviation_of_one():
    noise = coloured(np.random.default_rng(0), (50_000,), 0.85)
    assert np.std(noise) == pytest.approx(1, abs=0.05)
    assert np.mean(noise[1:] * noise[:-1]) == pytest.approx(0.85, abs=0.05)


def test_episodes_end_with_the_log():
    found = episodes(np.random.default_rng(0), 10, 1.0, (3, 30))
    assert [start for start, _ in found] == list(range(10))
    assert all(start < stop <= 10 for start, stop in found)


@pytest.mark.parametrize(("rate", "correlation"), [(30, 0.85), (15, 0.85**2)])
def test_slow_noise_is_correlated_as_asked(rate, correlation):
    slow = {"coloured": 0.02, "bias": 0.0, "white": 0.0, "correlation": 0.85}
    detector = DetectorParams.model_validate(slow)
    rig = RigParams(rate=rate)
    changes = {"action": "free_static", "seconds": 12, "cameras": 1, "rig": rig}
    noisy = in_room(perfect(noise=1.0, detector=detector, **changes))
    still = in_room(perfect(**changes))
    error = np.stack([a[0] - b[0] for (_, a), (_, b) in zip(noisy, still, strict=True)])
    lagged = np.mean(error[1:] * error[:-1]) / np.mean(error**2)
    assert lagged == pytest.approx(correlation, abs=0.06)


def test_flips_swap_the_sides():
    often = DetectorParams(flips_per_minute=60.0)
    names = perfect().model.marker_names
    left, right = names.index("SHOULDER_LEFT"), names.index("SHOULDER_RIGHT")
    scene = {"people": 1, "action": "circle", "seconds": 4}
    flipped = in_room(perfect(flips=1.0, detector=often, **scene))
    true = in_room(perfect(**scene))
    sides = [
        float(np.dot(a[0, left] - a[0, right], b[0, left] - b[0, right]))
        for (_, a), (_, b) in zip(flipped, true, strict=True)
        if len(a) and len(b)
    ]
    assert min(sides) < 0 < max(sides)


def test_occluded_joints_are_guessed_and_say_so():
    frames = list(perfect(people=3, occlusion=1.0, action="circle", seconds=2).detections)
    confidences = np.concatenate([f.marker_confidences.ravel() for f in frames])
    assert {0.33, 0.66} <= set(np.round(confidences, 2))
    unhidden = np.concatenate(
        [f.marker_confidences.ravel() for f in perfect(people=3, action="circle").detections]
    )
    assert 0.33 not in np.round(unhidden, 2)


def test_frames_are_lost_at_the_rate_that_was_asked_for():
    rig = RigParams(lost_frames=0.3)
    all_frames = len(list(perfect(seconds=4).detections))
    left = len(list(perfect(seconds=4, dropouts=1.0, rig=rig).detections))
    assert left / all_frames == pytest.approx(0.7, abs=0.1)


def test_what_is_written_is_read_back(tmp_path):
    params = SimulateParams(people=2, cameras=3, seconds=1, rig=RigParams(clock_offset=0.05))
    write_log(tmp_path / "log.mcap", params)
    expected = [f for f in simulate(params).detections if f.n_people]
    with open_log(tmp_path / "log.mcap") as log:
        assert len(log.cameras) == 3
        read = [f for f in transform_to_fixed(log.frames(), log.transforms, "world") if f.n_people]
    assert len(read) == len(expected)
    assert log.model == simulate(params).model
    with (tmp_path / "log.mcap").open("rb") as file:
        messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        times = [message.log_time for *_, message in messages]
    assert times == sorted(times)


def _numbers(simulation):
    return [(frame.stamp, frame.markers.tobytes()) for frame in simulation.detections]


@cache
def _with_flaw(flaw=""):
    """Truth, detections and published cameras of two people for 12 s, with one flaw or none."""
    scene = {"people": 2, "cameras": 3, "seconds": 12.0, "seed": 5, "action": "cross", **OFF}
    found = simulate(SimulateParams.model_validate(scene | ({flaw: 3.0} if flaw else {})))
    truth = np.stack([frame.markers for frame in found.truth_at(_instants())])
    cameras = np.concatenate([pose.translation for pose in found.transforms.values()])
    return truth, _numbers(found), cameras


@pytest.mark.parametrize("flaw", OFF)
def test_each_flaw_alone_is_seen_and_changes_nothing_else(flaw):
    """A log with one flaw differs from the faultless one; the people move as before."""
    truths, seen, published = zip(_with_flaw(), _with_flaw(flaw), strict=True)
    assert np.array_equal(*truths, equal_nan=True)
    same = seen[0] == seen[1]
    if flaw == "calibration_error":
        # The cameras stay where they are; what they publish of it is off.
        assert same
        assert 0 < np.abs(published[0] - published[1]).max() < 0.1
    else:
        assert not same
        assert np.array_equal(*published)


def _instants():
    return 1_700_000_000_000_000_000 + np.arange(0, 12, dtype=np.int64) * 1_000_000_000


def test_flips_come_at_the_same_times_with_and_without_noise():
    """Each flaw draws from a stream of its own: switching one leaves the others as they were."""
    scene = {"people": 1, "cameras": 2, "seconds": 20.0, "seed": 9, "action": "circle"}
    times = []
    for noise in (0.0, 1.0):
        params = {**scene, **OFF, "flips": 4.0, "noise": noise}
        simulation = simulate(SimulateParams.model_validate(params))
        left, right = SLOT["SHOULDER_LEFT"], SLOT["SHOULDER_RIGHT"]
        stamps = np.array([frame.stamp for frame in simulation.detections], np.int64)
        truth = simulation.truth_at(stamps)
        poses = {c.name: c.pose for c in simulation.cameras}
        flipped = []
        for frame, known in zip(simulation.detections, truth, strict=True):
            true, pose = known.positions[0], poses[frame.source]
            seen = frame.positions[0] @ _matrix(pose.xyzw).T + pose.translation
            across = (seen[left] - seen[right]) @ (true[left] - true[right])
            flipped.append(bool(across < 0))
        times.append(flipped)
    assert times[0] == times[1]
    assert 5 < sum(times[0]) < len(times[0])
