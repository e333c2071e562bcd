"""Joints that detectors invent: no camera can see them, or no body can have them there.

A detector reports a whole person also where somebody stands in front, and is as sure of the hidden
joints as of the others. Geometry tells which these are. For every message, in the order of time:

1. The line of sight from the camera to a joint passes the limbs of others. A joint is hidden by h,
   0 to 1 (:mod:`hiros_mcap.kernels.line_of_sight`). Others are those of the same message, and those
   whom another camera has just shown.
2. A detector that sees a part distorts the rest. With H, the mean of h over the view,
   1 - h' = (1 - h) (1 - H^2). It is also wrong where a body would bend as no body does, whoever
   hides it: there 1 - h' is multiplied by the probability that the posture is right
   (:mod:`~hiros_mcap.stages.detections.impossible_postures`).
3. An invented joint may lie where the camera does see. So every person has a remembered pose: each
   joint where it was seen last, moved with the person by the geometric median of the displacements
   of the joints that are seen now. After t s it is known with the variance

       s^2 = HELD^2 + 2 v (1 - exp(-t / CORRELATED)) + (DRIFT t)^2,

   where v is the joint's own variance within the body so far (the structure function of a
   Gauss-Markov process: who stands keeps the pose, a walker's arm does not). A joint is also hidden
   where this place is, by h I^2 / (I^2 + s^2).
4. The joint was invented, N(0, I^2 + s^2) from the remembered place, a priori with 0.9 h'; or it is
   honest, N(0, HONEST^2 + s^2). p is the posterior probability that it was invented.
5. An invented joint at the distance d is wrong by e^2 = g^2 d^2 / 3 + g s^2 along each axis, with
   g = I^2 / (I^2 + s^2). So the measurement has the variance p e^2 more: what agrees counts nearly
   as before. It is combined with the remembered place, of variance
   s^2 / (1 - exp(-(t / AGO)^2)): what another camera sees now is no second measurement.
6. Joints with p < 0.5 are remembered.

A detector that rates its joints knows what it guesses (Azure Kinect). Cameras whose confidences
vary are believed: h' is 1 for the joints that they guess and 0 for the others.

The fuser adds the variance to that of the measurement; the merger weighs the marker by
HONEST^2 / (HONEST^2 + variance). The fuser takes the guesses of a rating detector as they are:
over time it averages them better than a remembered place does.

The constants stand in ``hidden_joints.py`` and ``visibility.py``. They were set by reasoning and by
one Kinect log, and checked on three others with two people and on simulated logs. A person's own
limbs hide nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from hiros_mcap.body.limb_thickness import capsules_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraNumbers, places_of
from hiros_mcap.skeletons import UNTRACKED, Floats, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections import hidden_joints as kernels
from hiros_mcap.stages.detections.detection_params import PlausibleParams
from hiros_mcap.stages.detections.impossible_postures import limits_of

HIDDEN = "hidden"
"""Kind of the event "somebody stood behind somebody else", and of the count of such joints."""
POSTURE = "impossible posture"
"""Kind of the count of joints that bend as no body does."""
_MOSTLY = 0.5  # share of a view's joints that are hidden while the person is
_PAUSE = 300_000_000  # ns without such a view that end it
_SHORTEST = 100_000_000  # ns; shorter ones are not noted


def mend_hidden_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: PlausibleParams | None = None,
    events: Events | None = None, cameras: Mapping[str, Floats] | None = None, *,
    guesses: bool = True,
) -> Iterator[Block]:  # fmt: skip
    """Lower the weight of joints that a camera does not see; put them where they must be.

    Parameters
    ----------
    blocks : tables of views (:mod:`.views`) in the fixed frame, in the order of time, with right
        sides. They are written into.
    model, params : the skeleton; see :class:`PlausibleParams`.
    events : counts "hidden" (markers), by camera. Notes from when on, by whom and how long somebody
        was hidden from a camera.
    cameras : source -> (3,) position in the fixed frame, m. Without it nothing is hidden from it.
    guesses : whether joints are mended, too, that a detector guesses and says so.

    Yields
    ------
    The same frames at once. Hidden markers are where they must be, with larger variances.
    """
    params = params or PlausibleParams()
    if not params.behind_others:
        yield from blocks
        return
    events = Events() if events is None else events
    people = _HiddenPeople(model, events, cameras or {}, guesses=guesses)
    yield from map(people.mend, blocks)
    people.finish()


class _HiddenPeople:
    """Everybody's remembered pose, and who is hidden."""

    def __init__(
        self, model: SkeletonModel, events: Events, places: Mapping[str, Floats], *, guesses: bool
    ) -> None:
        self._capsules, self._limits = capsules_of(model), limits_of(model)
        self._events, self._places, self._guesses = events, places, guesses
        self._bank = Bank(kernels.HiddenPast.empty(model.n_markers))
        self._cameras = CameraNumbers()
        self._ratings = np.zeros((0, 3))
        self._absent: dict[tuple[int, str], tuple[int, int, int]] = {}
        """Who is hidden from which camera: first and last, ns, and who was in front at first."""

    def mend(self, block: Block) -> Block:
        """Write into a table of views what is known of hidden joints; return it."""
        people, (rows, owners) = block.people, block.everybody()
        known = np.full(len(people.ids), UNTRACKED, np.int64)
        known[rows] = self._bank.rows_of(people.ids[rows], block.stamps[owners])
        messages = self._cameras.messages(block)
        new = len(self._cameras) - len(self._ratings)
        self._ratings = np.pad(self._ratings, ((0, new), (0, 0)))
        n_people, n_markers = people.markers.shape[:2]
        doubts = block.doubt_columns()
        n_views = int(block.sizes.max(initial=0))
        work = kernels.HiddenWork.of(n_people, n_markers, len(self._bank.past.ids), n_views)
        kernels.mend_hidden(kernels.HiddenScene(
            messages, people, doubts, known, places_of(self._cameras, self._places), self._ratings,
            self._capsules, self._limits, self._guesses, self._bank.past, work,
        ))  # fmt: skip
        unrated = ~work.rates[rows]  # what a detector guesses is hidden by nobody
        self._note(block, rows[unrated], owners[unrated], work)
        return replace(block, doubts=doubts)

    def _note(self, block: Block, rows: Stamps, owners: Stamps, work: kernels.HiddenWork) -> None:
        """Count hidden joints, and note who is hidden from whom."""
        invented, bent = work.shares[rows] > 0.5, work.postures[rows] > 0.5
        for kind, markers in ((HIDDEN, invented & ~bent), (POSTURE, invented & bent)):
            counts = markers.sum(axis=1)
            for k in np.flatnonzero(counts).tolist():
                self._events.count(kind, block.source(int(owners[k])), int(counts[k]))
        for k in np.flatnonzero(work.hidden[rows] > _MOSTLY).tolist():
            row, owner = int(rows[k]), int(owners[k])
            source, stamp = block.source(owner), int(block.stamps[owner])
            key = int(block.people.ids[row]), source
            first, last, hider = self._absent.get(key, (stamp, 0, 0))
            if stamp - last > _PAUSE:
                self._end(key)
                first, hider = stamp, int(work.hiders[row])
            self._absent[key] = first, stamp, hider

    def _end(self, key: tuple[int, str]) -> None:
        """Note an absence that is over."""
        first, last, hider = self._absent.pop(key, (0, 0, 0))
        if last - first >= _SHORTEST:
            detail = f"behind person {hider} for {(last - first) * 1e-9:.1f} s"
            self._events.note(first, HIDDEN, person=key[0], source=key[1], detail=detail)

    def finish(self) -> None:
        """Note all absences that are left."""
        for key in list(self._absent):
            self._end(key)
