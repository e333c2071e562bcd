"""Who is it that comes back? Cues weighed by probability, with the right to decline.

Each newcomer is one of the people who are absent, or a stranger. The model, with its numbers below:

- Limb lengths: the ratio of two sizes, a size being the sum of the limbs that both have, and the
  ratio of each limb besides. Of one person the logarithms are normal with the SD of the
  measurement, of two people also with that of adults' stature and proportions. One in ten
  measurements is three times as noisy: somebody bends or is half hidden. The proportions count
  less than they would if the two sides of a body were not alike.
- Place and time: a person who left is somewhere about the place where he was lost, on the floor,
  normal with an SD that grows with the time to that of a room. A stranger may be anywhere in it.
- Number of people: whoever comes while somebody is missing, of as many as were there at once, is
  probably one of the missing.

All ways to give several newcomers the absent people's ids are weighed together, so two people who
left and came back are told apart by each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Floats

THRESHOLD = 0.9
"""Least probability with which somebody gets an old id."""

_SIZE_NOISE, _SIZE_NOISE_OF_ONE = 0.0125, 0.06  # SD of the logarithm of a ratio of sizes: lasting,
# and what one detection adds, which falls with the root of their number
_LIMB_NOISE, _LIMB_NOISE_OF_ONE = 0.014, 0.04  # the same of a limb's length, m
_NOISY, _NOISE_OF_NOISY = 0.1, 3.0  # share of noisy measurements, and how many times the SD
_STATURE, _PROPORTION = 0.055, 0.04  # SD of the logarithm among adults
_PROPORTIONS_COUNT = 0.8
_SHORT = 0.15  # m: shorter limbs are too noisy
_FEWEST_LENGTHS = 5.0  # detections that make a limb's length worth comparing
_PLACE, _WALK, _ROOM = 0.4, 0.7, 2.5  # SD of the place, m: at once, more per s, at most
_TOP_SPEED = 4.0  # m/s on the floor; nobody comes back faster
_REACH = 0.6  # m, besides
_KNOWN_IF_MISSING, _KNOWN_IF_COMPLETE = 0.95, 0.5  # that a newcomer was there before
_MOST = 4  # newcomers, and absent people, that are weighed together; older ones wait or are left

LIMBS, PLACE, NUMBER = "limb lengths", "place and time", "number of people"


@dataclass(frozen=True, slots=True, eq=False)
class PersonCues:
    """What is known of a person at one end of an absence."""

    person: int
    """Id; of a newcomer any number of its own."""
    stamp: int
    """Time of the last detection of one who is absent, of the first of a newcomer, ns."""
    place: Floats
    """(3,) mean marker position at that time, m."""
    lengths: Floats
    """(L,) mean limb lengths, m."""
    counts: Floats
    """(L,) detections that they are of."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The most probable absent person for a newcomer."""

    person: int
    probability: float
    cue: str
    """What spoke most for this person, against the next best explanation."""

    def __str__(self) -> str:
        return f"{self.cue}, {self.probability:.0%} person {self.person}"

    @property
    def accepted(self) -> bool:
        """Whether the newcomer gets the id."""
        return self.probability >= THRESHOLD


def reidentify(
    newcomers: Sequence[PersonCues], absent: Sequence[PersonCues], missing: int
) -> dict[int, Verdict]:
    """Return the verdict on each newcomer; there is somebody absent.

    Parameters
    ----------
    newcomers : the most important first. absent : the last to leave last.
    missing : how many people are missing, of as many as were there at once.
    """
    newcomers, absent = newcomers[:_MOST], absent[-_MOST:]
    known = _KNOWN_IF_MISSING if missing > 0 else _KNOWN_IF_COMPLETE
    number = math.log(known / len(absent) / (1 - known))
    cues = {
        (n, a): {LIMBS: limb_cue(new, old), PLACE: place_cue(new, old), NUMBER: number}
        for n, new in enumerate(newcomers)
        for a, old in enumerate(absent)
    }
    ratios = {pair: sum(each.values()) for pair, each in cues.items()}
    chances = _marginals(ratios, len(newcomers), len(absent))
    verdicts = {}
    for n, new in enumerate(newcomers):
        best = max(range(len(absent)), key=[chances[n, a] for a in range(len(absent))].__getitem__)
        cue = _deciding_cue(n, best, cues, chances)
        verdicts[new.person] = Verdict(absent[best].person, chances[n, best], cue)
    return verdicts


def limb_cue(new: PersonCues, old: PersonCues) -> float:
    """Logarithm of the likelihood ratio of one person's limb lengths against two people's."""
    known = np.minimum(new.counts, old.counts) >= _FEWEST_LENGTHS
    both = known & (np.minimum(new.lengths, old.lengths) > _SHORT)
    if not both.any():
        return 0.0
    ours, theirs = new.lengths[both], old.lengths[both]
    fewest = np.minimum(new.counts, old.counts)[both]
    size = math.log(ours.sum() / theirs.sum())
    noise = _SIZE_NOISE**2 + _SIZE_NOISE_OF_ONE**2 / float(np.median(fewest))
    cue = _ratio(size, noise, 2 * _STATURE**2)
    noises = (_LIMB_NOISE**2 + _LIMB_NOISE_OF_ONE**2 / fewest) / theirs**2
    for limb, noise in zip((np.log(ours / theirs) - size).tolist(), noises.tolist(), strict=True):
        cue += _PROPORTIONS_COUNT * _ratio(limb, noise, 2 * _PROPORTION**2)
    return cue


def place_cue(new: PersonCues, old: PersonCues) -> float:
    """Logarithm of the likelihood ratio of the way on the floor; -inf if it is too far."""
    seconds = max((new.stamp - old.stamp) * 1e-9, 0.0)
    way = float(np.hypot(*(new.place - old.place)[:2]))
    if not way <= _REACH + _TOP_SPEED * seconds:
        return -math.inf
    sd = min(_PLACE + _WALK * seconds, _ROOM)
    return 2 * math.log(_ROOM / sd) - way**2 / (2 * sd**2)


def _ratio(x: float, noise: float, spread: float) -> float:
    """Logarithm of the ratio of two densities: of one person and of two people.

    One person: normal of variance ``noise``, or noisier. Two people: of ``noise + spread``.
    """
    usual = (1 - _NOISY) * _normal(x, noise)
    one = usual + _NOISY * _normal(x, noise * _NOISE_OF_NOISY**2)
    return math.log(max(one, 1e-300) / max(_normal(x, noise + spread), 1e-300))


def _normal(x: float, variance: float) -> float:
    """Return a normal density, but for a constant factor."""
    return math.exp(-x * x / (2 * variance)) / math.sqrt(variance)


def _marginals(
    ratios: Mapping[tuple[int, int], float], n_new: int, n_absent: int
) -> dict[tuple[int, int], float]:
    """Probability that each newcomer is each absent person, over all ways to give the ids."""
    total = 0.0
    sums = dict.fromkeys(ratios, 0.0)
    for way in _ways(n_new, tuple(range(n_absent))):
        pairs = [(n, a) for n, a in enumerate(way) if a >= 0]
        weight = math.exp(sum(ratios[pair] for pair in pairs))
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
        left = tuple(other for other in absent if other != a)
        for way in _ways(n_new - 1, left):
            yield (a, *way)


def _deciding_cue(
    n: int,
    best: int,
    cues: Mapping[tuple[int, int], Mapping[str, float]],
    chances: Mapping[tuple[int, int], float],
) -> str:
    """Name the cue that speaks most for ``best`` against the next best explanation."""
    own = cues[n, best]
    others = [a for row, a in cues if row == n and a != best]
    second = max(others, key=lambda a: chances[n, a], default=None)
    stranger = 1.0 - sum(chance for (row, _), chance in chances.items() if row == n)
    if second is None or stranger >= chances[n, second]:
        return max(own, key=own.__getitem__)
    rival = cues[n, second]
    return max(own, key=lambda cue: own[cue] - (rival[cue] if cue != NUMBER else own[cue]))
