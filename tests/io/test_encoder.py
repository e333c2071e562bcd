"""The encoder: omissions and rounding."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.skeletons import STATE, Frame, SkeletonModel

MODEL = SkeletonModel.of(["HEAD", "NECK"], [("HEAD_LINK", 1, 0)])
DOUBLES = st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.floats(-4.0, 4.0)


def frame_of(value):
    """One person all of whose numbers are ``value``."""
    frame = Frame.empty(1, MODEL, source="cam", frame_id="map")
    for array in (frame.confidences, frame.markers, frame.marker_confidences, frame.links,
                  frame.link_confidences, frame.boxes):  # fmt: skip
        array.fill(value)
    return frame


def written(frame, **options):
    (found,) = Decoder(MODEL, exact=True).decode_message(Encoder(MODEL, **options).encode(frame))
    return found


def rounded(value):
    return float(written(frame_of(value), precision="micrometre").markers[0, 0, 0])


def bits(value):
    (word,) = struct.unpack("<Q", struct.pack("<d", value))
    return int(word)


def double(word):
    (value,) = struct.unpack("<d", struct.pack("<Q", word))
    return float(value)


@settings(deadline=None, max_examples=60)
@given(DOUBLES.filter(lambda x: abs(x) > 1e-300))
def test_rounding_keeps_20_bits_of_the_mantissa_and_takes_the_nearest(value):
    new = rounded(value)
    assert abs(new - value) <= abs(value) * 2.0**-21 or bits(new) == bits(value)
    assert bits(new) & 0xFFFFFFFF == 0 or abs(value) > 1.79e308
    assert rounded(-value) == -new


@settings(deadline=None, max_examples=60)
@given(VALUES)
def test_a_coordinate_in_a_laboratory_moves_by_less_than_a_micrometre(value):
    assert abs(rounded(value) - value) < 1e-6


@settings(deadline=None, max_examples=40)
@given(DOUBLES)
def test_what_was_rounded_is_not_rounded_again(value):
    assert bits(rounded(rounded(value))) == bits(rounded(value))


@settings(deadline=None, max_examples=40)
@given(VALUES, st.floats(0, 1e-6))
def test_rounding_keeps_the_order(value, step):
    assert rounded(value) <= rounded(value + step)


@pytest.mark.parametrize("value", [0.0, 0.5, 0.75, 1.0, -0.0, 3.0])
def test_round_numbers_stay(value):
    assert bits(rounded(value)) == bits(value)


def test_a_tie_goes_away_from_zero():
    one = bits(1.0)
    assert rounded(double(one + (1 << 31) - 1)) == 1.0
    assert rounded(double(one + (1 << 31))) == 1.0 + 2.0**-20
    assert rounded(-double(one + (1 << 31))) == -1.0 - 2.0**-20


@pytest.mark.parametrize(
    "word",
    [
        bits(np.inf), bits(-np.inf), bits(np.finfo(float).max), bits(np.finfo(float).min),
        0x7FF8000000000001, 0xFFF8000000000000, 0x7FFFFFFFFFFFFFFF, 0x7FF80000FFFFFFFF,
    ],
)  # fmt: skip
def test_what_is_not_finite_or_would_not_be_keeps_its_bits(word):
    frame = frame_of(1.0)
    frame.markers[0, 0, :1].view(np.uint64)[0] = word
    new = written(frame, precision="micrometre")
    assert new.markers[0, 0, :1].view(np.uint64)[0] == word


def test_every_number_of_a_message_is_rounded():
    new, there = written(frame_of(0.1), precision="micrometre"), rounded(0.1)
    assert there != 0.1
    for array in (new.confidences, new.markers, new.marker_confidences, new.links,
                  new.link_confidences, new.boxes):  # fmt: skip
        assert np.all(array == there)
    assert (new.ids.tolist(), new.stamps.tolist(), new.source) == ([-1], [0], "cam")


def test_by_default_every_bit_is_written():
    new = written(frame_of(0.1))
    assert np.all(new.markers == 0.1)
    assert np.all(new.boxes == 0.1)


def test_without_derivatives_there_are_poses_and_the_size_of_the_box():
    new = written(frame_of(0.25), derivatives=False)
    for states in (new.markers, new.links, new.boxes[:, None, :STATE]):
        assert np.all(states[..., :7] == 0.25)
        assert np.all(np.isnan(states[..., 7:]))
    assert np.all(new.boxes[:, STATE:] == 0.25)
    assert np.all(new.marker_confidences == 0.25)


@pytest.mark.parametrize("derivatives", [True, False])
def test_a_marker_or_link_with_only_a_confidence_is_written(derivatives):
    frame = Frame.empty(1, MODEL)
    frame.marker_confidences[0, 1] = frame.link_confidences[0, 0] = 0.0
    new = written(frame, derivatives=derivatives)
    assert new.marker_confidences[0].tolist()[1] == 0.0
    assert np.isnan(new.marker_confidences[0, 0])
    assert new.link_confidences[0, 0] == 0.0
    assert count_of_markers(frame, derivatives=derivatives) == 1


@pytest.mark.parametrize("column", range(STATE))
def test_a_marker_is_written_if_any_of_its_written_numbers_is_known(column):
    frame = Frame.empty(1, MODEL)
    frame.markers[0, 1, column] = 1.0
    assert count_of_markers(frame) == 1
    assert count_of_markers(frame, derivatives=False) == (column < 7)


def boxed(*markers, given=np.nan, **options):
    """Box (22,) of a person with these markers."""
    model = SkeletonModel.of([f"m{k}" for k in range(len(markers))], [])
    frame = Frame.empty(1, model, source="cam", frame_id="map")
    frame.positions[0], frame.boxes[:] = np.array(markers), given
    data = Encoder(model, boxes=True, **options).encode(frame)
    return Decoder(model, exact=True).decode_message(data)[0].boxes[0]


NOWHERE = (np.nan, np.nan, np.nan)


def test_the_box_holds_all_markers_that_are_known():
    box = boxed((1, 2, 3), NOWHERE, (0, 4, 3.5), (0.5, 2, 3), (np.nan, 9, 9))
    assert box[:7].tolist() == [0.5, 3, 3.25, 0, 0, 0, 1]
    assert np.isnan(box[7:STATE]).all()
    assert box[STATE:].tolist() == [0.5, 1, 2]  # height z, length x, width y


def test_the_box_of_one_marker_has_no_size():
    assert boxed((1, 2, 3))[[0, 1, 2, 19, 20, 21]].tolist() == [1, 2, 3, 0, 0, 0]


def test_without_markers_the_box_is_as_given():
    assert np.isnan(boxed(NOWHERE)).all()
    assert (boxed(NOWHERE, given=0.25) == 0.25).all()


def test_boxes_of_detectors_give_way_to_those_of_the_markers():
    assert boxed((1, 2, 3), (0, 4, 3.5), given=7.0)[STATE:].tolist() == [0.5, 1, 2]


@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(VALUES, VALUES, VALUES), min_size=1, max_size=6))
def test_every_face_of_the_box_touches_a_marker(markers):
    box, known = boxed(*markers), np.array(markers)
    sizes = box[[20, 21, 19]]
    assert box[:3] - sizes / 2 == pytest.approx(known.min(axis=0), abs=1e-12)
    assert box[:3] + sizes / 2 == pytest.approx(known.max(axis=0), abs=1e-12)
    assert boxed(*markers, precision="micrometre") == pytest.approx(box, abs=2e-6, nan_ok=True)


def count_of_markers(frame, **options):
    """Markers in the message of a frame without links, by its length."""
    empty = len(Encoder(MODEL, **options).encode(Frame.empty(1, MODEL)))
    one = Frame.empty(1, MODEL)
    one.marker_confidences[0, 0] = 1.0
    plain = frame.replace(links=one.links, link_confidences=one.link_confidences)
    size = len(Encoder(MODEL).encode(one)) - empty
    return round((len(Encoder(MODEL, **options).encode(plain)) - empty) / size)
