"""Keypoints of several RGB cameras become skeletons."""

import numpy as np
import pytest

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, from_matrix
from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.rays.keypoints import KeypointFrame, confidence_of, variance_of
from hiros_mcap.rays.triangulator import Triangulator

MODEL = body_model("coco-17")
LENS = Intrinsics((1280, 720), np.array([[900.0, 0, 640], [0, 900.0, 360], [0, 0, 1]]), np.zeros(0))
PERIOD = 1_000_000_000 // 30
HALF = [(0.03, 0.1, 1.68), (0.08, 0.02, 1.66), (0.2, 0.0, 1.4), (0.3, 0.0, 1.12),
        (0.33, 0.15, 0.95), (0.12, 0.0, 0.92), (0.14, 0.05, 0.5), (0.14, -0.02, 0.1)]  # fmt: skip
"""Left eye, ear, shoulder, elbow, wrist, hip, knee and ankle, m."""
BODY = np.array([(0.0, 0.12, 1.64), *[(s * x, y, z) for x, y, z in HALF for s in (-1, 1)]])


def camera(degrees, away=4.0):
    """A camera that looks at the middle of the room."""
    angle = np.radians(degrees)
    place = np.array([away * np.cos(angle), away * np.sin(angle), 1.2])
    z = [-np.cos(angle), -np.sin(angle), 0.0]
    x = np.cross(z, [0.0, 0.0, 1.0])
    return Rigid(from_matrix(np.stack([x, np.cross(z, x), z], axis=1)), place)


def at(k):
    """The body at image ``k``: it walks 1 m/s."""
    return BODY + np.array([k / 30 - 0.3, 0.0, 0.0])


def images(poses, n=20, people=lambda k: [at(k)], shift=lambda c: 0.0, change=None):
    """Images of all cameras, in the order of time; ``shift`` is in periods."""
    frames = []
    for c, pose in enumerate(poses):
        for k in range(n):
            shown = np.array([pose.inverse().moved(p) for p in people(k + shift(c))])
            pixels = LENS.pixels(shown).reshape(-1, 17, 2)
            if change:
                pixels = change(c, k, pixels)
            stamp = round((k + shift(c) + 30) * PERIOD)
            frame = KeypointFrame(f"cam{c}", stamp, stamp, pixels, np.ones(pixels.shape[:2]))
            frames += [(frame, pose)] if pixels is not None else []
    return sorted(frames, key=lambda each: each[0].stamp)


def located(frames, lags=None):
    """Stamps in periods and people of all instants."""
    triangulator = Triangulator(MODEL)
    for name in dict.fromkeys(frame.camera for frame, _ in frames):
        triangulator.add_camera(name, LENS, (lags or {}).get(name, 0.0))
    out = [found for frame, pose in frames for found in triangulator.add(frame, pose)]
    out += triangulator.rest()
    return triangulator, [(each.stamp / PERIOD - 30, each) for each in out]


def error(found, k):
    """Largest error of anybody's joints, m."""
    return np.abs(found.points - at(k)).max()


FOUR = [camera(a) for a in (0, 80, 170, 260)]


def test_a_person_is_where_rays_meet():
    _, out = located(images(FOUR))
    assert [len(found.points) for _, found in out] == [1] * 20  # three cameras prove at once
    assert max(error(found, k) for k, found in out[4:]) < 1e-5


def test_a_wrong_keypoint_of_one_camera_is_outvoted():
    def change(c, k, pixels):
        pixels[:, 9] += 150.0 * (c == 1)
        return pixels

    triangulator, out = located(images(FOUR, change=change))
    assert max(error(found, k) for k, found in out[4:]) < 1e-5
    assert triangulator.people.counts["outvoted"] >= 16


def test_exchanged_sides_of_one_camera_are_mended():
    mirror = [MODEL.marker_names.index(swapped(n)) for n in MODEL.marker_names]

    def change(c, k, pixels):
        return pixels[:, mirror] if c == 2 and k > 8 else pixels

    triangulator, out = located(images(FOUR, change=change))
    assert max(error(found, k) for k, found in out[4:]) < 1e-5
    assert triangulator.people.counts["outvoted"] == 0


def swapped(name):
    other = {"left": "right", "right": "left"}
    side, _, rest = name.partition("_")
    return f"{other[side]}_{rest}" if side in other else name


def test_one_camera_alone_shows_nobody():
    triangulator, out = located(images(FOUR[:1]))
    assert sum(len(found.points) for _, found in out) == 0
    assert triangulator.people.counts["alone"] == 20
    assert "one camera alone" in next(iter(triangulator.remarks()))


def test_two_cameras_side_by_side_do_not_tell_the_place():
    triangulator, out = located(images([camera(0), camera(4)]))
    assert sum(len(found.points) for _, found in out) == 0
    assert triangulator.people.counts["vague"] > 0


def test_cameras_out_of_step_meet_at_common_instants():
    _, out = located(images(FOUR, shift=lambda c: c / 4))
    settled = [(k, found) for k, found in out[6:-2] if len(found.points)]
    assert len(settled) >= 10
    assert np.diff([k for k, _ in settled]) == pytest.approx(1.0, abs=0.3)
    assert max(error(found, k) for k, found in settled) < 2e-3  # of perspective between two images


def test_a_late_clock_is_put_right():
    frames = [
        (frame._replace(stamp=frame.stamp + 5 * PERIOD) if frame.camera == "cam1" else frame, pose)
        for frame, pose in images(FOUR[:2])
    ]
    frames.sort(key=lambda each: each[0].stamp)
    _, out = located(frames, {"cam1": 5 * PERIOD / 1e9})
    assert max(error(found, k) for k, found in out[8:14]) < 1e-5


def test_nothing_is_interpolated_across_a_gap():
    frames = images(FOUR[:2], shift=lambda c: 0.5 * c)
    lost = {("cam1", k) for k in range(8, 11)}
    kept = [(f, p) for f, p in frames if (f.camera, int(f.stamp / PERIOD - 30)) not in lost]
    _, out = located(kept)
    shown = [k for k, found in out if len(found.points)]
    assert any(k < 8 for k in shown)
    assert not [k for k in shown if 8 < k < 11]
    assert any(k > 14 for k in shown)


def test_more_cameras_know_better():
    few, many = (located(images(FOUR[:n]))[1][-1][1].deviations for n in (2, 4))
    assert (many < 0.9 * few).all()


def test_two_people_are_never_one():
    def people(k):
        return [at(k), BODY + np.array([0.3 - k / 30, 0.8, 0.0])]

    _, out = located(images(FOUR, people=people))
    for k, found in out[6:]:
        assert len(found.points) == 2
        for truth in people(k):
            assert min(np.abs(found.points - truth).max(axis=(1, 2))) < 1e-5


def test_two_people_side_by_side_are_not_two_between_them():
    """The rays of one to the other meet nearer to the two cameras, and not as well."""
    aside = np.array([0.4, 0.0, 0.0])
    two = [BODY - aside, BODY * [1.0, 1.0, 1.04] + aside]
    _, out = located(images([camera(67), camera(113)], people=lambda k: two))
    shown = [np.sort(found.points[:, :, 0].mean(axis=1)) for _, found in out[4:]]
    np.testing.assert_allclose(shown, np.tile([-0.4, 0.4], (len(shown), 1)), atol=1e-3)


def test_somebody_twice_in_an_image_is_one():
    triangulator, out = located(images(FOUR, people=lambda k: [at(k), at(k)]))
    assert [len(found.points) for _, found in out[4:]] == [1] * 16
    assert triangulator.doubled == 80


def test_the_confidence_of_a_joint_states_its_variance():
    deviations = np.array([0.0, 0.01, 0.1])
    assert variance_of(confidence_of(deviations)) == pytest.approx(deviations**2, abs=1e-12)
