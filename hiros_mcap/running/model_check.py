"""Whether the cameras' residuals contradict the noise that the fuser assumes, in numbers and words.

:mod:`hiros_mcap.stages.fuse.residuals` says what is measured. The ratio is that of medians, which
outliers hardly move.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from hiros_mcap.events import COMMON, RESIDUAL, Events
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.fuse.log_histograms import medians
from hiros_mcap.stages.fuse.residuals import FEWEST, ratios
from hiros_mcap.summary import ScatterSummary

_LARGE = 1.4  # times as far as expected
_WORSE = 1.2  # a joint is named if it is so many times worse than its camera
_TOGETHER = 0.6  # share in common from which the camera as a whole is off


def scatter_of(events: Events) -> float:
    """Return how many times as large as expected all residuals are; NaN if there are none."""
    some = [counts for (kind, _), counts in events.histograms.items() if kind == RESIDUAL]
    return float(ratios(sum(each.sum(axis=0) for each in some)[None])[0]) if some else math.nan


def scatter_by_camera(events: Events, model: SkeletonModel) -> Iterator[ScatterSummary]:
    """Yield the same of each camera, by name."""
    for (kind, name), counts in sorted(events.histograms.items()):
        if kind != RESIDUAL:
            continue
        (ratio,) = ratios(counts.sum(axis=0, keepdims=True)).tolist()
        (common,) = medians(events.histograms[COMMON, name], FEWEST).tolist()
        joints = np.nan_to_num(ratios(counts))
        worst = int(joints.argmax())
        seen = joints[worst] > 0
        yield ScatterSummary(
            name=name,
            ratio=ratio,
            worst_joint=model.marker_names[worst] if seen else "",
            worst_ratio=float(joints[worst]) if seen else math.nan,
            common=common,
        )


def scatter_notes(cameras: Sequence[ScatterSummary]) -> Iterator[str]:
    """Yield whose detections contradict the model, and what to do."""
    for camera in cameras:
        if not camera.ratio >= _LARGE:
            continue
        joint = ""
        if camera.worst_ratio > _WORSE * camera.ratio:
            joint = f" ({camera.worst_joint} {camera.worst_ratio:.1f} times)"
        yield (
            f"the detections of {camera.name} scatter {camera.ratio:.1f} times as much as the "
            f"model expects{joint}; the standard deviations of the result allow for it; "
            f"{_remedy(camera)}"
        )


def _remedy(camera: ScatterSummary) -> str:
    if camera.common > _TOGETHER:
        return "all joints are off together: check its pose with hiros calibrate people"
    return "its joints are off one by one: hiros calibrate noise shows its noise"
