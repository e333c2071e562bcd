"""Skeletons of different models as skeletons of one, by the names of their joints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.detectors.body_models import BODY_MODELS, Joint, body_model, joints_of
from hiros_mcap.io.detectors.detector_reader import add_links
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    STATE,
    VELOCITY,
    Floats,
    Frame,
    People,
    SkeletonModel,
)

UNION = "union"
_COMMON = 3
"""Joints in common that tell how two skeletons lie to each other."""


def union_of(models: Sequence[SkeletonModel]) -> SkeletonModel:
    """Return a model with every joint of all models, under the name that the first one gives it.

    A joint is linked as in the first model that links it to something.
    """
    if len(models) == 1:
        return models[0]
    names: dict[Joint, str] = {}
    links: dict[Joint, tuple[str, Joint]] = {}
    for model in models:
        joints = joints_of(model.marker_names)
        for joint, name in zip(joints, model.marker_names, strict=True):
            names.setdefault(joint, name)
        for name, (parent, child) in zip(model.link_names, model.links.tolist(), strict=True):
            if parent >= 0 and child >= 0 and not _leads(links, joints[parent], joints[child]):
                links.setdefault(joints[child], (name, joints[parent]))
    slots = {joint: slot for slot, joint in enumerate(names)}
    rows = zip(_unique(name for name, _ in links.values()), links.items(), strict=True)
    return SkeletonModel.of(
        names.values(), ((name, slots[parent], slots[child]) for name, (child, (_, parent)) in rows)
    )


def _leads(links: Mapping[Joint, tuple[str, Joint]], joint: Joint, to: Joint) -> bool:
    """Whether ``to`` is ``joint`` or above it, where a link from it would close a loop."""
    while joint != to and joint in links:
        joint = links[joint][1]
    return joint == to


def _unique(names: Iterable[str]) -> list[str]:
    """Add a number to names that come twice: detectors may call different links alike."""
    counts: Counter[str] = Counter()
    free = []
    for name in names:
        counts[name] += 1
        free.append(name if counts[name] == 1 else f"{name}_{counts[name]}")
    return free


def chosen_model(wanted: str, models: Mapping[str, SkeletonModel]) -> SkeletonModel:
    """Return the model that results are to have.

    Parameters
    ----------
    wanted : "union" or "", a name of :data:`BODY_MODELS`, or a topic: that camera's model.
    models : of each topic.

    Raises
    ------
    ConfigError
        ``wanted`` names nothing of these.
    LogError
        the skeletons of a topic have too few joints in common with the others.
    """
    if wanted in ("", UNION):
        model = union_of(list(dict.fromkeys(models.values())))
    elif wanted in models:
        model = models[wanted]
    elif wanted in BODY_MODELS:
        model = body_model(wanted)
    else:
        choices = ", ".join([UNION, *BODY_MODELS, *sorted(models)])
        raise ConfigError(f"there is no skeleton model {wanted!r} (there are: {choices})")
    _check_common(wanted or UNION, model, models)
    return model


def _check_common(wanted: str, model: SkeletonModel, models: Mapping[str, SkeletonModel]) -> None:
    """Raise LogError for a topic whose skeletons cannot be compared with the others'."""
    target = set(joints_of(model.marker_names))
    joints = {topic: set(joints_of(m.marker_names)) for topic, m in models.items()}
    alike = {topic: sum(m == model for m in models.values()) for topic, model in models.items()}
    for topic in sorted(joints, key=alike.__getitem__):  # the odd one out is named
        of_topic = joints[topic]
        others = [other for t, other in joints.items() if models[t] != models[topic]]
        if wanted == UNION and not others:
            continue
        other = set[Joint]().union(*others) if wanted == UNION else target
        if len(of_topic & other) < min(_COMMON, len(of_topic)):
            names = ", ".join(models[topic].marker_names[:_COMMON])
            raise LogError(
                f"its markers ({names}, ...) have fewer than {_COMMON} names in common with the "
                "skeletons of the other channels; leave the channel out by --topic",
                topic=topic,
            )


class Fit:
    """Turns frames of one model into frames of another."""

    def __init__(
        self, source: SkeletonModel, target: SkeletonModel, factors: Floats | None = None
    ) -> None:
        """``factors`` (3,) turn the source's positions into metres, and its axes right-handed."""
        self.target = target
        self._factors = np.ones(3) if factors is None else factors
        self._same = source == target
        joints, of_target = joints_of(source.marker_names), joints_of(target.marker_names)
        # Of two names for one joint, the first counts.
        slots = {joint: slot for slot, joint in reversed([*enumerate(of_target)])}
        first = {slots[j]: i for i, j in reversed([*enumerate(joints)]) if j in slots}
        self._from, self._to = list(first.values()), list(first)
        self._names = source.marker_names
        self._missing = [i for i, joint in enumerate(joints) if joint not in slots]

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame with the target's markers; without orientations unless models agree.

        Every detector has its own axes of the joints, so a mean of two would mean nothing.
        """
        people = self._scaled(frame.people)
        if self._same:
            return frame.replace(people=people)
        target = self.target
        output = People.absent(frame.n_people, target.n_markers, target.n_links)
        for name in ("ids", "stamps", "confidences", "boxes"):
            getattr(output, name)[:] = getattr(people, name)
        output.markers[:, self._to] = people.markers[:, self._from]
        output.markers[:, :, ORIENTATION] = np.nan
        output.marker_confidences[:, self._to] = people.marker_confidences[:, self._from]
        fitted = frame.replace(people=output)
        add_links(fitted, target)
        return fitted

    def left_out(self, frame: Frame) -> list[str]:
        """Names of the markers of a frame for which the target has no place."""
        if not self._missing:
            return []
        here = ~np.isnan(frame.positions[:, self._missing, 0])
        return [self._names[self._missing[k]] for k in np.flatnonzero(here.any(axis=0))]

    def _scaled(self, people: People) -> People:
        if (self._factors == 1.0).all():
            return people
        people = people.copy()
        for states in (people.markers, people.links, people.boxes):
            for part in (POSITION, VELOCITY, ACCELERATION):
                states[..., part] *= self._factors
            if self._factors.prod() < 0.0:  # turns of left-handed axes are others
                for part in (ORIENTATION, ANGULAR_VELOCITY, ANGULAR_ACCELERATION):
                    states[..., part] = np.nan
        people.boxes[:, STATE:] *= abs(self._factors[0])
        return people
