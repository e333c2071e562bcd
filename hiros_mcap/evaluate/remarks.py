"""Warnings and notes about scores: reasons to doubt them, and joints that they leave out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hiros_mcap.evaluate.logs import ChannelResult
from hiros_mcap.evaluate.match import explain_no_match
from hiros_mcap.evaluate.scores import SINGULAR_DEG, Scores
from hiros_mcap.evaluate.smoothness import MOST_MS
from hiros_mcap.evaluate.truth import Truth, shared_links, shared_markers

_GAIN, _GAIN_MM = 0.1, 1.0
"""Share of the mean error, and mm, that another time of the truth takes away at least."""
_NEAR_END_MS = 30  # a lag so near to the longest one that is tried may be longer
_MANY_FALSE = 0.1  # false people per frame that may be people whom the truth lacks


def warnings_of(results: Mapping[str, ChannelResult]) -> list[str]:
    """Return what makes the scores of results doubtful."""
    return [text for text in (_silence(results), _unlabelled(results)) if text]


def notes_of(truth: Truth, results: Mapping[str, ChannelResult]) -> list[str]:
    """Return what the scores leave out, and what was taken as meant."""
    result = list(results.values())[-1]
    scores = result.scores
    notes = [*truth.notes, *([] if truth.alignment is None else [truth.alignment.text])]
    notes += filter(None, [other_clock([each.scores for each in results.values()])])
    absent = [name for name in result.model.marker_names if name not in scores.joints]
    if absent and scores.joints:
        notes.append(f"no truth for {len(absent)} markers: {', '.join(absent)}")
    if truth.model is not None and truth.model != result.model:
        shared = shared_markers(truth.model, result.model)
        unknown = [n for k, n in enumerate(truth.model.marker_names) if k not in shared]
        if unknown:
            notes.append(f"joints of the truth that the result lacks: {', '.join(unknown)}")
        lost = truth.model.n_links - len(shared_links(truth.model, result.model, shared))
        if lost:
            notes.append(f"{lost} links of the truth join no two joints that the result links")
    if hint := explain_no_match(result.matches, truth):
        notes.append(hint)
    if singular := sum(a.singular for a in scores.link_angles.values()):
        notes.append(
            f"by links, {singular} near-singular angles are left out: the true x angle is beyond "
            f"{SINGULAR_DEG:g} degrees"
        )
    notes += [f"{topic}: {each.coverage}" for topic, each in results.items() if each.coverage]
    for topic, each in results.items():
        notes += [f"{topic}: {n} messages skipped: {why}" for why, n in each.skipped.items()]
    return notes


def other_clock(results: Sequence[Scores]) -> str:
    """Return by how much earlier or later the truth fits all results of a log better, else "".

    A stage or a system may lag behind. What all have in common is the clock of the truth.
    """
    scored = [scores for scores in results if not math.isnan(scores.lag)]
    if not scored:
        return ""
    lag = min((scores.lag for scores in scored), key=abs)
    best = min(scored, key=lambda scores: scores.mean_at_lag)
    same = all(scores.lag * lag > 0 for scores in scored)
    if not same or best.mean - best.mean_at_lag < max(_GAIN_MM, _GAIN * best.mean):
        return ""
    size, way = abs(lag), "earlier" if lag < 0 else "later"
    most = " or more" if size > MOST_MS - _NEAR_END_MS else ""
    return (
        f"the truth fits better {size:.0f} ms{most} {way}: {best.mean_at_lag:.1f} mm instead of "
        f"{best.mean:.1f}; if its clock or its begin is not that of the log, "
        "hiros eval --align-time finds the difference"
    )


def _silence(results: Mapping[str, ChannelResult]) -> str:
    silent = {topic: r.scores.silent for topic, r in results.items() if r.scores.silent}
    if not silent:
        return ""
    counts = ", ".join(f"{topic} {n}" for topic, n in silent.items())
    return f"instants of the truth without a frame, where everybody is missing: {counts}"


def _unlabelled(results: Mapping[str, ChannelResult]) -> str:
    scores = list(results.values())[-1].scores
    if not scores.false or scores.false < _MANY_FALSE * scores.frames:
        return ""
    return (
        f"{scores.false} skeletons in {scores.frames} frames are of nobody. If the truth lacks "
        "people who were there, use --truth-covers partial; if it has another frame, --align"
    )
