"""The planner: its model against cases by hand and a simulation, its search, its files."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, from_matrix, rotate
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.evaluate.logs import evaluate_log, find_truth
from hiros_mcap.plan import planning
from hiros_mcap.plan.expected_error import MEAN_OF_NORMAL, RIGID, ErrorModel, View
from hiros_mcap.plan.planning import _maps, make_plan
from hiros_mcap.plan.scenes import FloorGrid, make_scenes
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.body_model import MARKERS, SLOT
from hiros_mcap.simulate.cameras import aimed, read_rig, save_rig
from hiros_mcap.simulate.detector import REFERENCE_RANGE
from hiros_mcap.simulate.settings import WALL
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Floats

pytestmark = pytest.mark.usefixtures("coarse_plans")

QUIET = {"coloured": 0.0, "white": 0.0, "bias": 0.0, "guess": 0.0}
AREA = (-2.0, -1.5, 2.0, 1.5)


def camera(x, y, z=1.0):
    """A camera that looks at somebody who stands at the origin."""
    place = np.array([x, y, z])
    return Rigid(from_matrix(aimed(np.array([0.0, 0.0, 1.0]) - place)), place)


def pelvis_error(cameras, **params):
    """Expected error, m, of the pelvis of a person in the middle of the room."""
    settings = SimulateParams.model_validate({"occlusion": 0, "area": (-1, -1, 1, 1), **params})
    model = ErrorModel(settings, [SLOT["PELVIS"]])
    markers, _ = make_scenes(settings, FloorGrid.of(settings.area, 1), 4)
    view, *others = (model.view(markers, pose) for pose in cameras)
    for other in others:
        view = view.plus(other)
    return float(model.errors(view).mean())


def variance(cameras, **params):
    """The part of the squared error that is not motion smoothed away."""
    still = {"detector": QUIET, "calibration_error": 0}
    return pelvis_error(cameras, **params) ** 2 - pelvis_error(cameras, **still) ** 2


FOUR = [camera(*place) for place in ((2.5, 0), (0, 2.5), (-2.5, 0), (0, -2.5))]


def test_a_constant_error_of_poses_is_averaged_over_the_cameras():
    rig = {"position_error": 0.02, "orientation_error": 0.0}
    one, four = (variance(each, detector=QUIET, rig=rig) for each in (FOUR[:1], FOUR))
    assert np.sqrt(one) == pytest.approx(RIGID * MEAN_OF_NORMAL * np.sqrt(3) * 0.02, rel=0.01)
    assert four == pytest.approx(one / 4, rel=0.02)


def test_an_orientation_error_moves_two_of_three_axes_by_the_distance():
    rig = {"position_error": 0.0, "orientation_error": 1.0}
    length = RIGID * MEAN_OF_NORMAL * np.sqrt(2) * np.radians(1.0) * 2.5
    assert np.sqrt(variance(FOUR[:1], detector=QUIET, rig=rig)) == pytest.approx(length, rel=0.02)


def test_the_error_of_the_poses_grows_with_the_calibration_error():
    rig = {"position_error": 0.01, "orientation_error": 0.5}
    one, three = (
        variance(FOUR, detector=QUIET, rig=rig, calibration_error=size) for size in (1, 3)
    )
    assert three == pytest.approx(9 * one, rel=1e-6)


def test_a_lasting_error_stays_and_white_noise_is_smoothed():
    lasting, white = (
        variance(FOUR[:1], calibration_error=0, detector={**QUIET, part: 0.02})
        for part in ("bias", "white")
    )
    assert np.sqrt(lasting) == pytest.approx(RIGID * MEAN_OF_NORMAL * np.sqrt(3) * 0.02, rel=0.03)
    assert white < 0.5 * lasting * (2.5 / REFERENCE_RANGE) ** 2


def test_errors_grow_with_the_noise_and_shrink_with_cameras():
    assert pelvis_error(FOUR, noise=2) > 1.5 * pelvis_error(FOUR, noise=1)
    by_count = [pelvis_error(FOUR[:count]) for count in (1, 2, 3, 4)]
    assert all(fewer > more for fewer, more in pairwise(by_count))


def test_an_error_that_changes_as_slowly_as_a_lasting_one_weighs_as_much():
    """A first-order process of correlation c from frame to frame at 30 Hz."""
    seconds, steady = 2.0, {**QUIET, "range_growth": 0.0}
    coloured = {**steady, "coloured": 0.02, "correlation": float(np.exp(-1 / (30 * seconds)))}
    bias = {**steady, "bias": 0.02, "bias_seconds": seconds}
    one, other = (variance(FOUR[:1], calibration_error=0, detector=d) for d in (coloured, bias))
    assert one == pytest.approx(other, rel=1e-6)


def test_hands_move_ten_times_as_much_as_the_trunk_beyond_what_is_assumed_of_them():
    slots = [SLOT["PELVIS"], SLOT["HAND_LEFT"]]
    model = ErrorModel(SimulateParams(), slots)
    trunk, hand = 1 / model._stiffness
    assumed = model._noise.accelerations
    assert hand / trunk == pytest.approx(np.full(len(hand), 10 * assumed[1] / assumed[0]))


def test_the_floor_is_divided_without_the_strip_along_its_walls():
    floor = FloorGrid.of((1 - WALL, 2 - WALL, 7 + WALL, 5 + WALL), 8)  # 6 m x 3 m in 1.5 m cells
    np.testing.assert_allclose(floor.x, [1.75, 3.25, 4.75, 6.25])
    np.testing.assert_allclose(floor.y, [2.75, 4.25])
    np.testing.assert_allclose(floor.centres[[0, 1, 4]], [[1.75, 2.75], [3.25, 2.75], [1.75, 4.25]])


def test_a_plan_does_not_depend_on_where_the_room_is(monkeypatch):
    monkeypatch.setattr(planning, "_TRIED_CELLS", 4)  # which is quick
    (one,), (other,) = (
        planning.Placing(SimulateParams(area=area), 2.2).place(1)
        for area in ((-2, -1.5, 2, 1.5), (8, 16, 12, 19))
    )
    np.testing.assert_allclose(other.translation - one.translation, [10, 17.5, 0], atol=1e-6)
    np.testing.assert_allclose(other.xyzw, one.xyzw, atol=1e-6)


def test_candidates_stand_along_all_walls_and_look_at_the_middle_or_beside_it(monkeypatch):
    monkeypatch.setattr(planning, "_TRIED_CELLS", 4)
    stands = planning.Placing(SimulateParams(area=(0, 0, 8, 6)), 1.0)._candidates
    np.testing.assert_allclose([s.along for s in stands[::3]], np.arange(28))  # m, one in each
    corner = np.arctan2(3, 4)
    bearings = np.degrees(np.array([s.bearing for s in stands[:3]]) - corner)
    np.testing.assert_allclose(bearings, [0, -25, 25], atol=1e-9)
    np.testing.assert_allclose([s.tilt for s in stands], 0)  # at the height of a body's middle


def test_nobody_is_seen_by_a_camera_that_looks_away():
    away = Rigid(from_matrix(aimed(np.array([1.0, 0.0, 0.0]))), np.array([2.5, 0.0, 1.0]))
    assert np.isnan(pelvis_error([away]))


def test_others_hide_joints():
    def guessed(people):
        params = SimulateParams(people=people, area=AREA)
        markers, _ = make_scenes(params, FloorGrid.of(AREA, 30), 4)
        model = ErrorModel(params)
        return float(np.nanmean(model.errors(model.view(markers, camera(2.0, 1.5, 2.2)))))

    assert guessed(4) > 1.03 * guessed(1)


def test_without_occlusion_nobody_hides_anybody():
    def seen(**settings):
        params = SimulateParams.model_validate({"people": 4, "area": AREA, **settings})
        markers, _ = make_scenes(params, FloorGrid.of(AREA, 30), 4)
        return int(ErrorModel(params).view(markers, camera(2.5, 0.0)).cameras.sum())

    assert seen(occlusion=0) > seen(occlusion=1)


@pytest.mark.parametrize("people", [1, 3])
def test_scenes_hold_people_in_every_cell_at_a_distance(people):
    floor = FloorGrid.of((-3, -2, 3, 2), 40)
    markers, cells = make_scenes(SimulateParams(people=people), floor, 4)
    assert set(cells.ravel()) == set(range(len(floor.centres)))
    places = markers[:, :, SLOT["PELVIS"], :2]
    np.testing.assert_allclose(places, floor.centres[cells], atol=0.05)
    if people > 1:
        gaps = np.linalg.norm(places[:, 0] - places[:, 1], axis=1)
        assert np.mean(gaps > 0.5) > 0.98


@pytest.fixture(scope="module")
def plan(coarse_plans):
    return make_plan(SimulateParams(cameras=3, area=AREA), 2.2)


def test_cameras_hang_on_the_walls_and_look_into_the_room(plan):
    for each in plan.cameras:
        on_x, on_y = abs(abs(each.x) - 2.0) < 1e-9, abs(abs(each.y) - 1.5) < 1e-9
        assert on_x or on_y
        bearing = np.radians(each.bearing_deg)
        assert -each.x * np.cos(bearing) - each.y * np.sin(bearing) > 0
        assert each.height == pytest.approx(2.2)
        assert each.tilt_deg > 0


def test_a_plan_is_better_than_cameras_beside_each_other(plan):
    aside = {f"c{k}": camera(2.0, y, 2.2) for k, y in enumerate((-1.0, 0.0, 1.0))}
    other = make_plan(plan.params, 2.2, aside)
    assert plan.expected.error_mm < 0.95 * other.expected.error_mm
    assert [each.name for each in other.cameras] == list(aside)
    assert [(each.x, each.y) for each in other.cameras] == [(2.0, -1.0), (2.0, 0.0), (2.0, 1.0)]


def test_one_more_camera_helps_and_one_less_does_not(plan):
    expected = plan.expected
    assert plan.further.then.error_mm < expected.error_mm
    assert plan.further.then.three >= expected.three
    for each in plan.cameras:
        assert each.then.error_mm > expected.error_mm
        assert each.then.two <= expected.two
    assert 1 >= expected.one >= expected.two >= expected.three > 0


def test_a_cell_of_the_floor_is_the_mean_of_those_who_are_seen_there_if_only_one():
    floor = SimpleNamespace(x=np.arange(3), y=np.arange(1))
    view = SimpleNamespace(cameras=np.array([2, 1, 3, 0]))
    errors = np.array([[1.0, 3.0], [np.nan, np.nan], [4.0, 6.0], [np.nan, np.nan]])
    found, twice = _maps(floor, np.array([0, 1, 1, 2]), errors, view)
    np.testing.assert_array_equal(found, [[2.0, 5.0, np.nan]])
    np.testing.assert_array_equal(twice, [[1.0, 0.5, 0.0]])


def test_means_of_joints_parts_and_cells_agree(plan):
    assert list(plan.joints_mm) == list(MARKERS)
    assert np.mean(list(plan.joints_mm.values())) == pytest.approx(plan.expected.error_mm)
    parts = plan.parts_mm
    assert parts["torso"] < plan.expected.error_mm < parts["lower limbs"]
    cells: Floats = plan.errors_mm
    assert cells.shape == (len(plan.floor.y), len(plan.floor.x))
    assert np.nanmean(cells) == pytest.approx(plan.expected.error_mm, rel=0.02)


def test_views_add_up_and_take_away(plan):
    markers, _ = make_scenes(plan.params, FloorGrid.of(AREA, 10), 2)
    model = ErrorModel(plan.params)
    first, second = (model.view(markers, each) for each in FOUR[:2])
    back: View = first.plus(second).plus(second, -1)
    np.testing.assert_allclose(back.information, first.information, rtol=1e-9)
    assert (back.cameras == first.cameras).all()


def test_a_planned_room_can_be_simulated(plan, tmp_path):
    path = tmp_path / "cameras.toml"
    save_rig(path, plan.params)
    poses, settings = read_rig(path)
    assert list(poses) == ["camera_0", "camera_1", "camera_2"]
    assert settings["area"] == AREA
    params = SimulateParams.model_validate(settings)
    np.testing.assert_allclose(params.rig.poses, plan.params.rig.poses, atol=1e-4)
    assert read_extrinsics(path).root("camera_1") == "world"


def test_a_log_of_a_planned_room_has_about_the_expected_error(plan, tmp_path):
    """Of a quarter of a minute; docs/planning.md compares minutes in six rooms."""
    log, out = tmp_path / "room.mcap", tmp_path / "out.mcap"
    update = {"action": "roam", "seconds": 15.0, "seed": 7}
    write_log(log, plan.params.model_copy(update=update))
    process(log, out)
    truth = find_truth(log)
    assert truth is not None
    scores = evaluate_log(out, truth, ["/hiros/filtered"])["/hiros/filtered"].scores
    assert scores.mean == pytest.approx(plan.expected.error_mm, rel=0.3)


def test_a_file_without_a_room_has_the_rectangle_of_its_cameras(tmp_path):
    path = tmp_path / "cameras.toml"
    path.write_text(
        "\n".join(
            f'[[camera]]\nframe = "{name}"\ntranslation = [{x}, {y}, 2.0]\n'
            "quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]"
            for name, x, y in (("left", -2.0, 1.0), ("right", 3.0, -1.5))
        )
    )
    poses, settings = read_rig(path)
    assert settings["area"] == (-2.0, -1.5, 3.0, 1.0)
    np.testing.assert_allclose(rotate(poses["left"].xyzw, [0, 0, 1]), [0, 0, 1])


UNDER = """[[camera]]
frame = "a"
translation = [0.0, 0.0, -2.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
"""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("", "--room: is missing"),
        ("--room 6", "--room: should be two numbers around an x, is 6"),
        ("--room 6x0", "--room: should be 1.5 to 40 m wide and deep"),
        ("--room nanx5", "--room: should be two numbers around an x, is nanx5"),
        ("--room 6x5 --cameras 40", "--cameras: should be less than or equal to 32"),
        ("--room 6x5 --cameras 0", "--cameras: should be greater than or equal to 1"),
        ("--room 6x5 --cameras missing.toml", "missing.toml: No such file"),
        ("--room 6x5 --cameras under.toml", "a stands -2.00 m above the floor; z must point up"),
        ("--room 6x5 --cameras ²", "²: No such file or directory"),
        (f"--room 6x5 --cameras {'9' * 5000}", "File name too long"),
        ("--room 6x5 --cameras 2 --range 0.5:inf", "--range: should be two numbers around a colon"),
        ("--room 6x5 --fov 200x60", "--fov: should be less than 180"),
        ("--room 6x5 --range 5:1", "--range: "),
        ("--room 6x5 --people 11", "--people: should be less than or equal to 10"),
        ("--room 6x5 --picture floor.jpg", "floor.jpg: the name of a picture must end in .png"),
        ("--room 6x5 -o under.toml", "under.toml: exists and is not a camera file of hiros"),
    ],
)
def test_what_is_wrong_is_one_line(options, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("under.toml").write_text(UNDER)
    assert run(["plan", *options.split()]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err


def test_the_command_writes_a_file_and_a_picture_and_reads_the_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = "plan --room 2.5x2 --cameras 2 --fov 80x70 -o cameras.toml --picture floor.png"
    written = line.split()
    assert run(written) == 0
    text = capsys.readouterr().out
    assert "2.5 m x 2.0 m, 2 cameras, 1 person: expected error" in text
    assert "one more" in text
    picture = Path("floor.png").read_bytes()
    assert run(written) == 0
    assert Path("floor.png").read_bytes() == picture
    capsys.readouterr()
    assert run(["plan", "--cameras", "cameras.toml", "--joints"]) == 0
    again = capsys.readouterr().out
    assert again.splitlines()[0] == text.splitlines()[0]
    assert "WRIST_LEFT" in again
    simulate = "simulate room.mcap --cameras cameras.toml --action roam --seconds 1 -q"
    assert run(simulate.split()) == 0
    assert run(["process", "room.mcap", "--extrinsics", "cameras.toml", "-q"]) == 0


def test_people_who_roam_walk_through_the_room_but_not_into_walls():
    from hiros_mcap.simulate.actions import ACTIONS
    from hiros_mcap.simulate.body_model import BodyModel

    area = (1.0, -3.0, 6.0, 1.0)
    bodies = [BodyModel.of(1.75)] * 2
    people = ACTIONS["roam"].inside(area).perform(bodies, np.random.default_rng(1))
    t = np.arange(0.0, 120.0, 0.05)
    places = np.stack([person.posture(t).pelvis[:, :2] for person in people])
    inside = (places > np.add(area[:2], WALL - 0.05)) & (
        places < np.subtract(area[2:], WALL - 0.05)
    )
    assert inside.all()
    counts, _, _ = np.histogram2d(*places.reshape(-1, 2).T, bins=4)
    assert counts.min() > counts.mean() / 3
    assert np.linalg.norm(places[0] - places[1], axis=1).min() > 0.5
    speed = np.linalg.norm(np.diff(places, axis=1), axis=2) / 0.05
    assert speed.max() < 2.5
    heading = people[0].posture(t).heading
    step = np.diff(places[0], axis=0)
    ahead = step[:, 0] * np.cos(heading[1:]) + step[:, 1] * np.sin(heading[1:])
    assert np.mean(ahead > 0) > 0.99
