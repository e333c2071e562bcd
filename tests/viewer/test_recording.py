"""Recordings of the viewer: read back and compared with the log."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb
from scipy.stats import chi2

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import evaluate_log, read_channel
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.export.markers import PEOPLE, person_colour
from hiros_mcap.io.log import open_log
from hiros_mcap.io.marker_uncertainty import read_uncertainty
from hiros_mcap.io.result import open_result
from hiros_mcap.regression.suite import write_golden
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.skeletons import Floats
from hiros_viewer import poses as drawn_poses
from hiros_viewer import replay as replaying
from hiros_viewer.blueprint import LAYOUTS, Content, cameras, fitting
from hiros_viewer.columns import LOGGED, TIMELINE, ended
from hiros_viewer.destinations import save
from hiros_viewer.legend import legend
from hiros_viewer.palette import SIDES, faint, shade
from hiros_viewer.poses import HALF_SIZE, Poses
from hiros_viewer.replay import numbered_axis
from hiros_viewer.scene import Scene, magnified
from hiros_viewer.view_check import EarlierPoses

Rows = dict[int, Floats]
BOX = np.array([[[-1.0, -1.0, 0.0], [1.0, 1.0, 1.8]]])
"""Where somebody stands, m."""


@pytest.fixture(scope="module")
def processed(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("view") / "crossing.hiros.mcap"
    process(crossing, out)
    return out


@pytest.fixture(scope="module")
def recording(processed):
    target = processed.with_suffix(".rrd")
    assert run(["view", str(processed), "--save", str(target), "--quiet"]) == 0
    return target


@pytest.fixture(scope="module")
def begin(processed):
    """Time, ns, from which on something is drawn: somebody is in the result."""
    return next(frame.stamp for frame in read_channel(processed, "/hiros/filtered")[0])


def test_a_viewer_shows_two_layouts_of_a_log_side_by_side(processed, recording):
    from rerun.chunk import RrdReader

    other = processed.with_suffix(".stages.rrd")
    for layout in ("stages", "overview"):
        command = ["view", str(processed), "--save", str(other), "--layout", layout, "-q", "-f"]
        assert run(command) == 0
        (first,), (second,) = (RrdReader(str(path)).recordings() for path in (recording, other))
        assert (first.recording_id == second.recording_id) == (layout == "overview")


def chunks(recording, entity=None):
    """Chunks of an entity, or of all, and their tables."""
    import rerun.chunk

    stream = rerun.chunk.RrdReader(str(recording)).stream()
    for chunk in (stream.filter(content=entity) if entity else stream).to_chunks():
        table: Any = chunk.to_record_batch()
        yield chunk, table


def rows(recording, entity, component, timeline="stamp"):
    """Time, ns -> values of a component of an entity."""
    found: Rows = {}
    for _, table in chunks(recording, entity):
        if component not in table.schema.names or timeline not in table.schema.names:
            continue
        stamps = table.column(timeline).cast("int64").to_numpy(zero_copy_only=False)
        for stamp, value in zip(stamps, table.column(component), strict=True):
            found[int(stamp)] = np.array(value.as_py(), float)
    return found


def texts(recording, entity, component="TextLog:text"):
    tables = [table for _, table in chunks(recording, entity)]
    known = [table.column(component) for table in tables if component in table.schema.names]
    return [str(text) for column in known for row in column.to_pylist() for text in row]


def entities(recording):
    return {chunk.entity_path for chunk, _ in chunks(recording)}


@pytest.mark.parametrize("stage", ["tracked", "merged", "optimized", "filtered"])
def test_joints_of_every_stage_are_those_of_the_log(recording, processed, begin, stage):
    frames, _, _ = read_channel(processed, f"/hiros/{stage}")
    for person in (0, 1):
        drawn = rows(recording, f"/{stage}/person_{person}", "Points3D:positions")
        compared = 0
        for frame in frames:
            if person in frame.ids and frame.stamp >= begin:
                true = frame.positions[frame.ids.tolist().index(person)]
                assert np.allclose(drawn[frame.stamp], true, atol=1e-5, equal_nan=True)
                compared += 1
        assert compared > 50


def test_detections_are_drawn_in_the_fixed_frame(recording, processed, begin):
    with open_log(processed) as log:
        moved = transform_to_fixed(log.frames(), log.transforms, log.fixed_frame)
        frames = [frame for frame in moved if frame.stamp >= begin]
    drawn = {
        f"camera_{k}": rows(recording, f"/detections/camera_{k}", "Points3D:positions")
        for k in range(3)
    }
    for frame in frames:
        points = drawn[frame.source][frame.stamp].reshape(-1, 3)
        assert np.allclose(points, frame.positions.reshape(-1, 3), atol=1e-5, equal_nan=True)
    assert len(frames) == sum(len(table) for table in drawn.values()) - 3  # hidden at the end


def test_bones_join_the_joints_that_are_known(processed, tmp_path):
    from hiros_viewer import destinations

    frames, model, _ = read_channel(processed, "/hiros/merged")
    frames = [frame.select(frame.ids == 0) for frame in frames]
    rng = np.random.default_rng(1)
    for frame in frames:
        frame.markers[:, rng.choice(model.n_markers, 5)] = np.nan
    frames[0].markers[:] = np.nan

    def draw(recording):
        scene = Scene(recording, model, final="merged")
        for first in range(0, len(frames), 40):
            some = [Poses.of(frame) for frame in frames[first : first + 40]]
            scene.draw({("merged", ""): Poses.joined(some)})
        scene.finish()

    target = tmp_path / "gaps.rrd"
    destinations.save(target, "gaps", draw)
    ends = model.links[(model.links >= 0).all(axis=1)]
    left = np.array([split_side(model.marker_names[k])[1] == "left" for k in ends[:, 1]])
    for part, chosen in (("bones", ends[~left]), ("left_bones", ends[left])):
        drawn = rows(target, f"/merged/person_0/{part}", "LineStrips3D:strips")
        hidden = 0
        for frame in frames:
            bones = frame.positions[0][chosen]
            known = bones[~np.isnan(bones).any(axis=(1, 2))]
            hidden += len(chosen) - len(known)
            assert np.allclose(drawn[frame.stamp].reshape(-1, 2, 3), known, atol=1e-5)
        assert hidden > len(frames)
    labels = rows(target, "/merged/person_0/name", "Points3D:positions")
    assert [len(labels[frame.stamp]) for frame in frames] == [0, *[1] * (len(frames) - 1)]


def test_bones_of_detections_join_joints_of_one_person(recording, processed, begin):
    drawn = [
        rows(recording, f"/detections/camera_0/{part}", "LineStrips3D:strips")
        for part in ("bones", "left_bones")
    ]
    with open_log(processed) as log:
        frames = list(transform_to_fixed(log.frames(), log.transforms, log.fixed_frame))
        ends = log.model.links[(log.model.links >= 0).all(axis=1)]
    for frame in frames:
        if frame.source == "camera_0" and frame.stamp >= begin:
            bones = frame.positions[:, ends].reshape(-1, 6)
            known = bones[~np.isnan(bones).any(axis=1)]
            found = np.concatenate([part[frame.stamp].reshape(-1, 6) for part in drawn])
            assert np.allclose(np.sort(found, axis=0), np.sort(known, axis=0), atol=1e-5)


def test_left_limbs_have_a_darker_shade_of_the_persons_colour(recording):
    right, left = (
        next(iter(colours(recording, f"/filtered/person_1/{part}").values()))
        for part in ("bones", "left_bones")
    )
    assert right == person_colour(1)
    assert left == shade(right)
    assert contrast(right, left) > 2


def test_left_joints_have_the_darker_shade(recording, processed):
    (context,) = look(recording, "/", "AnnotationContext:context")
    person = next(r["class_description"] for r in context if r["class_id"] == 1)
    joints = {info["label"]: unpacked(info["color"]) for info in person["keypoint_annotations"]}
    assert joints["WRIST_RIGHT"] == joints["PELVIS"] == person_colour(1)
    assert joints["WRIST_LEFT"] == shade(person_colour(1))


def colours(recording, entity):
    """Time, ns -> colour of bones from then on."""
    (context,) = look(recording, "/", "AnnotationContext:context")
    classes = {row["class_id"]: row["class_description"]["info"] for row in context}
    changes = rows(recording, entity, "LineStrips3D:class_ids")
    return {t: unpacked(classes[int(c[0])]["color"]) for t, c in sorted(changes.items())}


def test_every_colour_of_a_person_has_a_distinct_shade():
    for colour in PEOPLE:
        room = (24, 27, 31)
        assert contrast(colour, shade(colour)) > 2
        assert contrast(shade(colour), room) > 1.5
        assert contrast(colour, faint(colour)) > 1.2
        assert contrast(faint(colour), room) > 1.5
    assert not set(SIDES.values()) & set(PEOPLE)
    assert contrast(SIDES["right"], SIDES["left"]) > 1.2


MACHADO = {
    "all cones": np.eye(3),
    "no red cones": np.array(
        [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]]
    ),
    "no green cones": np.array(
        [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]]
    ),
}
"""Linear RGB of the eyes without a kind of cones (Machado 2009)."""


@pytest.mark.parametrize("eyes", MACHADO)
@pytest.mark.parametrize(("people", "apart", "sides"), [(4, 15, 14), (6, 12, 14), (10, 11, 8)])
def test_people_differ_also_to_colour_blind_eyes(eyes, people, apart, sides):
    rights = lab(PEOPLE[:people], MACHADO[eyes])
    lefts = lab([shade(colour) for colour in PEOPLE[:people]], MACHADO[eyes])
    for one, other in itertools.permutations(range(people), 2):
        assert ciede2000(rights[one], rights[other]) > apart
        assert ciede2000(lefts[one], rights[other]) > sides


def test_ciede2000_has_the_values_of_its_paper():
    """Sharma 2005, table 1."""
    assert ciede2000([50, 2.6772, -79.7751], [50, 0, -82.7485]) == pytest.approx(2.0425, abs=1e-4)
    assert ciede2000([50, 2.5, 0], [50, 0, -2.5]) == pytest.approx(4.3065, abs=1e-4)


def lab(colours, eyes):
    """CIE L*a*b* of sRGB colours, as these eyes see them."""
    part = np.array(colours) / 255
    linear = np.where(part > 0.04045, ((part + 0.055) / 1.055) ** 2.4, part / 12.92)
    to_xyz = [[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]]
    xyz = np.clip(linear @ eyes.T, 0, 1) @ np.transpose(to_xyz) / np.sum(to_xyz, axis=1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116).T
    return np.transpose([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def ciede2000(one, other):
    """Difference of two colours, L*a*b* (Sharma 2005, eqs. 2 to 22)."""
    (l_1, a_1, b_1), (l_2, a_2, b_2) = one, other
    grey = 1.5 - 0.5 * _seventh((np.hypot(a_1, b_1) + np.hypot(a_2, b_2)) / 2)
    c_1, c_2 = np.hypot(grey * a_1, b_1), np.hypot(grey * a_2, b_2)
    h_1, h_2 = np.arctan2(b_1, grey * a_1), np.arctan2(b_2, grey * a_2)
    turn = (h_2 - h_1 + np.pi) % (2 * np.pi) - np.pi
    middle, c, h = (l_1 + l_2) / 2, (c_1 + c_2) / 2, np.degrees(h_1 + turn / 2) % 360
    terms = {1: (-0.17, -30), 2: (0.24, 0), 3: (0.32, 6), 4: (-0.2, -63)}
    t = 1 + sum(k * np.cos(np.radians(n * h + shift)) for n, (k, shift) in terms.items())
    light = (l_2 - l_1) / (1 + 0.015 * (middle - 50) ** 2 / np.sqrt(20 + (middle - 50) ** 2))
    chroma = (c_2 - c_1) / (1 + 0.045 * c)
    hue = 2 * np.sqrt(c_1 * c_2) * np.sin(turn / 2) / (1 + 0.015 * c * t)
    rotation = -2 * _seventh(c) * np.sin(np.radians(60 * np.exp(-(((h - 275) / 25) ** 2))))
    return np.sqrt(light**2 + chroma**2 + hue**2 + rotation * chroma * hue)


def _seventh(chroma):
    return np.sqrt(chroma**7 / (chroma**7 + 25.0**7))


def contrast(a, b):
    """Ratio of luminances, which everybody sees, by WCAG 2.1."""
    bright, dark = sorted((luminance(a), luminance(b)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)


def luminance(colour):
    linear = (np.array(colour) / 255) ** 2.2
    return float(linear @ [0.2126, 0.7152, 0.0722])


def unpacked(colour):
    return colour >> 24, colour >> 16 & 255, colour >> 8 & 255


def look(recording, entity, component):
    """Return a component that was logged once for all times."""
    for _, table in chunks(recording, entity):
        if component in table.schema.names and "stamp" not in table.schema.names:
            return list(table.column(component)[0].as_py())
    raise AssertionError(f"{entity} has no {component}")


def test_detections_are_thinner_than_the_result(recording):
    thin = look(recording, "/detections/camera_0/bones", "LineStrips3D:radii")
    strong = look(recording, "/filtered/person_0/bones", "LineStrips3D:radii")
    assert thin == look(recording, "/merged/person_0/bones", "LineStrips3D:radii")
    assert thin[0] < 0 < strong[0]  # points on the screen, metres in the room


def test_curves_tell_left_from_right_by_colour_and_width(recording):
    path = "/angles/person_0/knee_flexion"
    assert look(recording, path, "SeriesLines:names") == [
        "left knee flexion", "right knee flexion"]  # fmt: skip
    colours = [unpacked(c) for c in look(recording, path, "SeriesLines:colors")]
    assert colours == [SIDES["left"], SIDES["right"]]
    left, right = look(recording, path, "SeriesLines:widths")
    assert right > left


def test_people_and_cameras_go_by_their_names(recording):
    assert set(texts(recording, "/filtered/person_1/name", "Points3D:labels")) == {"person 1"}
    assert look(recording, "/person_1", "StateConfiguration:labels") == ["person 1", "gone"]
    for camera in ("camera_0", "camera_1", "camera_2"):
        path = f"/world/cameras/{camera}/name"
        assert look(recording, path, "Points3D:labels") == [camera]


@pytest.mark.parametrize(
    ("ahead", "height", "target"), [((0, 0, 0, 1), -0.3, 3.0), ((1, 0, 0, 0), 0.0, 5.0)]
)
def test_a_camera_is_shown_from_its_own_pose(ahead, height, target):
    """From a little behind it along its z axis, or at the people if they are behind that."""
    pose = Rigid(np.array(ahead, float), np.array([1.0, 2.0, 0.0]))
    box = np.array([[[0.0, 1.0, 4.0], [2.0, 3.0, 6.0]]])
    content = Content(["filtered"], [0], ["left"], box, {"left": pose})
    layout: Any = cameras(content)
    grid = layout.contents[0]
    eye = grid.contents[0].properties["EyeControls3D"]
    assert np.allclose(eye.position.as_arrow_array().to_pylist(), [[1.0, 2.0, height]])
    (looked_at,) = eye.look_target.as_arrow_array().to_pylist()
    assert np.allclose(looked_at, [1.0, 2.0, target])


def test_a_camera_beside_the_eye_does_not_hide_the_picture():
    places = {"left": [0.0, 0.0, 0.0], "beside": [0.3, 0.0, 0.0], "far": [3.0, 0.0, 0.0]}
    poses = {name: Rigid(np.array([0, 0, 0, 1.0]), np.array(p)) for name, p in places.items()}
    box = np.array([[[-1.0, -1.0, 2.0], [1.0, 1.0, 4.0]]])
    content = Content(["filtered"], [0], list(places), box, poses)
    layout: Any = cameras(content)
    grid = layout.contents[0]
    shown = grid.contents[0].contents
    for name, hidden in (("left", "**"), ("beside", "**"), ("far", "name")):
        assert f"- /world/cameras/{name}/{hidden}" in shown


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("layout", ["overview", "stages"])
def test_everybody_fills_the_first_view(layout, seed):
    """From the feet to the head, wherever people walk and cameras stand."""
    rng = np.random.default_rng(seed)
    low = rng.uniform([-4, -4, 0], [0, 0, 0.2], (50, 3))
    boxes = np.stack([low, low + rng.uniform([0.3, 0.3, 1.5], [0.8, 0.8, 2.0])], axis=1)
    places = [np.array([*rng.uniform(-6, 6, 2), rng.uniform(0, 3)]) for _ in range(seed)]
    poses = {f"c{k}": Rigid(np.array([0, 0, 0, 1.0]), place) for k, place in enumerate(places)}
    shown = in_view(layout, Content(["merged", "filtered"], [0], list(poses), boxes, poses))
    corners = np.concatenate([[*itertools.product(*box.T)] for box in boxes])
    inside = np.abs(shown(corners)).max(axis=1)
    assert (inside < 1).mean() > 0.9  # a few walk out of where people nearly always are
    assert inside.max() > 0.95 / 1.4


def test_a_camera_near_the_eye_is_not_drawn():
    poses = {"a": Rigid(np.array([0, 0, 0, 1.0]), np.array([-8.0, 0.0, 1.0]))}
    for _ in range(2):
        room: Any = LAYOUTS["stages"](Content(["merged", "filtered"], [0], list(poses), BOX, poses))
        room = room.contents[0]
        hidden = [f"- /world/cameras/{name}/**" in room.contents for name in poses]
        assert hidden == [name == "near" for name in poses]
        (eye,) = room.properties["EyeControls3D"].position.as_arrow_array().to_pylist()
        place = 0.9 * np.array(eye) + 0.1 * np.array([0.0, 0.0, 0.9])
        poses["near"] = Rigid(np.array([0, 0, 0, 1.0]), place)
        poses["a"] = Rigid(
            np.array([0, 0, 0, 1.0]), np.array([-8.0, 0.0, 1.0]) - np.array([*eye[:2], 0])
        )


def test_a_camera_near_the_eye_is_drawn_if_it_is_not_before_the_people():
    boxes = np.array([[[1.4, -0.8, 0.0], [3.4, 1.4, 1.7]]])
    places = {"a": np.array([0.0, 0.0, 1.0]), "b": np.array([0.7, -1.7, 1.0])}
    poses = {name: Rigid(np.array([0, 0, 0, 1.0]), place) for name, place in places.items()}
    shown = in_view("overview", Content(["filtered"], [0], list(poses), boxes, poses))
    assert (np.abs(shown(np.array([*places.values()]))) < 1).all()
    for stages in (["filtered"], []):
        room: Any = LAYOUTS["overview"](Content(stages, [0], list(poses), boxes, poses)).contents[0]
        room = room.contents[0] if stages else room
        assert not [line for line in room.contents if line.startswith("- /world/cameras")]


def test_what_is_below_the_room_grows_with_its_lanes():
    heights = []
    for n in (1, 4, 50):
        lanes = {f"/person_{k}": "person" for k in range(n)}
        layout: Any = LAYOUTS["overview"](Content(["filtered"], range(n), [], BOX, lanes=lanes))
        heights.append(layout.row_shares[1] / sum(layout.row_shares))
    assert 0.06 * 5 > heights[1] > 40 * 4 / 833 > heights[0]  # 40 of 833 pixels each
    assert heights[2] < 0.4


@pytest.mark.parametrize(("n", "are_drawn"), [(12, True), (40, False)])
def test_detections_of_many_cameras_do_not_cover_the_result(n, are_drawn):
    content = Content(["filtered"], [0], [f"c{k}" for k in range(n)], BOX)
    room: Any = LAYOUTS["overview"](content).contents[0].contents[0]
    assert ("+ /detections/c1/**" in room.contents) is are_drawn
    assert ("Thin lines" in legend(content, "overview")) is are_drawn
    own: Any = cameras(content).contents[0].contents[1]
    assert "+ /detections/c1/**" in own.contents
    assert "Thin lines" in legend(content, "cameras")


@pytest.mark.parametrize(("n", "has_legend"), [(2, True), (9, False)])
def test_few_cameras_are_named_beside_their_curves(n, has_legend):
    content = Content(["filtered"], [0], [f"c{k}" for k in range(n)], BOX)
    below: Any = cameras(content).contents[-1]
    (view,) = [v for v in below.contents if v.name == "Distance to the result, mm"]
    legend = view.properties["PlotLegend"].visible.as_arrow_array().to_pylist()
    assert legend == [has_legend]


@pytest.mark.parametrize(("away", "is_seen"), [(1.0, True), (9.0, False)])
def test_cameras_are_in_the_first_view_unless_people_would_be_small(away, is_seen):
    places = [np.array([away, side, 1.5]) for side in (-away, away)]
    poses = {f"c{k}": Rigid(np.array([0, 0, 0, 1.0]), place) for k, place in enumerate(places)}
    shown = in_view("overview", Content(["filtered"], [0], list(poses), BOX, poses))
    assert bool((np.abs(shown(np.array(places))) < 1).all()) is is_seen


def in_view(layout, content):
    """Return where points (N, 3), m, are in the view: 1 is a border, inf behind the eye."""
    room = LAYOUTS[layout](content).contents[0]
    room = room.contents[0] if layout == "overview" else room
    eye = room.properties["EyeControls3D"]
    (place,), (target,) = (
        np.array(each.as_arrow_array().to_pylist()) for each in (eye.position, eye.look_target)
    )
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    width = {"overview": 832 / 533, "stages": 728 / 733}[layout]  # in a window of 1600 x 900
    half = np.tan(np.radians(55 / 2)) * np.array([width, 1.0])

    def shown(points):
        depth = (points - place) @ ahead
        across = (points - place) @ np.stack([right, np.cross(right, ahead)], axis=1)
        return np.where(depth[:, None] > 0, across / np.abs(depth[:, None]) / half, np.inf)

    return shown


@pytest.mark.parametrize(
    "high", [0.0, 0.004, 0.31, 1.0, 1.36, 2.0, 3.0, 3.4, 7.0, 18.0, 36.0, 95.0]
)
def test_an_axis_has_two_numbers_with_room_between_them(high):
    """The viewer writes multiples of a power of ten that are 21 pixels apart."""
    low, top = numbered_axis(high)
    assert low < 0
    assert top > high
    pixels = [80 * 10.0**k / (top - low) for k in range(-4, 4) if 10.0**k < top]
    assert any(each > 21 for each in pixels)


def test_somebody_who_is_predicted_is_faint(processed, tmp_path):
    from hiros_viewer import destinations

    frames, model, _ = read_channel(processed, "/hiros/filtered")
    hidden = frames[50:70]
    for frame in hidden:
        frame.marker_confidences[frame.ids == 1] = 0.05

    def draw(recording):
        scene = Scene(recording, model)
        scene.begin({})
        for first in range(0, len(frames), 40):
            some = [Poses.of(frame) for frame in frames[first : first + 40]]
            scene.draw({("filtered", ""): Poses.joined(some)})
        scene.finish()

    target = tmp_path / "hidden.rrd"
    destinations.save(target, "hidden", draw)
    own = person_colour(1)
    for part, tone in (("bones", tuple), ("left_bones", shade)):
        changes = colours(target, f"/filtered/person_1/{part}")
        shown = [list(changes.values())[sum(t <= f.stamp for t in changes) - 1] for f in frames]
        expected = [tone(faint(own) if 50 <= k < 70 else own) for k in range(len(frames))]
        assert shown == expected
    assert set(colours(target, "/filtered/person_0/bones").values()) == {person_colour(0)}
    labels = texts(target, "/filtered/person_1/name", "Points3D:labels")
    assert set(labels) == {"person 1", "person 1, predicted"}


def test_who_is_faint_is_who_counts_as_predicted(processed):
    """The summary counts by the person's confidence, the viewer by that of the joints."""
    frames, _, _ = read_channel(processed, "/hiros/filtered")
    for k, frame in enumerate(frames):
        means = np.nanmean(frame.marker_confidences, axis=1)
        assert np.allclose(frame.confidences, means, atol=1e-6)
        frame.confidences[:] = LEAST_CONFIDENCE + (0.01 if k % 2 else -0.01)
        frame.marker_confidences[:] *= (frame.confidences / means)[:, None]
        assert (Poses.of(frame).is_predicted == (frame.confidences < LEAST_CONFIDENCE)).all()


def test_time_without_data_is_named(whole_crossing, processed, tmp_path):
    """The cameras are silent for 2 s, and for 0.5 s, which is none."""
    gap, target = tmp_path / "gap.mcap", tmp_path / "gap.rrd"
    with open_log(whole_crossing) as log, McapWriter(gap) as writer:
        start = log.span[0]
        topics = [camera.channel.topic for camera in log.cameras]
        channels = {topic: add_skeleton_channel(writer, topic) for topic in topics}
        encoder = Encoder(log.model)
        for frame in log.frames():
            since = (frame.stamp - start) / 1e9
            if not (1.0 < since < 3.0 or 4.0 < since < 4.5):
                channel = channels[f"/{frame.source}/skeletons"]
                writer.write(channel, frame.log_time, encoder.encode(frame.replace(frame_id="a")))
        writer.commit()
    assert run(["view", str(gap), "--save", str(target), "-q"]) == 0
    (line,) = texts(target, "/log")
    assert line.startswith("no data: for 2.0")
    assert texts(target, "/no_data", "StateChange:state") == ["no data", "gone"]
    shown = [len(rows) for rows in rows(target, "/world/no_data", "Points3D:positions").values()]
    assert shown == [1, 0]


def test_seconds_count_from_the_logs_start(recording, processed):
    with open_log(processed) as log:
        start = log.span[0]
    for path, component in (
        ("/filtered/person_0", "Points3D:positions"),
        ("/speed/person_0", "Scalars:scalars"),
    ):
        seconds = rows(recording, path, component, TIMELINE)
        assert list(seconds) == [s - start for s in rows(recording, path, component)]


def test_displacements_lead_five_times_as_far_as_joints_moved(recording, processed):
    merged = {f.stamp: f for f in read_channel(processed, "/hiros/merged")[0]}
    drawn = rows(recording, "/displacement/merged/person_0", "LineStrips3D:strips")
    moved = rows(recording, "/moved/merged/person_0", "Scalars:scalars")
    frames = read_channel(processed, "/hiros/filtered")[0]
    assert len(moved) > 50
    for frame in frames:
        after = frame.positions[frame.ids.tolist().index(0)]
        before = merged[frame.stamp].positions[merged[frame.stamp].ids.tolist().index(0)]
        lines = np.stack([after, after + 5 * (before - after)], axis=1)
        lines = lines[~np.isnan(lines).any(axis=(1, 2))]
        stays = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) < 0.5  # in the view
        assert stays.sum() > 28
        assert np.allclose(drawn[frame.stamp][stays], lines[stays], atol=1e-4)
        apart = np.linalg.norm(before - after, axis=1)
        assert np.isclose(moved[frame.stamp][0], 1000 * np.nanmean(apart))


def test_displacements_do_not_depend_on_the_size_of_batches():
    """A result may come much later than the stage before it."""
    earlier, whole = EarlierPoses(), EarlierPoses()
    stamps, poses = np.arange(9, dtype=np.int64), np.random.default_rng(1).normal(size=(9, 4, 3))
    whole.add(stamps, poses)
    earlier.add(stamps[:6], poses[:6])
    first = earlier.at(stamps[:2], 4)
    earlier.add(stamps[6:], poses[6:])
    found = np.concatenate([first, earlier.at(stamps[2:], 4)])
    assert np.array_equal(found, whole.at(stamps, 4))
    assert np.array_equal(found, poses)
    assert np.isnan(earlier.at(np.array([20, 21]), 4)).all()


def test_labels_stand_above_the_head(recording):
    joints = rows(recording, "/merged/person_1", "Points3D:positions")
    labels = rows(recording, "/merged/person_1/name", "Points3D:positions")
    for stamp, label in labels.items():
        if len(label):
            middle = np.nanmean(joints[stamp][:, :2], axis=0)
            top = np.nanmax(joints[stamp][:, 2]) + 0.18
            assert np.allclose(label[0], [*middle, top], atol=1e-5)


def test_residuals_are_those_of_the_frame_nearest_in_time(recording, processed):
    """From the first second on, though the last stage is logged seconds later."""
    filtered, _, _ = read_channel(processed, "/hiros/filtered")
    stamps = np.array([frame.stamp for frame in filtered])
    with open_log(processed) as log:
        moved = transform_to_fixed(log.frames(), log.transforms, log.fixed_frame)
        seen = [frame for frame in moved if frame.source == "camera_0" and frame.n_people]
        detections = [frame for frame in seen if frame.stamp >= filtered[0].stamp]
    drawn = rows(recording, "/residual/camera_0", "Scalars:scalars")
    assert len(drawn) == len(detections)
    for frame in detections:
        people = filtered[int(np.abs(stamps - frame.stamp).argmin())].positions
        apart = np.linalg.norm(frame.positions[:, None] - people[None], axis=-1)
        mean = np.nanmean(apart, axis=-1).min(axis=1)
        assert np.allclose(drawn[frame.stamp], 1000 * mean[mean < 1].mean())


def test_residual_is_the_distance_to_the_nearest_person():
    from hiros_mcap.kernels.distance import nearest

    rng = np.random.default_rng(1)
    poses, others = rng.normal(size=(4, 9, 3)), rng.normal(size=(3, 9, 3))
    poses[0, :4] = others[1, 7] = np.nan
    poses[3] = np.nan
    rows = np.array([[0, 3], [1, 3], [2, 2], [0, 3]])
    found = np.empty(4)
    nearest(poses, others, rows, found)
    for pose, (begin, end), distance in zip(poses[:2], rows[:2], found, strict=False):
        each = [np.nanmean(np.linalg.norm(pose - o, axis=-1)) for o in others[begin:end]]
        assert np.isclose(distance, min(each))
    assert np.isinf(found[2:]).all()


def test_curves_are_angles_and_people(recording, processed):
    frames, _, _ = read_channel(processed, "/hiros/filtered")
    motion = replace(open_result(processed).motions[0], orientations=None, axes={})
    by_markers = replace(open_result(processed), motions={0: motion}).angles()
    for joint in ("shoulder", "elbow", "hip", "knee"):
        angles = rows(recording, f"/angles/person_0/{joint}_flexion", "Scalars:scalars")
        assert list(angles) == [frame.stamp for frame in frames]
        expected = by_markers[[f"{side} {joint} flexion" for side in ("left", "right")]].to_numpy()
        assert np.allclose(np.stack(list(angles.values())), expected, atol=1e-5, equal_nan=True)
    people = np.stack(list(rows(recording, "/people/camera_0", "Scalars:scalars").values()))
    assert set(people.ravel()) <= {0.0, 1.0, 2.0}


def test_a_curve_ends_before_a_pause_and_begins_anew():
    times = np.array([[0, 3], [100, 103], [5000, 5003]]) * 1_000_000
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    for parts in ([3], [2, 1], [1, 1, 1]):
        ends = np.cumsum(parts)[:-1]
        rows, last = [], None
        for when, some in zip(np.split(times, ends), np.split(values, ends), strict=True):
            rows.append(ended(when, some, last))
            last = when[-1]
        drawn, shown = (np.concatenate(column) for column in zip(*rows, strict=True))
        assert drawn.tolist() == [*times[:2].tolist(), (times[1] + 1).tolist(), times[2].tolist()]
        np.testing.assert_array_equal(shown, np.insert(values, 2, np.nan, axis=0))


def test_who_is_there_for_longest_is_seen_first(processed):
    import rerun as rr

    frames, model, _ = read_channel(processed, "/hiros/filtered")
    scene = Scene(rr.RecordingStream("test"), model)
    for k, person in enumerate([4, 4, 7, 7, 7]):
        frame = frames[k]
        one = frame.replace(ids=np.array([person] + [-1] * (frame.n_people - 1), np.int32))
        scene.draw({("filtered", ""): Poses.of(one)})
    assert scene.longest == 7


def test_ellipsoids_hold_the_stated_deviations(crossing, tmp_path):
    result, target = tmp_path / "fused.mcap", tmp_path / "fused.rrd"
    process(crossing, result, options=ProcessOptions(system="fuse"))
    assert run(["view", str(result), "--uncertainty", "--save", str(target), "-q"]) == 0
    told, frames = read_uncertainty(result), read_channel(result, "/hiros/filtered")[0]
    sizes = rows(target, "/uncertainty/person_1", "Ellipsoids3D:half_sizes")
    centers = rows(target, "/uncertainty/person_1", "Ellipsoids3D:centers")
    for frame in frames:
        row = frame.ids.tolist().index(1)
        deviations = np.array(list(told[frame.stamp, 1].values()))
        known = ~np.isnan(deviations)
        assert known.any()
        half = np.tile(HALF_SIZE * deviations[known][:, None], 3)
        assert np.allclose(sizes[frame.stamp], half, rtol=1e-6)
        assert np.allclose(centers[frame.stamp], frame.positions[row][known], atol=1e-5)
    assert len(sizes[max(sizes)]) == 0  # hidden with the person
    assert chi2.cdf(HALF_SIZE**2, 3) == pytest.approx(0.68, abs=1e-4)


def test_ellipsoids_are_drawn_on_request_alone(crossing, recording, tmp_path, capsys):
    assert not any(path.startswith("/uncertainty") for path in entities(recording))
    plain = tmp_path / "plain.mcap"
    process(crossing, plain, options=ProcessOptions(system="hiros"))
    arguments = ["view", str(plain), "--uncertainty", "--save", str(tmp_path / "a.rrd")]
    assert run(arguments) == 2
    assert "does not say how well its markers are known" in capsys.readouterr().err


def test_the_tree(recording):
    found = entities(recording)
    for path in (
        "/world/cameras/camera_2/view", "/merged/person_1/left_bones", "/filtered/person_0/trail",
        "/filtered/person_0/name",
        "/truth/person_0", "/person_0", "/log", "/residual/camera_1", "/speed/person_1",
    ):  # fmt: skip
        assert path in found


def test_a_time_range_has_its_results_though_they_were_logged_much_later(processed, tmp_path):
    """A system may wait until it knows limbs; nobody may be there meanwhile."""
    late, target = tmp_path / "late.mcap", tmp_path / "late.rrd"
    with (
        open_log(processed, topics=["*"], output_prefix="/none") as log,
        McapWriter(late) as writer,
    ):
        topics = {c.channel.topic: add_skeleton_channel(writer, c.channel.topic)
                  for c in log.cameras}  # fmt: skip
        encoder, start = Encoder(log.model), log.span[0]
        for names, block in log.read():
            for topic, frame in zip(names, block.frames(), strict=True):
                later = 60_000_000_000 * topic.startswith("/hiros/")
                if later or frame.stamp < start + 1_200_000_000:
                    writer.write(topics[topic], frame.log_time + later, encoder.encode(frame))
        writer.commit()
    arguments = ["view", str(late), "--time-range", "1:2", "--save", str(target), "-q"]
    assert run(arguments) == 0
    stamps = sorted(rows(target, "/filtered/person_0", "Points3D:positions"))
    assert len(stamps) > 25
    assert start + 1_000_000_000 <= stamps[0] < stamps[-2] <= start + 2_000_000_000


LIMITED = """
import resource, sys
from hiros_cli.app import run
resource.setrlimit(resource.RLIMIT_FSIZE, 2 * (int(sys.argv[3]),))
sys.exit(run(["view", sys.argv[1], "--save", sys.argv[2], "-q"]))
"""


@pytest.mark.parametrize("limit", ["0", "300000"])
def test_a_recording_beyond_a_limit_of_size_is_one_error_and_no_file(limit, processed, tmp_path):
    target = tmp_path / "out.rrd"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, processed, target, limit],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert done.stderr == f"hiros: error: {target}: cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_ours_while_a_recording_is_drawn_is_not_said_of_the_disk(tmp_path):
    def draw(recording):
        raise RuntimeError("ours")

    with pytest.raises(RuntimeError, match="ours"):
        save(tmp_path / "out.rrd", "log", draw)
    assert list(tmp_path.iterdir()) == []


def test_two_logs_are_overlaid_with_their_distance(crossing, processed, tmp_path):
    from hiros_mcap.config import load_config

    other, target = tmp_path / "other.mcap", tmp_path / "both.rrd"
    process(crossing, other, config=load_config(None, ["filter.cutoff=8"]))
    assert run(["view", str(processed), str(other), "--save", str(target), "-q"]) == 0
    assert {"/a/filtered/person_0", "/b/filtered/person_0"} <= entities(target)
    mean = np.concatenate(list(rows(target, "/distance/mean", "Scalars:scalars").values()))
    assert len(mean) == 60
    ours, theirs = (read_channel(p, "/hiros/filtered")[0] for p in (processed, other))
    expected = [
        1000 * np.nanmean(np.linalg.norm(a.positions - b.positions, axis=-1))
        for a, b in zip(ours, theirs, strict=True)
    ]
    assert np.allclose(mean, expected)
    key = texts(target, "/key", "TextDocument:text")[-1]
    assert texts(target, "/b/filtered/person_0/name", "Points3D:labels") == ["B 0"]
    first, second, *_ = key.splitlines()  # what is cut off is at the end
    assert first.strip() == f"**A** is orange: {processed.name}."
    assert second.strip() == "**B** is blue: other.mcap."
    path = "angles/person_1/knee_flexion"
    (a, b) = (
        [unpacked(c) for c in look(target, f"/{log}/{path}", "SeriesLines:colors")] for log in "ab"
    )
    assert a == [shade(person_colour(0)), person_colour(0)]
    assert b == [shade(person_colour(1)), person_colour(1)]


def test_a_recording_is_read_with_the_settings_beside_it(crossing, tmp_path, capsys):
    """A detector that writes millimetres, as hiros.toml says: everybody is 1000 times as small."""
    log = tmp_path / "log.mcap"
    log.write_bytes(crossing.read_bytes())

    def bone():
        target = tmp_path / "log.rrd"
        assert run(["view", str(log), "--save", str(target), "-q"]) == 0
        strips = next(
            iter(rows(target, "/detections/camera_0/bones", "LineStrips3D:strips").values())
        )
        return np.linalg.norm(np.diff(strips[0], axis=0))

    before = bone()
    (tmp_path / "hiros.toml").write_text("[input]\nunit = 'mm'\n", encoding="utf-8")
    assert bone() == pytest.approx(before / 1000, rel=1e-2)
    assert f"parameters of {tmp_path / 'hiros.toml'}" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["overview", "cameras", "stages"])
def test_the_legend_names_what_the_layout_shows(layout):
    plain = Content(["merged", "filtered"], [0], ["camera_0"], BOX)
    words = legend(plain, layout)
    for absent in ("White", "Red", "Faint", "Ellipsoids", "frusta"):
        assert absent not in words
    assert ("Yellow" in words) == (layout == "stages")
    assert ("curves" in words.split("Point")[0]) == (layout == "overview")
    full = replace(plain, shows_truth=True, has_predicted=True)
    words = legend(full, layout)
    assert "**Faint**" in words
    has_truth = layout == "overview"
    assert ("**White**: the truth" in words) == ("the way to the truth" in words) == has_truth
    assert ("Thin lines" in words) == (layout == "cameras")


def rooms_of(container):
    """Return the 3D views of a layout."""
    if isinstance(container, rrb.Spatial3DView):
        return [container]
    return [room for part in getattr(container, "contents", ()) for room in rooms_of(part)]


@pytest.mark.parametrize("layout", ["overview", "cameras", "stages"])
def test_nothing_covers_a_result_beside_its_truth(layout):
    """Five cameras' detections and two stages' displacements hid who is who."""
    content = Content(["merged", "filtered"], [0], ["c"], BOX, shows_truth=True)
    (room,) = rooms_of(LAYOUTS[layout](content))
    shown = " ".join(room.contents)
    assert ("+ /truth/**" in shown or "/error_lines" in shown) == (layout == "overview")
    assert ("/detections/" in shown) == (layout == "cameras")


def test_a_layout_without_anything_to_show_is_the_overview():
    for layout in LAYOUTS:
        assert fitting(Content(["filtered"], [], [], BOX), layout) == "overview"
        assert fitting(Content(["merged", "filtered"], [0], ["c"], BOX), layout) == layout
    recording = Content([], [], ["c"], BOX)
    assert "Each camera" not in legend(recording, "stages")
    assert "Each camera has its colour" in legend(replace(recording, cameras=["c", "d"]), "stages")


def test_two_logs_are_overlaid_as_their_cameras_see_them(processed, tmp_path):
    target = tmp_path / "both.rrd"
    files = [str(processed), str(processed)]
    assert run(["view", *files, "--layout", "cameras", "--save", str(target), "-q"]) == 0


def test_a_stage_that_changes_nothing_has_no_curves():
    content = Content(
        ["tracked", "merged", "optimized", "filtered"], [0], [], BOX, moved={"merged"}
    )
    names = [view.name for view in LAYOUTS["stages"](content).contents[1].contents]
    assert [name for name in names if name.startswith("Joints")] == [
        "Joints, merged to filtered: mean mm"
    ]


def test_long_displacements_stay_in_the_view():
    ways = np.array([[0.01, 0.0, 0.0], [0.0, 0.3, 0.0], [np.nan, 0.0, 0.0]])
    assert np.allclose(magnified(ways), [[0.05, 0, 0], [0, 0.5, 0], [np.nan] * 3], equal_nan=True)


@pytest.mark.parametrize("stage", [[], ["--stage", "merged"]])
def test_a_result_is_overlaid_with_a_truth_and_its_error(crossing, tmp_path, stage):
    result, truth = tmp_path / "result.mcap", tmp_path / "truth.mcap"
    process(crossing, result, options=ProcessOptions(keep=()))
    cut_to_truth(crossing, truth)
    scores = evaluate_log(result, load_truth(truth), [f"/hiros/{stage[1]}"] if stage else [])
    expected = list(scores.values())[-1].scores.mean
    target = tmp_path / "both.rrd"
    for arguments in (
        [str(result), str(truth)],
        [str(truth), str(result)],
        [str(result), "--truth", str(truth)],
    ):
        assert run(["view", *arguments, *stage, "--save", str(target), "-q"]) == 0
        errors = [rows(target, f"/error/person_{p}", "Scalars:scalars") for p in (0, 1)]
        mean = np.concatenate([value for person in errors for value in person.values()])
        assert np.mean(mean) == pytest.approx(expected, rel=0.02)
        assert {"/truth/person_0", "/error_lines/person_1"} <= entities(target)
        name = f"/{stage[1] if stage else 'filtered'}/person_0/name"
        both = {f"person 0 = truth {k}" for k in (0, 1)}
        assert both & {*texts(target, name, "Points3D:labels")}
        own = rows(target, "/truth/person_0/name", "Points3D:positions")
        assert not any(map(len, own.values()))  # beside the name of the result, or not at all


def test_two_results_are_each_compared_with_a_truth(crossing, processed, tmp_path):
    truth, target = tmp_path / "truth.mcap", tmp_path / "both.rrd"
    cut_to_truth(crossing, truth)
    arguments = [str(processed), str(processed), "--truth", str(truth)]
    assert run(["view", *arguments, "--save", str(target), "-q"]) == 0
    assert {"/a/error/person_0", "/b/error/person_0", "/a/truth/person_0"} <= entities(target)
    assert "/b/truth/person_0" not in entities(target)


def test_a_truth_of_another_time_is_refused(processed, tmp_path, capsys):
    truth = tmp_path / "truth.csv"
    lines = [f"{100 + k / 30},0,PELVIS,0,0,1" for k in range(30)]
    truth.write_text("\n".join(["time,person,marker,x,y,z", *lines]))
    arguments = ["view", str(processed), "--truth", str(truth)]
    assert run([*arguments, "--save", str(tmp_path / "a.rrd")]) == 2
    assert "covers no frame of the result" in capsys.readouterr().err
    assert not (tmp_path / "a.rrd").exists()


def cut_to_truth(log, target):
    """Write the truth of a log to a file of its own, without some of its markers."""
    frames, model, _ = read_channel(log, "/truth/skeletons")
    with McapWriter(target) as writer:
        channel, encoder = add_skeleton_channel(writer, "/truth/skeletons"), Encoder(model)
        for frame in frames:
            markers = frame.markers.copy()
            markers[:, :3] = np.nan
            unknown = np.full_like(frame.marker_confidences, np.nan)
            cut = frame.replace(markers=markers, marker_confidences=unknown)
            writer.write(channel, frame.log_time, encoder.encode(cut))
        writer.commit()


def test_logs_without_a_common_stage_are_refused_in_one_line(crossing, processed, tmp_path, capsys):
    tracks, merged = tmp_path / "tracks.mcap", tmp_path / "merged.mcap"
    process(crossing, tracks, options=ProcessOptions(keep=(), stages="T"))
    write_golden(processed, merged, ["/hiros/merged"])
    assert run(["view", str(tracks), str(merged), "--save", str(tmp_path / "a.rrd")]) == 2
    assert "do not both hold a stage" in capsys.readouterr().err


def test_frames_are_drawn_many_at_a_time_and_in_their_own_order(processed, monkeypatch):
    """So memory stays bounded, and rerun is called seldom."""
    for name, value in (("BATCH", 30), ("_FIRST_BATCH", 30), ("HORIZON_NS", 1_000_000_000)):
        monkeypatch.setattr(drawn_poses, name, value)
    newest = dict[object, int]()
    sizes = []
    with open_log(processed, topics=["*"], output_prefix="/none") as log:
        for frames in replaying.in_time_order(log):
            sizes.append(sum(map(len, frames.values())))
            for channel, poses in frames.items():
                assert poses.stamps[0] >= newest.get(channel, 0)
                assert (np.diff(poses.stamps) >= 0).all()
                newest[channel] = int(poses.stamps[-1])
        whole = log.read()
        assert sum(1 for _ in whole.frames()) == sum(sizes)
    assert len(sizes) > 2
    assert max(sizes[:-1]) < 450


def test_a_recording_does_not_depend_on_how_many_frames_are_drawn_at_once(
    processed, recording, tmp_path, monkeypatch
):
    monkeypatch.setattr(drawn_poses, "BATCH", 30)
    monkeypatch.setattr(drawn_poses, "HORIZON_NS", 1_000_000_000)
    target = tmp_path / "small.rrd"
    assert run(["view", str(processed), "--save", str(target), "-q"]) == 0
    assert entities(target) == entities(recording)
    for path, component in (
        ("/filtered/person_0", "Points3D:positions"),
        ("/tracked/person_1/bones", "LineStrips3D:strips"),
        ("/detections/camera_1", "Points3D:positions"),
        ("/angles/person_0/knee_flexion", "Scalars:scalars"),
        ("/displacement/merged/person_0", "LineStrips3D:strips"),
        ("/residual/camera_2", "Scalars:scalars"),
        ("/speed/person_1", "Scalars:scalars"),
    ):
        for timeline in ("stamp", LOGGED):
            whole = rows(recording, path, component, timeline)
            parts = rows(target, path, component, timeline)
            assert whole.keys() == parts.keys()
            for time, value in whole.items():
                np.testing.assert_allclose(value, parts[time], atol=1e-6)


def test_log_times_are_those_of_the_messages(recording, processed):
    frames = read_channel(processed, "/hiros/filtered")[0]
    shown = rows(recording, "/filtered/person_0", "Points3D:positions", LOGGED)
    assert {frame.log_time for frame in frames} == set(list(shown)[:-1])
    angles = rows(recording, "/angles/person_0/knee_flexion", "Scalars:scalars", LOGGED)
    assert {frame.log_time for frame in frames} == set(angles)


def test_a_long_log_is_drawn_with_fewer_frames(processed, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(replaying, "LONG_S", 1.2)
    monkeypatch.setattr(replaying, "WHOLE_S", 1.2)
    monkeypatch.setattr(replaying, "MOST_FRAMES", 20)
    target = tmp_path / "long.rrd"
    assert run(["view", str(processed), "--save", str(target), "-q"]) == 0
    stamps = sorted(rows(target, "/filtered/person_0", "Points3D:positions"))
    assert 0.09e9 < np.median(np.diff(stamps)) < 0.11e9
    whole = rows(recording, "/filtered/person_0", "Points3D:positions")
    assert set(stamps[:-1]) <= set(whole)  # the last row hides the person
    assert "/merged/person_0" not in entities(target)
    part = ["view", str(processed), "--time-range", "1:2", "--save", str(target), "-q", "-f"]
    assert run(part) == 0
    stamps = sorted(rows(target, "/filtered/person_0", "Points3D:positions"))
    assert np.median(np.diff(stamps)) < 0.04e9


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["{log}", "--layout", "sideways"], "no layout 'sideways'"),
        (["{log}", "--time-range", "5"], "not of the form START:END"),
        (["{log}", "--time-range", "7:6"], "ends before it starts"),
        (["{log}", "--time-range", "100:200"], "no skeletons in this time range"),
        (["{log}", "--stage", "cooked"], "no stage 'cooked'"),
        (["{log}", "{log}", "{log}"], "at most two logs"),
        (["{log}", "--web"], "use only one of"),
    ],
)
def test_faults_are_one_line_and_leave_no_file(processed, tmp_path, capsys, arguments, fault):
    given = [a.format(log=processed) for a in arguments]
    assert run(["view", *given, "--save", str(tmp_path / "a.rrd")]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_recording_of_the_viewer_says_who_opens_it(processed, tmp_path, capsys):
    drawn = tmp_path / "drawn.rrd"
    assert run(["view", str(processed), "--save", str(drawn), "-q"]) == 0
    assert run(["view", str(drawn), "--save", str(tmp_path / "a.rrd")]) == 2
    assert f"but a Rerun recording; open it with: rerun {drawn}\n" in capsys.readouterr().err


def test_nothing_listens_where_it_should_connect():
    from hiros_viewer.destinations import connect, free_port

    with pytest.raises(ConfigError, match="no viewer at"):
        connect(f"rerun+http://127.0.0.1:{free_port()}/proxy", "x", lambda recording: None)
    with pytest.raises(ConfigError, match="not of the form"):
        connect("http://127.0.0.1", "x", lambda recording: None)


def test_a_golden_log_is_overlaid_at_the_same_time(processed, tmp_path):
    """Golden logs hold no recording: their log times begin later than their stamps."""
    from hiros_mcap.regression.suite import write_golden

    golden, target = tmp_path / "golden.mcap", tmp_path / "both.rrd"
    write_golden(processed, golden)
    arguments = [str(processed), str(golden), "--stage", "filtered", "--time-range", "0:1"]
    assert run(["view", *arguments, "--save", str(target), "-q"]) == 0
    assert {"/a/filtered/person_0", "/b/filtered/person_0"} <= entities(target)
