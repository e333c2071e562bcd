"""Who is it that comes back? Cues weighed by probability, with the right to decline.

Each newcomer is one of the people who are absent, or a stranger. The model, with its numbers below:

- Limb lengths: their logarithms follow Student's t. Those of an absent person lie about what was
  measured before, with the covariance of the measurement. Those of a stranger lie about the mean of
  all absent people, with that of adults' stature and proportions as well; the two sides of a body
  are alike. There is one density of strangers: with one about each absent person, what tells two
  absent people apart would cancel. A detector misplaces markers for some seconds, by another
  amount from each side. How far, and which limbs gain what others lose, shows everybody who is
  tracked: their limbs change from second to second (:class:`LimbScatter`). A share of it lasts.
  So the longer both were seen, the more the limbs tell.
- Place and time: a person who left is somewhere about the place where he was lost, on the floor,
  normal with an SD that grows with the time to that of a room. Or he stands there still, if he
  stood before or could not go. A stranger may be anywhere in the room.
- Number of people: whoever comes while somebody is missing, as whom nobody who is there may have
  come back, is probably one of the missing. Who is missing since a moment ago, or since all cameras
  paused, did not leave: it is nearly certain.

All ways to give several newcomers the absent people's ids are weighed together, so two people who
left and came back are told apart by each other. Every choice of as many absent people is equally
probable at first.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.skeletons import Flags, Floats, Ints

_THRESHOLD = 0.9  # least probability with which somebody gets an old id
_EXCHANGED = 0.02  # largest probability of being another absent person: worse than a new id
_HARDLY_EXCHANGED = 0.001
"""The same while more evidence is to come: who looks often errs more often, and limbs are wrong for
as long as somebody walks the same way."""

_NOISE_OF_ONE = 0.04  # SD of a limb's length, m, in one detection; it falls with the root of their
# number, besides the scatter from second to second
_FREEDOM = 10.0  # of Student's t: Kinect v2's limbs, measured on nine recordings, have such tails
_STATURE, _PROPORTION = 0.055, 0.04  # SD of the logarithm among adults
_SHORT = 0.15  # m: shorter limbs are too noisy
_FEWEST_LENGTHS = 5.0  # detections that make a limb's length worth comparing
_PLACE, _WALK, _ROOM = 0.4, 0.7, 2.5  # SD of the place, m: at once, more per s, at most
_TOP_SPEED = 4.0  # m/s on the floor; nobody comes back faster
_REACH = 0.6  # m, besides
OVERLAP = 800_000_000  # ns for which two tracks of a person may run side by side
_SURE_IF_MISSING, _SURE_IF_COMPLETE = 0.95, 0.5  # that a newcomer was there before
_SURE_IF_UNWATCHED = 0.998  # the same if cameras watched for fewer s than it takes to go
_SOMEBODY = 0.5  # expected number of missing people from which on somebody is
_GOING = 1.0  # s
_STAYS = 0.2  # probability that who stood, or could not go, stands there still, however long it is
_FEWEST = 8.0  # detections that make the mean of a second
_USUAL = 0.02  # SD of a limb's length over seconds, m: simulated 10 to 18 mm, Kinect v2's 5 to 25
_USUAL_SECONDS = 20.0  # for which the usual detector counts
_LASTING = 0.25  # share of the variance of a second that lasts (Kinect v2's: .2 to .7)
_SOONEST = 0.5  # s: in less time errors hardly change
_SHORTEST = 0.02  # m: shorter limbs are of no use, but have logarithms
_MOST = 4
"""Newcomers that are weighed together, the others wait; and absent people, of whom the best fit."""

LIMBS, PLACE, NUMBER = "limb lengths", "place and time", "number of people"


@dataclass(frozen=True, slots=True, eq=False)
class PersonCues:
    """The evidence of who a person is, at one end of an absence."""

    person: int  # id; of a newcomer any number of its own
    stamp: int  # time of the last detection of one who is absent, of the first of a newcomer, ns
    place: Floats  # (3,) mean marker position at that time, m
    lengths: Floats  # (L,) mean limb lengths, m
    counts: Floats  # (L,) detections that they are of
    seconds: float = 1.0  # for which the person was seen
    stood: bool = False  # whether one who is absent had not moved in the last second or two
    watched: float = math.inf  # s of an absence in which cameras watched; they may pause
    track: int = -1  # number of the track of one who is absent
    may_be: dict[int, float] = field(default_factory=dict)
    """Id of who left before -> probability that it is the same person, who then got a new id."""

    def same(self, other: PersonCues) -> float:
        """Return the probability that another absent person is the same one."""
        if other is self:
            return 1.0
        return max(self.may_be.get(other.person, 0.0), other.may_be.get(self.person, 0.0))

    @property
    def measured(self) -> Flags:
        """(L,) Whether a limb is long enough, and was measured often enough, to be compared."""
        return np.asarray((self.counts >= _FEWEST_LENGTHS) & (self.lengths > _SHORT))

    @property
    def limb_seconds(self) -> Floats:
        """(L,) Time, s, for which each limb was measured."""
        return np.asarray(self.seconds * self.counts / max(float(self.counts.max()), 1.0))


@dataclass(slots=True, eq=False)
class _Seconds:
    """The measured limbs of a person, second by second."""

    lengths: Floats  # (L,) mean length up to the last look, m
    counts: Floats  # (L,) detections that it is of
    means: Floats  # (L,) mean of the logarithms over the seconds
    seconds: Floats  # (L,) that had enough detections


class LimbScatter:
    """Learns how much the measured limb lengths of one person vary from second to second.

    A detector misplaces a marker for as long as somebody faces the same way. So the mean length
    over a second differs from that over another one by more than the noise of single detections
    explains. And limbs vary together: Kinect's trunk is one piece; a knee that lies too high
    shortens the thigh and lengthens the shank. The scatter of everybody's seconds about their own
    mean is pooled, together with some seconds of a usual detector. A share of the variance lasts,
    and is no less in a long mean.

    Parameters
    ----------
    mirror : (L,) the limb on the other side of each whose length is learned.
    """

    def __init__(self, mirror: Ints) -> None:
        n_limbs = len(mirror)
        self.alike = np.eye(n_limbs)
        """(L, L) 1 for a limb with itself and with the one on the other side, else 0."""
        self.alike[np.arange(n_limbs), mirror] = 1.0
        self._people: dict[int, _Seconds] = {}
        self._squares = np.zeros((n_limbs, n_limbs))
        self._freedom = np.zeros(n_limbs)

    def learn(self, person: int, lengths: Floats, counts: Floats) -> None:
        """Take the mean lengths (L,), m, of a person so far, of (L,) detections, once a second."""
        lengths = np.maximum(lengths, _SHORTEST)
        if person not in self._people:
            nothing = np.zeros((2, len(lengths)))
            self._people[person] = _Seconds(lengths, counts.copy(), *nothing)
            return
        past = self._people[person]
        new = counts - past.counts
        enough = new >= _FEWEST
        length = (counts * lengths - past.counts * past.lengths) / np.maximum(new, 1.0)
        logs = np.where(enough, np.log(np.maximum(length, _SHORTEST)), 0.0)
        past.lengths, past.counts = lengths, counts.copy()
        off = _deviation(logs, enough, past.means, past.seconds)
        self._squares += np.outer(off, off)
        self._freedom += enough & (past.seconds > 1)

    def keep(self, people: Container[int]) -> None:
        """Forget the seconds of everybody else."""
        self._people = {number: past for number, past in self._people.items() if number in people}

    def covariance(self, lengths: Floats) -> Floats:
        """(L, L) covariance of the logarithms, for limbs of these lengths, m."""
        usual = np.diag((_USUAL / np.maximum(lengths, _SHORTEST)) ** 2)
        root = np.sqrt(_USUAL_SECONDS + self._freedom)
        return np.asarray((_USUAL_SECONDS * usual + self._squares) / np.outer(root, root))

    def share(self, seconds: Floats) -> Floats:
        """(L,) variance of means over (L,) ``seconds`` to that over one."""
        return np.asarray(_LASTING + (1.0 - _LASTING) / np.maximum(seconds, _SOONEST))


def _deviation(values: Floats, taken: Flags, means: Floats, counts: Floats) -> Floats:
    """Take (L,) values into running means; return (L,) deviations, scaled (Welford 1962)."""
    counts += taken
    n = np.maximum(counts, 1.0)
    off = np.where(taken, values - means, 0.0)
    means += off / n
    return np.asarray(off * np.sqrt(1.0 - 1.0 / n))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The most probable absent person for a newcomer."""

    person: int
    probability: float
    exchanged: float  # probability of being any of the other absent people
    cue: str  # what spoke most for this person, against the next best explanation
    chances: Mapping[int, float]
    """Id of each absent person -> probability. Two ids may be of one person."""

    def __str__(self) -> str:
        rest = f", {self.exchanged:.0%} others" if self.exchanged > _EXCHANGED else ""
        return f"{self.cue}, {self.probability:.0%} person {self.person}{rest}"

    @property
    def accepted(self) -> bool:
        """Whether the newcomer gets the id."""
        return self.probability >= _THRESHOLD and self.exchanged <= _EXCHANGED

    @property
    def is_sure(self) -> bool:
        """Whether the newcomer gets the id though more evidence is to come."""
        return self.accepted and self.exchanged <= _HARDLY_EXCHANGED


def reidentify(
    newcomers: Sequence[PersonCues], absent: Sequence[PersonCues], missing: float,
    limbs: LimbScatter,
) -> dict[int, Verdict]:  # fmt: skip
    """Return the verdict on each newcomer; there is somebody absent.

    Parameters
    ----------
    newcomers : the most important first. absent : of many, those count whom the first one fits.
    missing : how many people are missing, expected.
    limbs : how the lengths of their limbs vary, and go together.
    """
    newcomers, first = newcomers[:_MOST], newcomers[0]
    fits = [
        limb_cue + place_cue(first, old)
        for old, limb_cue in zip(absent, limb_cues(first, absent, limbs), strict=True)
    ]
    best = sorted(range(len(absent)), key=fits.__getitem__)[-_MOST:]
    absent = [absent[a] for a in sorted(best)]
    cues = {
        (n, a): {
            LIMBS: limb_cue,
            PLACE: place_cue(new, old),
            NUMBER: number_cue(old, missing),
        }
        for n, new in enumerate(newcomers)
        for a, (old, limb_cue) in enumerate(zip(absent, limb_cues(new, absent, limbs), strict=True))
    }
    ratios = {pair: sum(evidence.values()) for pair, evidence in cues.items()}
    chances = _marginals(ratios, len(newcomers), len(absent))
    return {new.person: _verdict(n, absent, cues, chances) for n, new in enumerate(newcomers)}


def _verdict(
    n: int, absent: Sequence[PersonCues], cues: Mapping[tuple[int, int], Mapping[str, float]],
    chances: Mapping[tuple[int, int], float],
) -> Verdict:  # fmt: skip
    """Return the verdict on newcomer ``n``; ids that may be of one person share their chances."""
    chance = [chances[n, a] for a in range(len(absent))]
    same = [
        sum(p * old.same(other) for p, other in zip(chance, absent, strict=True)) for old in absent
    ]
    best = max(range(len(absent)), key=lambda a: (same[a], chance[a], a))
    ids = {old.person: p for old, p in zip(absent, same, strict=True)}
    cue = _deciding_cue(n, best, cues, chances)
    return Verdict(absent[best].person, same[best], sum(chance) - same[best], cue, ids)


def limb_cues(new: PersonCues, absent: Sequence[PersonCues], limbs: LimbScatter) -> list[float]:
    """Logarithm of the likelihood ratio of each absent person's limb lengths to a stranger's.

    A limb that was not measured of an absent person has a stranger's density.
    """
    known = np.array([old.measured for old in absent])
    both = new.measured & known.any(axis=0)
    if not both.any():
        return [0.0] * len(absent)
    known, pairs, counts = known[:, both], np.ix_(both, both), new.counts[both]
    lengths = np.log([np.maximum(old.lengths[both], _SHORT) for old in absent])
    mean = np.sum(lengths * known, axis=0) / known.sum(axis=0)
    usual = new.lengths.copy()
    usual[both] = np.exp(mean)
    of_second, share = limbs.covariance(usual)[pairs], limbs.share(new.limb_seconds)[both]
    theirs = np.array([limbs.share(old.limb_seconds)[both] for old in absent])
    of_mean = np.sum(theirs * known, axis=0) / known.sum(axis=0) ** 2
    spread = (_STATURE**2 + _PROPORTION**2 * limbs.alike[pairs]) * (1.0 + 1.0 / len(absent))

    def log_density(about: Floats, counts: Floats, share_there: Floats, spread: Floats) -> float:
        of_detections = np.diag(_NOISE_OF_ONE**2 / (counts * usual[both] ** 2))
        root = np.sqrt(np.outer(share, share)) + np.sqrt(np.outer(share_there, share_there))
        covariance = of_second * root + of_detections + spread
        return _log_student(np.log(new.lengths[both]) - about, covariance)

    stranger = log_density(mean, counts, of_mean, spread)
    return [
        log_density(
            np.where(has, their_lengths, mean),
            np.where(has, np.minimum(counts, old.counts[both]), counts),
            np.where(has, their_share, of_mean),
            np.outer(~has, ~has) * spread,
        )
        - stranger
        for old, has, their_lengths, their_share in zip(absent, known, lengths, theirs, strict=True)
    ]


def is_near(way: float, seconds: float) -> bool:
    """Whether anybody goes so far, m, on the floor in so many seconds."""
    return way <= _REACH + _TOP_SPEED * seconds


def place_cue(new: PersonCues, old: PersonCues) -> float:
    """Logarithm of the likelihood ratio of the way on the floor; -inf if it can't be."""
    if new.stamp < old.stamp - OVERLAP:
        return -math.inf
    seconds = abs(new.stamp - old.stamp) * 1e-9
    way = float(np.hypot(*(new.place - old.place)[:2]))
    if not is_near(way, seconds):
        return -math.inf
    went = _log_place(way, min(_PLACE + _WALK * seconds, _ROOM))
    if old.watched >= _GOING and not old.stood:
        return went
    stayed = _log_place(way, _PLACE)
    return float(np.logaddexp(math.log(1 - _STAYS) + went, math.log(_STAYS) + stayed))


def _log_place(way: float, sd: float) -> float:
    """Logarithm of a normal density on the floor, against that of being anywhere."""
    return 2 * math.log(_ROOM / sd) - way**2 / (2 * sd**2)


def number_cue(old: PersonCues, missing: float) -> float:
    """Logarithm of the prior odds that a newcomer was there before."""
    is_missing = missing >= _SOMEBODY
    sure = _SURE_IF_MISSING if is_missing else _SURE_IF_COMPLETE
    if is_missing and old.watched < _GOING:
        sure = _SURE_IF_UNWATCHED
    return math.log(sure / (1 - sure))


def _log_student(x: Floats, covariance: Floats) -> float:
    """Logarithm of Student's density with a covariance, but for a constant."""
    scaled = x @ np.linalg.solve(covariance, x) / (_FREEDOM - 2)
    tails = (_FREEDOM + len(x)) * np.log1p(scaled)
    return float(-0.5 * (np.linalg.slogdet(covariance)[1] + tails))


def _marginals(
    ratios: Mapping[tuple[int, int], float], n_new: int, n_absent: int
) -> dict[tuple[int, int], float]:
    """Probability that each newcomer is each absent person, over all ways to give the ids."""
    total = 0.0
    sums = dict.fromkeys(ratios, 0.0)
    for way in _ways(n_new, tuple(range(n_absent))):
        pairs = [(n, a) for n, a in enumerate(way) if a >= 0]
        orders = math.perm(n_absent, len(pairs))
        weight = math.exp(sum(ratios[pair] for pair in pairs)) / orders
        total += weight
        for pair in pairs:
            sums[pair] += weight
    return {pair: weight / total for pair, weight in sums.items()}


def _ways(n_new: int, absent: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Yield the absent person, or -1, of each newcomer; nobody comes twice."""
    if not n_new:
        yield ()
        return
    for a in (-1, *absent):
        left = tuple(person for person in absent if person != a)
        for way in _ways(n_new - 1, left):
            yield (a, *way)


def _deciding_cue(
    n: int, best: int, cues: Mapping[tuple[int, int], Mapping[str, float]],
    chances: Mapping[tuple[int, int], float],
) -> str:  # fmt: skip
    """Name the cue that speaks most for ``best`` against the next best explanation."""
    evidence = cues[n, best]
    rivals = [a for row, a in cues if row == n and a != best]
    second = max(rivals, key=lambda a: chances[n, a], default=None)
    stranger = 1.0 - sum(chance for (row, _), chance in chances.items() if row == n)
    if second is None or stranger >= chances[n, second]:
        return max(evidence, key=evidence.__getitem__)
    rival = cues[n, second]
    return max(
        evidence, key=lambda cue: evidence[cue] - (rival[cue] if cue != NUMBER else evidence[cue])
    )
