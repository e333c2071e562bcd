"""``hiros plot``: joint angles, limb lengths and errors over time, for papers and reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import consistency, start_of
from hiros_mcap.evaluate.match import Matches, match
from hiros_mcap.evaluate.measures import text_of
from hiros_mcap.evaluate.reprojection import ImageScores
from hiros_mcap.evaluate.score_tables import image_sheet
from hiros_mcap.evaluate.smoothness import lengths_of
from hiros_mcap.evaluate.truth import EPOCH_2001, Truth
from hiros_mcap.events import Event
from hiros_mcap.io.log import open_reader
from hiros_mcap.io.result import stored_report
from hiros_mcap.regression.differences import Provenance
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel
from hiros_mcap.wording import number, quantity
from hiros_viewer.figures import (
    RESULT,
    SPREAD,
    Curve,
    CurveGrid,
    CurvePlot,
    Mark,
    angle_grid,
    angles_of,
    from_zero,
    hidden_marks,
    in_words,
    limb_grid,
    limb_links,
    marks_of,
    over_time,
    with_gaps,
)
from hiros_viewer.page import Page
from hiros_viewer.pictures import joint_map, picture_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("angles", "limbs", "error")
MOST_PEOPLE = 12  # on a page: the curves of each take some seconds to draw


@dataclass(frozen=True, slots=True)
class Body:
    """One person over time."""

    seconds: Floats  # (T,) since the channel's first frame
    poses: Floats  # (T, M, 3) m
    orientations: Floats  # (T, L, 4) x y z w of the links; NaN where absent
    true_poses: Floats | None = None  # (T, M, 3) m; None without a truth
    true_orientations: Floats | None = None  # (T, L, 4) x y z w; None without a truth
    marks: Sequence[Mark] = ()  # where the curves are to be doubted, or missing


@dataclass(frozen=True, slots=True)
class Curves:
    """The data of a channel that can be plotted."""

    title: str  # the log and the channel
    model: SkeletonModel
    people: Mapping[int, Body]
    images: Sequence[ImageScores] = ()  # the RGB cameras against the channel
    about: Sequence[str] = ()  # when the log was recorded and how the result was made; the verdict

    def body(self, person: int | None) -> tuple[int, Body]:
        """Return a person, or the one who is there for longest.

        Raises ConfigError if there is nobody, or not this one.
        """
        if not self.people:
            raise ConfigError(f"{self.title}: holds no people")
        if person is None:
            person = max(self.people, key=lambda number: len(self.people[number].seconds))
        if person not in self.people:
            people = ", ".join(map(str, self.people))
            raise ConfigError(f"{self.title}: no person {person} (there are: {people})")
        return person, self.people[person]


def collect(
    title: str,
    frames: Sequence[Frame],
    model: SkeletonModel,
    truth: Truth | None,
    events: Sequence[Event] = (),
) -> Curves:
    """Collect everybody with an id; the truth, if there is one, at the frames' times.

    ``events`` are those of the run: they tell who was hidden.
    """
    start = frames[0].stamp if frames else 0
    true = {} if truth is None else _true_poses(match(frames, truth.seen_by(model)))
    rows: dict[int, list[tuple[int, Floats, Floats]]] = {}
    unseen: dict[int, list[bool]] = {}
    for frame in frames:
        for row, person in frame.tracked():
            pose = frame.stamp, frame.positions[row], frame.orientations[row]
            rows.setdefault(person, []).append(pose)
            unseen.setdefault(person, []).append(frame.confidences[row] < LEAST_CONFIDENCE)
    absent = np.full((model.n_markers, 3), np.nan), np.full((model.n_links, 4), np.nan)
    people = {}
    for person, track in sorted(rows.items()):
        stamps = np.array([stamp for stamp, _, _ in track])
        true_poses = [true.get((person, stamp), absent) for stamp, _, _ in track]
        people[person] = Body(
            (stamps - start) / 1e9,
            np.stack([pose for _, pose, _ in track]),
            np.stack([turns for _, _, turns in track]),
            np.stack([pose for pose, _ in true_poses]) if true else None,
            np.stack([turns for _, turns in true_poses]) if true else None,
            [
                *hidden_marks(events, person, start),
                *marks_of((stamps - start) / 1e9, np.array(unseen[person])),
            ],
        )
    return Curves(title, model, people)


def _true_poses(matches: Matches) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    keys = zip(matches.ids, matches.stamps, strict=True)
    poses = zip(matches.true_poses, matches.true_orientations, strict=True)
    return dict(zip(keys, poses, strict=True))


def figure_of(curves: Curves, kind: str, person: int | None = None) -> Figure:
    """Return a picture of one of :data:`KINDS` for one person.

    Raises ConfigError if there is nobody, or nothing of this kind to plot.
    """
    label, body = curves.body(person)
    title = (f"{curves.title}, person {label}", *curves.about, *in_words(body.marks))
    return picture_of(grid_of(curves, body, kind), title)


def grid_of(curves: Curves, body: Body, kind: str) -> CurveGrid:
    """Return the plots of one of :data:`KINDS`; raises ConfigError if there is nothing to plot."""
    model, true = curves.model, body.true_poses
    if kind == "angles":
        angles = angles_of(model, body.poses, body.orientations)
        true_angles = None if true is None else angles_of(model, true, body.true_orientations)
        return angle_grid(body.seconds, angles, true_angles, body.marks)
    if kind == "limbs":
        limbs = limb_links(model)
        if not limbs:
            raise ConfigError("the marker names reveal no arms or legs")
        lengths = 1000 * lengths_of(body.poses, model)
        return limb_grid(body.seconds, {n: lengths[:, k] for n, k in limbs.items()}, body.marks)
    if true is None:
        raise ConfigError(f"{curves.title}: there is no truth to plot an error against")
    errors = 1000 * np.linalg.norm(body.poses - true, axis=-1)
    present = ~np.isnan(errors).all(axis=1)
    drawn = []
    for name, colour, of in (("largest", SPREAD, np.nanmax), ("mean", RESULT, np.nanmean)):
        values = np.full(len(errors), np.nan)
        values[present] = of(errors[present], axis=1)
        drawn.append(Curve(name, colour, *with_gaps(body.seconds, values)))
    plot = CurvePlot(drawn, from_zero(drawn), y_title="mm")
    return over_time([[plot]], 2.6, body.seconds, body.marks)


def page_of(curves: Curves) -> Page:
    """Everything of everybody on one page; of a crowd, of those who are seen longest.

    Raises ConfigError if nobody who is drawn has a joint with an angle.
    """
    page = Page(curves.title, curves.about)
    longest = sorted(curves.people, key=lambda person: -len(curves.people[person].seconds))
    drawn = {*longest[:MOST_PEOPLE]}
    if left := [f"{person}" for person in curves.people if person not in drawn]:
        page.text(
            f"Not drawn, because others are seen for longer: person {', '.join(left)}. "
            "--person ID with a .png draws one."
        )
    without_angles = set()
    for person, body in curves.people.items():
        if person not in drawn:
            continue
        span = f"{number(body.seconds[0], 1)} to {number(body.seconds[-1], 1)} s"
        page.heading(f"Person {person}, {span}")
        for line in in_words(body.marks):
            page.text(line)
        caption = "Joint angles, degrees. Flexion, abduction and inward rotation are positive."
        try:
            page.figure(picture_of(grid_of(curves, body, "angles")), caption)
        except ConfigError:  # of somebody who was seen in parts
            without_angles.add(person)
            if without_angles == drawn:
                raise
            page.text("No joint with an angle was seen.")
        if limb_links(curves.model):
            page.figure(picture_of(grid_of(curves, body, "limbs")), "Limb lengths, mm")
        if body.true_poses is not None:
            errors = picture_of(grid_of(curves, body, "error"))
            page.figure(errors, "Mean and largest joint error, mm")
    add_images(page, curves.images)
    return page


def add_images(page: Page, cameras: Sequence[ImageScores]) -> None:
    """Add how far the keypoints of RGB cameras are from the result, if there are any."""
    if not cameras:
        return
    sheet = image_sheet(cameras)
    page.heading("RGB cameras")
    page.table(*text_of(sheet), sheet.title)
    medians = {c.topic: {n: e.median for n, e in c.result.joints.items()} for c in cameras}
    page.figure(joint_map(medians, "px"), "Median reprojection of each joint, px")


def verdict(curves: Curves) -> str:
    """Return the mean joint error of everybody, "" without a truth."""
    errors = [
        1000 * np.linalg.norm(body.poses - body.true_poses, axis=-1).ravel()
        for body in curves.people.values()
        if body.true_poses is not None
    ]
    metres = np.concatenate(errors) if errors else np.zeros(0)
    metres = metres[~np.isnan(metres)]
    return f"mean joint error {number(float(metres.mean()), 1)} mm" if metres.size else ""


def summary_row(frames: Sequence[Frame], model: SkeletonModel) -> str:
    """One line about the channel: people, limb constancy, jitter."""
    scores = consistency(frames, model)
    n = len(scores.people)
    return (
        f"{n} {'person' if n == 1 else 'people'}, limb lengths vary by "
        f"{number(scores.limb_variation, 4)} (CV), jitter {number(scores.jitter, 1)} mm"
    )


def about(path: Path, *verdict: str) -> tuple[str, str]:
    """Return when a log that hiros wrote was recorded and how it was made, and the verdict.

    Raises LogError if it is damaged.
    """
    facts = []
    start = start_of(path)
    if start > EPOCH_2001:
        facts.append(f"recorded {datetime.fromtimestamp(start // 10**9, UTC):%Y-%m-%d %H:%M} UTC")
    run = Provenance.of_log(path).run
    if "version" in run:
        facts.append(f"hiros {run['version']}, system {run.get('system', '')}")
    with open_reader(path) as reader:
        n = len(stored_report(reader).warnings)
    warnings = f"{quantity(n, 'warning')} in the run" if n else "no warnings in the run"
    return "; ".join(facts), "; ".join([*filter(None, verdict), warnings])
