"""A check sees every number of a result that breaks, against full and compact golden logs."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from odd_logs import later
from stick_figures import MODEL, at, person, seen

from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.regression.suite import Golden, check_output, write_golden
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    STATE,
    VELOCITY,
    Frame,
)

FRAMES = 6
Breaks = Callable[[list[Frame]], None]


def full_frame(k):
    """Two people, every number of whom is known."""
    frame = seen([person(0.01 * k), person(2)], at(k), ids=[0, 1], turns=True)
    numbers = np.random.default_rng(k)
    for states in (frame.markers, frame.links, frame.boxes[:, None, :STATE]):
        unknown = np.isnan(states)
        states[unknown] = numbers.uniform(-3, 3, states.shape)[unknown]
        states[..., ORIENTATION] = [0, 0, 0.6, 0.8]
    frame.links[..., POSITION] = numbers.uniform(-3, 3, (2, MODEL.n_links, 3))
    frame.boxes[:, STATE:] = [1.8, 0.4, 0.5]
    for confidences in (frame.confidences, frame.marker_confidences, frame.link_confidences):
        confidences[:] = numbers.uniform(0.2, 1, confidences.shape)
    stamps = frame.stamps - np.array([0, 7_000_000])
    return frame.replace(stamps=stamps, log_time=frame.stamp + 400_000_000)


def write(path, frames):
    with McapWriter(path) as writer:
        channel, encoder = add_skeleton_channel(writer, "/hiros/filtered"), Encoder(MODEL)
        for frame in frames:
            writer.write(channel, frame.log_time, encoder.encode(frame))
        writer.commit()
    return path


@cache
def usual():
    return [full_frame(k) for k in range(FRAMES)]


def frames():
    return [frame.select([0, 1]) for frame in usual()]


@pytest.fixture(scope="module")
def golden_logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden")
    full, compact = write(folder / "full.mcap", frames()), folder / "compact.mcap"
    write_golden(full, compact)
    return {"full": full, "compact": compact}


def check(new, golden, tmp_path):
    out = write(tmp_path / "out.mcap", new)
    result = check_output(out, Golden(golden))
    assert (result.status == "different") == bool(result.differences) == bool(result.first)
    return list(result.differences)


def state(element, columns, change):
    """Break columns of the third frame's second person."""

    def breaks(new):
        part = getattr(new[3], element)[1]
        row = part[..., columns] if element == "boxes" else part[2, columns]
        row[:] = change(row)

    return breaks


def confidence(element, value):
    def breaks(new):
        getattr(new[3], element)[1] = value

    return breaks


def log_time(new):
    new[3] = new[3].replace(log_time=new[3].log_time + 2000)


def source_time(new):
    new[3].stamps[1] += 2000


def shifted(ns):
    def breaks(new):
        new[3] = later(new[3], ns)

    return breaks


def extra_person(new):
    both = seen([person(0.03), person(2), person(5)], at(3), ids=[0, 1, 2])
    arrays = {}
    for name in new[3].people._fields:
        arrays[name] = np.concatenate([getattr(new[3], name), getattr(both, name)[2:]])
    new[3] = new[3].replace(**arrays)


def one_person_less(new):
    new[3] = new[3].select([0])


def swapped_ids(new):
    new[3] = new[3].replace(ids=np.array([1, 0], np.int32))


def all_gone(element, slots):
    """Markers or links that no frame has any more."""

    def breaks(new):
        for frame in new:
            getattr(frame, element)[:, slots] = np.nan
            getattr(frame, f"{element[:-1]}_confidences")[:, slots] = np.nan

    return breaks


COLUMNS = {
    "positions": POSITION,
    "orientations": ORIENTATION,
    "velocities": VELOCITY,
    "angular velocities": ANGULAR_VELOCITY,
    "accelerations": ACCELERATION,
    "angular accelerations": ANGULAR_ACCELERATION,
}


def absent(numbers):
    return np.full_like(numbers, np.nan)


def off(numbers):
    """Out by 1.3 %, or the same rotation about another axis."""
    return numbers[[1, 2, 0, 3]] if len(numbers) == 4 else numbers * 1.013


CASES = {
    **{
        f"{element}: {name} {how.__name__}": (state(element, columns, how), name)
        for element in ("markers", "links", "boxes")
        for name, columns in COLUMNS.items()
        for how in (off, absent)
    },
    "velocities x 100": (state("markers", VELOCITY, lambda v: 100 * v), "velocities"),
    "box sizes": (state("boxes", slice(STATE, None), off), "positions"),
    **{
        f"{element} {value}": (confidence(element, value), "confidences")
        for element in ("confidences", "marker_confidences", "link_confidences")
        for value in (0.0, np.nan)
    },
    "source time": (source_time, "times"),
    "log time": (log_time, "times"),
    "stamp": (shifted(2000), "frames"),
    "dropped frame": (lambda new: new.pop(3), "frames"),
    "extra frame": (lambda new: new.insert(3, later(full_frame(3), -9_000_000)), "frames"),
    "coordinate frame": (
        lambda new: new.append(new.pop().replace(frame_id="map")), "coordinate frame",
    ),
    "extra person": (extra_person, "id 2"),
    "missing person": (one_person_less, "person 1"),
    "ids": (swapped_ids, "identity of person 0"),
    "a marker": (all_gone("markers", slice(2, 3)), "joints"),
    "a link": (all_gone("links", slice(2, 3)), "joints"),
    "all links": (all_gone("links", slice(None)), "joints"),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["full", "compact"])
@pytest.mark.parametrize(("breaks", "what"), CASES.values(), ids=CASES)
def test_what_breaks_is_named(golden_logs, tmp_path, kind, breaks, what):
    new = frames()
    breaks(new)
    assert what in [difference.what for difference in check(new, golden_logs[kind], tmp_path)]


@pytest.mark.parametrize("name", [n for n in CASES if "absent" in n or "nan" in n or "link" in n])
def test_what_the_golden_log_lacks_is_new(tmp_path, name):
    breaks, what = CASES[name]
    old = frames()
    breaks(old)
    write(tmp_path / "old.mcap", old)
    write_golden(tmp_path / "old.mcap", tmp_path / "compact.mcap")
    assert check(old, tmp_path / "compact.mcap", tmp_path) == []
    assert what in [d.what for d in check(frames(), tmp_path / "compact.mcap", tmp_path)]


@pytest.mark.parametrize("kind", ["full", "compact"])
def test_the_same_is_equal(golden_logs, tmp_path, kind):
    assert check(frames(), golden_logs[kind], tmp_path) == []


def test_skeletons_without_any_number_equal_themselves(tmp_path):
    nobody = frames()
    for frame in nobody:
        for element in ("markers", "links", "boxes"):
            getattr(frame, element)[1] = np.nan
    golden = write(tmp_path / "golden.mcap", nobody)
    assert check(nobody, golden, tmp_path) == []


def test_several_people_without_ids_equal_themselves(tmp_path):
    nameless = [f.replace(ids=np.array([-1, -1], np.int32)) for f in frames()]
    golden = write(tmp_path / "golden.mcap", nameless)
    assert check(nameless, golden, tmp_path) == []
