"""The paper's steps for one message after the other (Hi-ROS 2023, section 3.1.2).

:func:`update` stops where something is left that the numbers alone do not decide: who is new, who
counts, who is who. ``track.py`` decides that, and goes on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import CameraMessages
from hiros_mcap.kernels.array_types import B1, F2, I1, I2, J1, arrays
from hiros_mcap.kernels.assignment import solve
from hiros_mcap.kernels.compile import entry, inlined, kernel, rows_of
from hiros_mcap.kernels.line_of_sight import outline
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import Floats, People, Stamps
from hiros_mcap.stages.detections.visibility import (
    guess_limit,
    hide_behind,
    learn_rating,
    mean_over_joints,
    rates_joints,
)
from hiros_mcap.stages.track.association import (
    MOSTLY_HIDDEN,
    Tracks,
    TrackSettings,
    TrackWork,
    association_cost,
    breaks,
    predict,
)
from hiros_mcap.stages.track.correction import correct
from hiros_mcap.stages.track.likeness import DISPLACED

USABLE, NO_MARKERS, LOW_CONFIDENCE, LEAP, DUPLICATE, COPY = range(6)
"""Why a detection has no track and starts none."""
FAULTS = "", "no markers", "low confidence", "leap", "duplicate", DISPLACED

INSISTENCE = 500_000_000
"""ns for which a camera's leaps are left out, and for which a silent camera still counts."""
AT_ONCE = 100_000_000
"""ns within which cameras show the same moment: two frames of a slow one."""
NEVER, LAST = -(1 << 61), 1 << 61
"""Times, ns, before and after those of all messages."""


class Cameras(NamedTuple):
    """State of C cameras."""

    heard: I1  # (C,) time of the latest message, ns
    due: I1  # (C,) time, ns, from which on a message tells what the camera looks at
    displaced: B1  # (C,) whether the camera is known to show people elsewhere
    faults: I2  # (C, FAULTS) detections that were left out since the last look
    places: F2  # (C, 3) positions, m; NaN = unknown
    ratings: F2  # (C, 3) how each camera's detector rates joints; see ``learn_rating``

    @classmethod
    def allocate(cls, n_cameras: int) -> Cameras:
        """Cameras that have sent nothing."""
        c = n_cameras
        cameras = arrays(cls, c, c, c, (c, len(FAULTS)), (c, 3), (c, 3))
        cameras.heard.fill(NEVER)
        cameras.places.fill(np.nan)
        return cameras


class KnownTracks(NamedTuple):
    """The tracks that there are."""

    persons: I1  # rows of those who count
    tentative: I1  # rows of the others
    ids: J1  # by row
    certain: bool  # whether messages that show them only leave nothing to decide


@inlined
def _leave_out(states: Floats, confidences: Floats, least: float, person: int) -> bool:
    """Make a person's states of too little confidence absent; return whether any is left."""
    is_left = False
    for m in range(states.shape[1]):
        if confidences[person, m] < least:
            for c in range(states.shape[2]):
                states[person, m, c] = np.nan
        is_left = is_left or not math.isnan(states[person, m, 0])
    return is_left


@entry
def screen(people: People, min_marker: float, min_skeleton: float, faults: I1) -> None:
    """Make markers and links of too little confidence absent; fill ``faults`` (P,)."""
    for j in range(len(people.ids)):
        is_left = _leave_out(people.markers, people.marker_confidences, min_marker, j)
        _leave_out(people.links, people.link_confidences, min_marker, j)
        faults[j] = NO_MARKERS
        if is_left:
            faults[j] = LOW_CONFIDENCE if people.confidences[j] < min_skeleton else USABLE


@kernel
def _find_hidden(
    camera: int, people: People, cameras: Cameras, settings: TrackSettings, work: TrackWork
) -> None:
    """Fill ``hidden``: the joints that a camera does not see.

    These are the joints that its detector guesses. A detector that does not rate joints guesses
    those, too, that others in the message hide: of each detection their mean share counts.
    """
    n, place, rating = len(people.ids), cameras.places[camera], cameras.ratings[camera]
    work.hidden[:] = 0.0
    for j in range(n):
        learn_rating(people.marker_confidences[j], rating)
    if not rates_joints(rating) and not math.isnan(place[0]):
        for j in range(n):
            outline(people.markers[j], place, work.outlines[j])
        for j in range(n):
            for k in range(n):
                if k != j:
                    hide_behind(
                        people.markers[k], work.outlines[k], place, settings.capsules,
                        people.markers[j], work.hidden[j],
                    )  # fmt: skip
            work.hidden[j] = mean_over_joints(people.markers[j], work.hidden[j])
    limit = guess_limit(rating)
    for j in range(n):
        for m in range(people.markers.shape[1]):
            if people.marker_confidences[j, m] < limit:
                work.hidden[j, m] = 1.0


@inlined
def _is_sudden(stamp: int, leaps: Stamps) -> bool:
    """Note a camera's leap away from a track; return whether it has not insisted for long."""
    if stamp - leaps[1] > INSISTENCE:
        leaps[0] = stamp
    leaps[1] = stamp
    return stamp - leaps[0] < INSISTENCE


@inlined
def _place_seen(j: int, people: People, work: TrackWork, out: Floats) -> None:
    """Write the mean place (3,), m, of what a detector sees of a person; of all if it sees none."""
    out[:], n = 0.0, 0
    for least in (MOSTLY_HIDDEN, np.inf):
        for m in range(people.markers.shape[1]):
            if work.hidden[j, m] < least and not math.isnan(people.markers[j, m, 0]):
                n += 1
                for c in range(3):
                    out[c] += people.markers[j, m, c]
        if n > 0:
            break
    for c in range(3):
        out[c] /= max(n, 1)


@inlined
def _is_agreed(
    stamp: int, camera: int, leaps: Stamps, places: Floats, settings: TrackSettings
) -> bool:
    """Whether another camera has just shown the same leap, of a track, to the same place."""
    for other in range(len(leaps)):
        at_once = other != camera and abs(stamp - leaps[other, 1]) <= AT_ONCE
        if at_once and point_distance(places[camera], places[other]) <= settings.max_jump:
            return True
    return False


@inlined
def _is_left_out(
    stamp: int, camera: int, j: int, row: int, people: People, tracks: Tracks,
    settings: TrackSettings, work: TrackWork,
) -> bool:  # fmt: skip
    """Note a leap of detection ``j`` away from a track; return whether nothing speaks for it.

    A camera that repeats it for long does, and another one that shows the same at once: what a
    detector distorts, another one sees elsewhere.
    """
    _place_seen(j, people, work, tracks.leapt_to[row, camera])
    is_sudden = _is_sudden(stamp, tracks.leaps[row, camera])
    return is_sudden and not _is_agreed(
        stamp, camera, tracks.leaps[row], tracks.leapt_to[row], settings
    )


@inlined
def _is_wanted(n_people: int, work: TrackWork) -> bool:
    """Find the detections that still want a track; return whether any does."""
    is_wanted = False
    for j in range(n_people):
        work.wanted[j] = work.track_rows[j] < 0 and work.faults[j] == USABLE
        is_wanted = is_wanted or work.wanted[j]
    return is_wanted


@inlined
def _take(
    stamp: int, camera: int, rows: Stamps, leaping: bool, people: People, tracks: Tracks,
    settings: TrackSettings, work: TrackWork,
) -> None:  # fmt: skip
    """Give detections the tracks that match them; leave out those that are ``leaping``."""
    for j in range(len(people.ids)):
        i = work.match[j]
        if i < 0:
            continue
        if (
            leaping
            and breaks(i, j, people, settings, work)
            and _is_left_out(stamp, camera, j, rows[i], people, tracks, settings, work)
        ):
            work.match[j], work.faults[j] = -1, LEAP
        else:
            work.track_rows[j] = rows[i]
            tracks.last_seen[rows[i]] = max(tracks.last_seen[rows[i]], stamp)


@inlined
def _drop_duplicates(persons: Stamps, n_people: int, least: float, work: TrackWork) -> None:
    """Leave out detections on top of a person whom this message already shows."""
    for j in range(n_people):
        if not work.wanted[j] or work.track_rows[j] >= 0 or work.faults[j] != USABLE:
            continue
        for i in range(len(persons)):
            if work.distances[i, j] < least:
                for k in range(n_people):
                    if work.track_rows[k] == persons[i]:
                        work.faults[j] = DUPLICATE


@inlined
def _is_somebody_lost(stamp: int, persons: Stamps, tracks: Tracks, max_gap: float) -> bool:
    """Whether a person was not seen for t_m."""
    for i in range(len(persons)):
        if (stamp - tracks.last_seen[persons[i]]) * 1e-9 > max_gap:
            return True
    return False


@inlined
def _is_open(n_people: int, is_due: bool, work: TrackWork) -> bool:
    """Whether a message leaves something to decide."""
    for j in range(n_people):
        if is_due if work.track_rows[j] >= 0 else work.faults[j] == USABLE:
            return True
    return False


@entry
def update(
    messages: CameraMessages, begin: int, people: People, known: KnownTracks, tracks: Tracks,
    cameras: Cameras, settings: TrackSettings, work: TrackWork,
) -> tuple[int, int]:  # fmt: skip
    """Track messages from ``begin`` on, until one leaves something to decide.

    Writes ids, and velocities where the detector gave none, into ``people``.

    Returns
    -------
    (stop, is_open) : the messages before ``stop`` are done. If ``is_open``, so are the steps for
    ``stop``; its ids are not decided. Otherwise something is to be decided first: who is lost, or
    which detections of a displaced camera are copies. At ``begin`` this is done.
    """
    for k in range(begin, len(messages.stamps)):
        stamp, camera = messages.stamps[k], messages.cameras[k]
        group = rows_of(people, messages.spans[k, 0], messages.spans[k, 1])
        n, displaced = len(group.ids), cameras.displaced[camera]
        if k > begin and (
            displaced or _is_somebody_lost(stamp, known.persons, tracks, settings.max_gap)
        ):
            return k, 0
        since, cameras.heard[camera] = cameras.heard[camera], stamp
        if not displaced:
            least = settings.min_marker_confidence, settings.min_skeleton_confidence
            screen(group, least[0], least[1], work.faults)
        work.track_rows[:n] = -1
        _find_hidden(camera, group, cameras, settings, work)
        for rest in range(2):  # a loop, since twice the code would take twice as long to compile
            if rest:
                _drop_duplicates(known.persons, n, settings.min_distance, work)
            rows = known.tentative if rest else known.persons
            if _is_wanted(n, work) and len(rows):
                # Called from here: each call between would compile them once more.
                predict(stamp, rows, tracks, settings, work)  # eq 7
                association_cost(rows, since, group, tracks, settings, work)  # eq 6 and 8 to 11
                solve(work.cost, len(rows), n, work.assignment, work.match)  # Munkres
                _take(stamp, camera, rows, not rest, group, tracks, settings, work)
                correct(stamp, rows, work, group, tracks, settings)  # Kalman filter
        if not known.certain or _is_open(n, stamp >= cameras.due[camera], work):
            return k, 1
        for j in range(n):
            if work.track_rows[j] >= 0:
                group.ids[j] = known.ids[work.track_rows[j]]
            else:
                cameras.faults[camera, work.faults[j]] += 1
    return len(messages.stamps), 0
