"""Frames are views of people; blocks hold several of them."""

from dataclasses import replace

import numpy as np
import pytest

from hiros_mcap.frames import Block, Doubts, HeldFrames, join
from hiros_mcap.skeletons import UNTRACKED, Frame, People, SkeletonModel

MODEL = SkeletonModel.of("ab", [("ab", 0, 1)])


def numbered(n, start):
    """A frame of people whose ids and markers count up."""
    frame = Frame.empty(n, MODEL, stamp=start, source="camera", frame_id="map")
    frame.ids[:] = start + np.arange(n)
    frame.markers[:] = frame.ids[:, None, None]
    return frame


def test_the_fields_of_people_are_those_of_the_frame():
    frame = numbered(3, 5)
    assert all(getattr(frame, name) is getattr(frame.people, name) for name in People._fields)


def test_nothing_is_known_of_the_people_of_an_empty_frame():
    frame = Frame.empty(2, MODEL, stamp=7)
    assert (frame.ids.tolist(), frame.stamps.tolist(), frame.log_time) == (
        [UNTRACKED] * 2,
        [7] * 2,
        7,
    )
    assert all(np.isnan(numbers).all() for numbers in frame.people[2:])


def test_replace_changes_fields_of_the_frame_and_of_its_people_and_shares_the_rest():
    frame = numbered(2, 5)
    other = frame.replace(stamp=9, ids=np.array([1, 2], np.int32))
    assert (other.stamp, other.source, other.ids.tolist()) == (9, "camera", [1, 2])
    assert other.markers is frame.markers
    assert frame.ids.tolist() == [5, 6]
    with pytest.raises(TypeError, match="colour"):
        frame.replace(colour=1)


@pytest.mark.parametrize(
    ("rows", "ids"), [([2, 0], [7, 5]), ([], []), ([True, False, True], [5, 7])]
)
def test_selected_people_are_copies(rows, ids):
    frame = numbered(3, 5)
    chosen = frame.select(rows)
    assert chosen.ids.tolist() == ids
    chosen.markers[:] = 0
    assert frame.markers.min() == 5


def test_people_are_reordered_in_every_array_from_a_row_on():
    frame = numbered(4, 5)
    frame.people.reorder(1, [2, 0, 1])
    assert frame.ids.tolist() == [5, 8, 6, 7]
    assert frame.markers[:, 0, 0].tolist() == [5, 8, 6, 7]


def test_joined_frames_keep_their_people_in_this_order():
    blocks = [Block.of(numbered(n, 10 * n)) for n in (2, 0, 3)]
    joined = join([blocks[k] for k in (2, 1, 0, 2)])
    assert joined.rows.tolist() == [[0, 3], [3, 3], [3, 5], [5, 8]]
    assert joined.people.ids.tolist() == [30, 31, 32, 20, 21, 30, 31, 32]
    assert joined.people.markers[:, 1, 4].tolist() == joined.people.ids.tolist()


def test_doubts_go_with_their_people():
    """They are of all rows of a block's arrays, of which its frames may have some."""
    whole = join([Block.of(numbered(n, 10 * n)) for n in (2, 1, 3)])
    variances = np.repeat(whole.people.ids[:, None] * 1.0, 2, axis=1)
    whole = replace(whole, doubts=Doubts(variances, whole.people.ids % 2 == 0))
    joined = join([whole.select([2]), whole.select([1, 0])], np.array([2, 0, 1]))
    assert joined.doubts.variances[:, 1].tolist() == [20, 21, 30, 31, 32, 10]
    assert joined.doubts.distorted.tolist() == [True, False, True, False, True, True]
    assert join([whole, Block.of(numbered(1, 5))]).doubts is None


@pytest.mark.parametrize("width", [7, 19])
def test_held_frames_come_back_with_all_columns(width):
    held, frames = HeldFrames(), [numbered(n, 10 * n) for n in (2, 1, 3)]
    for frame in frames:
        frame.markers[:, :, 3:7] = frame.markers[:, :, 8:] = np.nan
        frame.links[:, :, 1] = 5.0
        slim = [np.ascontiguousarray(each[..., :width]) for each in (frame.markers, frame.links)]
        held.add(Block.of(frame.replace(markers=slim[0], links=slim[1])))
    held.keep([0, 2])
    wide = join([held.take([2, 0])], widths=(19, 19))
    for frame, number in zip(wide.frames(), (2, 0), strict=True):
        expected = frames[number]
        assert frame.ids.tolist() == expected.ids.tolist()
        assert frame.markers.shape == expected.markers.shape
        np.testing.assert_array_equal(frame.markers[..., :width], expected.markers[..., :width])
        np.testing.assert_array_equal(frame.links, expected.links)
        assert np.isnan(frame.markers[..., width:]).all()


def test_joined_people_have_as_many_columns_as_the_widest():
    narrow, wide = (People.allocate(1, 2, 1, *widths) for widths in ((7, 7), (10, 7)))
    blocks = [Block.of(numbered(1, 0).replace(people=people)) for people in (narrow, wide)]
    people = join(blocks).people
    assert (people.markers.shape[2], people.links.shape[2]) == (10, 7)
    assert np.isnan(people.markers[0, :, 7:]).all()


@pytest.mark.parametrize("width", [19, 7])
@pytest.mark.parametrize("others", [0, 1])
def test_a_single_frame_is_copied_with_all_columns(others, width):
    frames = [numbered(2, 10), numbered(2 * others, 20)]
    block = join([Block.of(frame) for frame in frames]).select([0])
    markers = np.ascontiguousarray(block.people.markers[:, :, :width])
    block = replace(block, people=block.people._replace(markers=markers))
    copy = join([block], widths=(19, 19))
    assert copy.people.ids.tolist() == [10, 11]
    assert copy.people.markers.shape == (2, 2, 19)
    np.testing.assert_array_equal(copy.people.markers[:, :, :width], markers[:2])
    for array in copy.people:
        array[:] = 0
    assert markers[:2].min() == 10


def test_held_frames_of_one_block_are_not_copied():
    held, block = HeldFrames(), join([Block.of(numbered(1, start)) for start in (5, 6, 7)])
    held.add(block)
    taken = held.take([2, 0])
    assert taken.people is block.people
    assert [frame.ids.tolist() for frame in taken.frames()] == [[7], [5]]


def test_people_of_whom_no_marker_is_known_can_be_left_out():
    block = join([Block.of(numbered(n, start)) for n, start in ((2, 5), (0, 8), (3, 10))])
    assert block.without_empty() is block
    block.people.markers[[0, 3]] = np.nan
    block.people.markers[4, 0] = np.nan  # of two
    left = block.without_empty()
    assert [frame.ids.tolist() for frame in left.frames()] == [[6], [], [10, 12]]
    assert [frame.stamp for frame in left.frames()] == [5, 8, 10]
    assert np.nanmax(left.frame(2).markers) == 12
