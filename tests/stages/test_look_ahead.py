import numpy as np
import pytest

from hiros_mcap.frames import Block, join
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.look_ahead import LookAhead

MODEL = SkeletonModel.of(["head"], [])
SECOND = 1_000_000_000


def block_at(*seconds):
    """Frames of one person each, whose id is the time."""
    frames = [Frame.empty(1, MODEL, stamp=round(s * SECOND)) for s in seconds]
    for frame, s in zip(frames, seconds, strict=True):
        frame.ids[:] = round(s)
    return join([Block.of(frame) for frame in frames])


@pytest.mark.parametrize(("seconds", "completing"), [(0, [0, 1, 2]), (1, [1, 2]), (5, [])])
def test_it_says_which_frame_completes_the_look_ahead_of_each(seconds, completing):
    assert LookAhead(seconds).add(block_at(1, 2, 3)).tolist() == completing


def test_frames_of_earlier_blocks_are_completed_by_later_ones():
    ahead = LookAhead(2)
    assert ahead.add(block_at(1, 2)).tolist() == []
    assert ahead.add(block_at(3.5, 4, 4)).tolist() == [0, 1]


def test_the_oldest_frames_go_first_over_the_bounds_of_blocks():
    ahead = LookAhead()
    for block in (block_at(1, 2), block_at(3), block_at(4, 5)):
        ahead.add(block)
    assert ahead.release(4).people.ids.tolist() == [1, 2, 3, 4]
    assert ahead.release(1).people.ids.tolist() == [5]
    assert len(ahead) == 0


def test_what_leaves_is_a_copy():
    ahead, block = LookAhead(), block_at(1, 2)
    ahead.add(block)
    ahead.release(1).people.markers.fill(7.0)
    assert np.isnan(block.people.markers).all()


def test_windows_end_with_the_first_frame_behind_the_look_ahead():
    ahead, ids = LookAhead(2), []
    for block in (block_at(1, 2), block_at(3, 4, 5, 6), block_at(7)):
        ids += [window.people.ids.tolist() for window in ahead.windows(block)]
    assert ids == [[1, 2, 3], [4, 5, 6]]
    assert len(ahead) == 1
