"""Whether a truth has everybody who was there, or only some: two of four people wear suits."""

from __future__ import annotations

import numpy as np

from hiros_mcap.evaluate.match import MATCH_DISTANCE, Matches, Track
from hiros_mcap.evaluate.pairing import skeleton_distances
from hiros_mcap.evaluate.truth import Truth

_LEAST_SECONDS = 2.0
_LEAST_SHARE = 0.25
"""Of the scored frames, that somebody without a label is there."""
_UNMATCHED = 0.9
"""Of his frames, that no true person matches."""
_WALKS_M = 0.5
"""RMS distance of somebody who walks about from his own mean position."""
_FOUND = 0.5
"""Of all true people and instants: a result that finds fewer says nothing about the truth."""


def people_without_truth(
    matches: Matches, truth: Truth, max_distance: float = MATCH_DISTANCE
) -> tuple[int, ...]:
    """Return the ids that are surely of people whom the truth lacks.

    A detector's error must not pass for a person. So an id counts only if it is there for a quarter
    of the frames and 2 s, matches nobody in 90 % of its frames, is farther than the matching
    distance from every true person in half of them (a second skeleton of one person never is), and
    walks about, which an object that is taken for a person does not. And the result must find the
    people of the truth: otherwise the two do not belong together.

    Parameters
    ----------
    matches : of a result with this truth.
    truth : on the markers of the result.
    max_distance : m, that the matches were found with.
    """
    if len(matches.people) < _FOUND * (len(matches.people) + len(matches.missed)):
        return ()
    matched = dict(zip(*np.unique(matches.ids, return_counts=True), strict=True))
    others = []
    for ident, track in matches.tracks.items():
        n, seconds = len(track.stamps), (track.stamps[-1] - track.stamps[0]) / 1e9
        lasts = n >= _LEAST_SHARE * matches.frames and seconds >= _LEAST_SECONDS
        if lasts and matched.get(ident, 0) <= (1 - _UNMATCHED) * n and _walks(track):
            frames = zip(truth.at(track.stamps)[0], track.poses, strict=True)
            nearest = [skeleton_distances(t, p[None]).min(initial=np.inf) for t, p in frames]
            if np.mean(np.array(nearest) > max_distance) >= 0.5:
                others.append(ident)
    return tuple(sorted(others))


def _walks(track: Track) -> bool:
    places = np.nanmean(track.poses, axis=1)
    away = places - np.nanmean(places, axis=0)
    return bool(np.nanmean((away * away).sum(axis=-1)) >= _WALKS_M**2)
