"""Which joints of a view its camera cannot see, and what is known of them all the same.

The model is in the head comment of ``hidden.py``; :func:`mend_hidden` has its steps in that order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import CameraMessages, Doubts
from hiros_mcap.kernels.array_types import B1, F1, F2, F3, I1, I2, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.line_of_sight import OUTLINE, Capsules, outline
from hiros_mcap.kernels.points import geometric_median
from hiros_mcap.skeletons import UNTRACKED, Floats, People
from hiros_mcap.stages.detections.impossible_postures import PostureLimits, doubt_posture
from hiros_mcap.stages.detections.visibility import (
    HONEST,
    INVENTED,
    guess_limit,
    hide_behind,
    learn_rating,
    mean_over_joints,
    rates_joints,
)

_SURELY = 0.9  # of ten joints behind somebody, nine are invented at most: bodies are no capsules
_LEAST = 0.01  # probability below which a joint counts as seen
_SEEN = 0.5  # above which it teaches nothing
_HELD = 0.04  # m; deviation of a remembered joint: of its last sighting, and of the person's motion
_DRIFT = 0.05  # m/s; how fast a pose that stands still is forgotten: people sway and shift weight
_CORRELATED = 0.5  # s; how long a limb keeps its place within the body: half a step
_MOVES = 0.1  # m; deviation of a joint within the body before it is measured
_MEMORY = 3.0  # s; that the measured one is of: three strides
_AGO = 0.15  # s unseen after which the remembered place counts; till then another camera sees it
_RECENT = 300_000_000  # ns; whom a camera's message lacks is where he was, for so long
_LONGEST = 0.5  # s between two views that motion is carried over
_FEWEST = 0.25  # share of joints that show how the person moved
_FOLLOWS = 0.3  # s; of a person of whom fewer are seen, and of the velocity that remains
_UNKNOWN = 1e6  # m2


class HiddenPast(NamedTuple):
    """Where the joints of R people were seen."""

    ids: I1  # (R,) who it is
    stamps: I1  # (R,) of the last view, ns; 0 = never
    poses: F3  # (R, M, 3) m, moved with the person since
    last_seen: I2  # (R, M) when each was seen last, ns; 0 = never
    means: F3  # (R, M, 3) within the body, m
    variances: F2  # (R, M) within the body along each axis, m2
    velocities: F2  # (R, 3) of the person, m/s

    @classmethod
    def empty(cls, n_markers: int) -> HiddenPast:
        """Return arrays with no rows."""
        m = n_markers
        return arrays(cls, 0, 0, (0, m, 3), (0, m), (0, m, 3), (0, m), (0, 3))


class HiddenWork(NamedTuple):
    """How far P views with M markers are hidden; and scratch for these, and for R people."""

    shares: F2  # (P, M) h, then the probability that the joint was invented
    postures: F2  # (P, M) the probability that it is wrong by how the body bends
    hidden: F1  # (P,) mean of h over the joints
    hiders: I1  # (P,) who hides most of them; UNTRACKED = nobody
    outlines: F2  # (P, OUTLINE) of the bodies of a message, seen from its camera
    remembered: F2  # (R, OUTLINE) of what is remembered of people
    in_message: B1  # (R,) whether a message shows them
    rates: B1  # (P,) whether the detector rates joints
    expected: F1  # (M,) h of the remembered joints
    steps: F2  # (M, 3) m
    centre: F1  # (3,) m
    places: F3  # (V, M, 3) m, of the hidden joints of a message's V views; NaN = as measured

    @classmethod
    def of(cls, n_people: int, n_markers: int, n_known: int, n_views: int) -> HiddenWork:
        """Make room for messages with at most so many views; nobody hides anybody yet."""
        p, r, m = n_people, n_known, n_markers
        views = (p, m), (p, m), p, p, (p, OUTLINE)
        work = arrays(cls, *views, (r, OUTLINE), r, p, m, (m, 3), 3, (n_views, m, 3))
        work.hiders.fill(UNTRACKED)
        return work


class HiddenScene(NamedTuple):
    """Arrays that the kernels share."""

    messages: CameraMessages
    people: People  # whose views are mended
    doubts: Doubts  # of the same people
    rows: I1  # (P,) row of each person in what is remembered; -1 = nobody's
    places: F2  # (C, 3) of the cameras, m; NaN = unknown
    ratings: F2  # (C, 3) how each camera's detector rates joints; see :func:`learn_rating`
    capsules: Capsules
    limits: PostureLimits
    guesses: bool  # whether joints are mended that a rating detector guesses
    past: HiddenPast
    work: HiddenWork


@kernel
def _look(i: int, scene: HiddenScene) -> None:
    """Outline the bodies of message ``i``, and those that it lacks but others have just shown."""
    rating = scene.ratings[scene.messages.cameras[i]]
    camera = scene.places[scene.messages.cameras[i]]
    begin, end = scene.messages.spans[i, 0], scene.messages.spans[i, 1]
    scene.work.in_message[:] = False
    for p in range(begin, end):
        row = scene.rows[p]
        if row >= 0:
            scene.work.in_message[row] = True
            outline(scene.people.markers[p], camera, scene.work.outlines[p])
            learn_rating(scene.people.marker_confidences[p], rating)
    for p in range(begin, end):
        scene.work.rates[p] = rates_joints(rating)
    for r in range(len(scene.past.stamps)):
        if (
            scene.messages.stamps[i] - scene.past.stamps[r] <= _RECENT
            and not scene.work.in_message[r]
        ):
            outline(scene.past.poses[r], camera, scene.work.remembered[r])


@kernel
def _cover(points: Floats, p: int, i: int, scene: HiddenScene, shares: Floats) -> int:
    """Write h of points (M, >= 3) of view ``p``; return the id of who hides most of them."""
    messages, past, work = scene.messages, scene.past, scene.work
    camera, capsules = scene.places[messages.cameras[i]], scene.capsules
    shares[:] = 0.0
    largest, hider = 0.0, UNTRACKED
    for q in range(messages.spans[i, 0], messages.spans[i, 1]):
        if q != p and scene.rows[q] >= 0:
            total = hide_behind(
                scene.people.markers[q], work.outlines[q], camera, capsules, points, shares
            )
            if total > largest:
                largest, hider = total, int(scene.people.ids[q])
    for r in range(len(past.stamps)):
        if messages.stamps[i] - past.stamps[r] <= _RECENT and not work.in_message[r]:
            total = hide_behind(past.poses[r], work.remembered[r], camera, capsules, points, shares)
            if total > largest:
                largest, hider = total, int(past.ids[r])
    return hider


@kernel
def _see(p: int, i: int, scene: HiddenScene) -> None:
    """Find out how far joints are hidden or bend wrongly, and the whole view (1, 2).

    A detector that rates its joints tells itself which ones it does not see.
    """
    markers, shares = scene.people.markers[p], scene.work.shares[p]
    if scene.work.rates[p]:
        limit = guess_limit(scene.ratings[scene.messages.cameras[i]])
        for m in range(len(markers)):
            shares[m] = 1.0 if scene.people.marker_confidences[p, m] < limit else 0.0
        return
    if not math.isnan(scene.places[scene.messages.cameras[i], 0]):
        scene.work.hiders[p] = _cover(markers, p, i, scene, shares)
    whole = scene.work.hidden[p] = mean_over_joints(markers, shares)
    doubt_posture(markers, scene.limits, scene.work.postures[p])
    for m in range(len(markers)):
        visible = (1.0 - shares[m]) * (1.0 - whole * whole) * (1.0 - scene.work.postures[p, m])
        shares[m] = 1.0 - visible


@inlined
def _passed(stamp: int, last: int) -> float:
    """Return the time, s, between two views, at most _LONGEST; 0 after none."""
    return min(max(stamp - last, 0) * 1e-9, _LONGEST) if last > 0 else 0.0


@kernel
def _steps(
    view: Floats, shares: Floats, row: int, limit: float, past: HiddenPast, out: Floats
) -> int:
    """Write how far joints with shares below ``limit`` are from where they are remembered.

    Returns their number.
    """
    n = 0
    for m in range(len(view)):
        if not math.isnan(view[m, 0]) and past.last_seen[row, m] > 0 and shares[m] < limit:
            for c in range(3):
                out[n, c] = view[m, c] - past.poses[row, m, c]
            n += 1
    return n


@kernel
def _move(p: int, row: int, passed: float, scene: HiddenScene) -> None:
    """Move what is remembered of a person as the joints did that the view shows (3).

    Where it shows too few, the person goes on, slows down, and follows the hidden joints slowly.
    """
    view, past, work = scene.people.markers[p], scene.past, scene.work
    poses, velocity = past.poses[row], past.velocities[row]
    for m in range(len(view)):
        for c in range(3):
            poses[m, c] += velocity[c] * passed
    there = _steps(view, scene.work.shares[p], row, np.inf, past, work.steps)
    n = _steps(view, scene.work.shares[p], row, _SEEN, past, work.steps)
    enough = n >= _FEWEST * there
    if not enough:
        n = _steps(view, scene.work.shares[p], row, np.inf, past, work.steps)
    if n == 0:
        return
    change = 1.0 - math.exp(-passed / _FOLLOWS)
    gain = 1.0 if enough else change
    geometric_median(work.steps, n, work.centre)
    for c in range(3):
        step = gain * work.centre[c]
        for m in range(len(view)):
            poses[m, c] += step
        if not enough:
            velocity[c] *= 1.0 - change
        elif passed > 1e-4:
            velocity[c] += change * step / passed


@inlined
def _held_variance(age: float, within: float) -> float:
    """Variance s^2 of a remembered joint after ``age`` s; ``within`` the body it has another."""
    wandered = 2.0 * within * (1.0 - math.exp(-age / _CORRELATED))
    return _HELD * _HELD + wandered + (_DRIFT * age) ** 2


@inlined
def _invented(hidden: float, square: float, held: float) -> float:
    """Probability that a place was invented: by h, its squared distance, m2, and s^2."""
    h = _SURELY * hidden
    wide, narrow = INVENTED**2 + held, HONEST**2 + held
    a = h * math.exp(-0.5 * square / wide) / (wide * math.sqrt(wide))
    b = (1.0 - h) * math.exp(-0.5 * square / narrow) / (narrow * math.sqrt(narrow))
    return a / (a + b) if a + b > 0.0 else h


@inlined
def _error(square: float, held: float) -> float:
    """Return e^2, m2: how wrong an invented joint is, by its squared distance from x and s^2."""
    share = INVENTED**2 / (INVENTED**2 + held)  # of the distance that is the error
    return share * share * square / 3.0 + share * held


@kernel
def _weigh(p: int, m: int, row: int, stamp: int, scene: HiddenScene, place: Floats) -> None:
    """Find out whether a joint was invented; write where it must be (4, 5)."""
    past, out, z = scene.past, scene.work, scene.people.markers[p, m]
    x, held, error = past.poses[row, m], _UNKNOWN, INVENTED**2
    if past.last_seen[row, m] > 0:
        age = max(stamp - past.last_seen[row, m], 0) * 1e-9
        held = _held_variance(age, past.variances[row, m])
        expected = scene.work.expected[m] * INVENTED**2 / (INVENTED**2 + held)
        square = (z[0] - x[0]) ** 2 + (z[1] - x[1]) ** 2 + (z[2] - x[2]) ** 2
        out.shares[p, m] = _invented(max(out.shares[p, m], expected), square, held)
        error = _error(square, held)
        # That a joint was there before does not make an impossible posture right.
        out.shares[p, m] = max(out.shares[p, m], _SURELY * out.postures[p, m])
        # What another camera sees now is no second measurement.
        held /= 1.0 - math.exp(-((age / _AGO) ** 2)) + 1e-9
    if out.shares[p, m] <= _LEAST:
        return
    error *= out.shares[p, m]
    scene.doubts.variances[p, m] += error * held / (error + held)
    if out.shares[p, m] >= _SEEN and past.last_seen[row, m] > 0:
        for c in range(3):
            place[c] = z[c] + error / (error + held) * (x[c] - z[c])


@kernel
def _mend(p: int, i: int, scene: HiddenScene, places: Floats) -> None:
    """Do what a view needs once all are seen (3 to 5); write the places (M, 3) of its joints."""
    places[:] = np.nan
    row, camera = scene.rows[p], scene.messages.cameras[i]
    stamp, markers = scene.messages.stamps[i], scene.people.markers[p]
    _move(p, row, _passed(stamp, scene.past.stamps[row]), scene)
    if scene.work.rates[p] and not scene.guesses:
        return
    scene.work.expected[:] = 0.0
    if not scene.work.rates[p] and not math.isnan(scene.places[camera, 0]):
        _cover(scene.past.poses[row], p, i, scene, scene.work.expected)
    for m in range(len(markers)):
        if not math.isnan(markers[m, 0]):
            _weigh(p, m, row, stamp, scene, places[m])


@kernel
def _remember(p: int, stamp: int, scene: HiddenScene) -> None:
    """Remember the joints that the view shows (6)."""
    past, shares, view = scene.past, scene.work.shares[p], scene.people.markers[p]
    row = scene.rows[p]
    for m in range(len(view)):
        first = past.last_seen[row, m] == 0
        if math.isnan(view[m, 0]) or (shares[m] >= _SEEN and not first):
            continue
        gain = 1.0 if first else 1.0 - shares[m]
        for c in range(3):
            past.poses[row, m, c] += gain * (view[m, c] - past.poses[row, m, c])
        if first:
            past.means[row, m, 0] = np.nan
            past.variances[row, m] = _MOVES**2
        past.last_seen[row, m] = max(stamp, past.last_seen[row, m])
    _measure_motion(p, _passed(stamp, past.stamps[row]), scene)
    past.ids[row], past.stamps[row] = scene.people.ids[p], max(stamp, past.stamps[row])


@kernel
def _measure_motion(p: int, passed: float, scene: HiddenScene) -> None:
    """Measure how joints move within the body: running means and variances over _MEMORY."""
    past, row, centre = scene.past, scene.rows[p], scene.work.centre
    _body_centre(past.poses[row], past.last_seen[row], centre)
    share = 1.0 - math.exp(-passed / _MEMORY)
    for m in range(scene.people.markers.shape[1]):
        if math.isnan(scene.people.markers[p, m, 0]) or scene.work.shares[p, m] >= _SEEN:
            continue
        first, square = math.isnan(past.means[row, m, 0]), 0.0
        for c in range(3):
            local = past.poses[row, m, c] - centre[c]
            if first:
                past.means[row, m, c] = local
            off = local - past.means[row, m, c]
            square += off * off / 3.0
            past.means[row, m, c] += share * off
        past.variances[row, m] += share * (square - past.variances[row, m])


@kernel
def _body_centre(pose: Floats, last_seen: Floats, out: Floats) -> None:
    """Write the mean of the joints (M, 3) that were ever seen."""
    out[:] = 0.0
    n = 0
    for m in range(len(pose)):
        if last_seen[m] > 0:
            n += 1
            for c in range(3):
                out[c] += pose[m, c]
    for c in range(3):
        out[c] /= max(n, 1)


@kernel
def _put(view: Floats, places: Floats) -> None:
    """Put markers (M, W) to their places (M, 3); NaN = they stay."""
    for m in range(len(view)):
        if not math.isnan(places[m, 0]):
            for c in range(3):
                view[m, c] = places[m, c]


@entry
def mend_hidden(scene: HiddenScene) -> None:
    """Find the joints that cameras do not see, in messages in the order of time.

    ``scene.people``, ``scene.doubts`` and ``scene.work`` are written; ``scene.past`` and
    ``scene.ratings`` are brought to the last message.
    """
    for i in range(len(scene.messages.stamps)):
        begin, end = scene.messages.spans[i, 0], scene.messages.spans[i, 1]
        _look(i, scene)
        # Three rounds: nothing depends on the order of the people in a message.
        for p in range(begin, end):
            if scene.rows[p] >= 0:
                _see(p, i, scene)
        for p in range(begin, end):
            if scene.rows[p] >= 0:
                _mend(p, i, scene, scene.work.places[p - begin])
        for p in range(begin, end):
            if scene.rows[p] >= 0:
                _remember(p, scene.messages.stamps[i], scene)
                _put(scene.people.markers[p], scene.work.places[p - begin])
