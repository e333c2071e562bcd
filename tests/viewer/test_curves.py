"""Plots: what is in them, and that the same result gives the same bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import find_truth, read_channel
from hiros_mcap.events import Event
from hiros_mcap.running.pipeline import process
from hiros_viewer import curves
from hiros_viewer.figures import (
    Curve,
    CurvePlot,
    hidden_marks,
    in_words,
    marks_of,
    over_time,
    with_gaps,
)
from hiros_viewer.page import Page
from hiros_viewer.pictures import picture_of, png_of


@pytest.fixture(scope="module")
def processed(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("plot") / "crossing.hiros.mcap"
    process(crossing, out)
    return out


def collected(path, *, with_truth=True):
    frames, model, _ = read_channel(path, "/hiros/filtered")
    return curves.collect("x", frames, model, find_truth(path) if with_truth else None)


def plots(collection, kind, person=None):
    """The plots of a kind, row by row."""
    grid = curves.grid_of(collection, collection.body(person)[1], kind)
    return [plot for row in grid.rows for plot in row]


def one_plot(seconds, *values, marks=()):
    """A grid of one plot of curves named 0, 1, ..."""
    drawn = [Curve(f"{k}", "#1f5fa8", seconds, y) for k, y in enumerate(values)]
    return over_time([[CurvePlot(drawn, (-1.0, 1.0))]], 3.0, seconds, marks)


def test_angles_are_drawn_beside_the_truth(processed):
    angles = plots(collected(processed), "angles", 1)
    titles = [plot.title for plot in angles[:2]]
    assert titles == ["left hip flexion, degrees", "right hip flexion, degrees"]
    assert len(angles) == 14
    for plot in angles:
        true, result = plot.curves
        assert (true.name, result.name) == ("truth", "result")
        assert np.nanmean(np.abs(true.y - result.y)) < 16
        assert plot.y_range[0] <= np.nanmin(true.y) and np.nanmax(result.y) <= plot.y_range[1]


def test_limbs_are_flat_and_errors_small(processed):
    limbs = plots(collected(processed), "limbs")
    assert [len(plot.curves) for plot in limbs] == [2, 2, 2, 2]
    for plot in limbs:
        assert all(np.ptp(curve.y) < 3 for curve in plot.curves)
        assert plot.y_range[1] - plot.y_range[0] == pytest.approx(120)
    (error,) = plots(collected(processed), "error")
    largest, mean = error.curves
    assert 5 < np.nanmean(mean.y) < 40
    assert np.nanmin(largest.y - mean.y) >= 0
    assert error.y_range[0] == 0


def test_a_picture_shows_what_the_page_does(processed):
    collection = collected(processed)
    axes = curves.figure_of(collection, "angles", 1).axes
    for plot, drawn in zip(plots(collection, "angles", 1), axes, strict=True):
        assert drawn.get_title(loc="left") == plot.title
        assert drawn.get_ylim() == plot.y_range
        for curve, line in zip(plot.curves, drawn.lines[1:], strict=True):
            np.testing.assert_array_equal(line.get_ydata(), curve.y)


def test_no_line_is_drawn_over_a_pause():
    seconds, values = with_gaps(np.array([0.0, 0.1, 2.0]), np.array([1.0, 2.0, 3.0]))
    assert np.isnan(seconds).tolist() == [False, False, True, False]
    assert np.isnan(values).tolist() == [False, False, True, False]


def test_who_and_what_is_missing_is_said(processed):
    with pytest.raises(ConfigError, match=r"no person 9 \(there are: 0, 1\)"):
        curves.figure_of(collected(processed), "angles", 9)
    with pytest.raises(ConfigError, match="no truth"):
        curves.figure_of(collected(processed, with_truth=False), "error")


@pytest.fixture(scope="module")
def plotted(processed):
    """A page of it, without the curves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hiros_viewer.page.png_of", lambda figure: b"")
        return plot(processed, processed.with_name("a.html")).decode().replace("<wbr>", "")


def plot(log, path, *options):
    assert run(["plot", str(log), "-o", str(path), "-q", *options]) == 0
    return path.read_bytes()


def test_the_same_log_gives_the_same_bytes(processed, tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "MOST_PEOPLE", 1)
    for suffix in ("png", "html"):
        one, other = (
            plot(processed, tmp_path / f"{name}.{suffix}", "--what", "limbs")
            for name in ("one", "other")
        )
        assert one == other


def test_the_page_holds_everybody(plotted):
    assert plotted.count("<img") == 6
    assert "Person 0" in plotted
    assert "Person 1" in plotted


def test_of_a_crowd_the_page_draws_those_who_are_seen_longest(processed, monkeypatch):
    collection = collected(processed)
    monkeypatch.setattr(curves, "MOST_PEOPLE", 1)
    brief = replace(collection.people[0], seconds=collection.people[0].seconds[:5])
    page = curves.page_of(replace(collection, people={0: brief, 1: collection.people[1]})).html()
    assert "Person 1," in page
    assert "Person 0," not in page
    assert "Not drawn, because others are seen for longer: person 0." in page


def test_somebody_without_an_angle_leaves_the_page_to_the_others(processed):
    collection = collected(processed, with_truth=False)
    body = collection.people[0]
    legless = replace(
        body,
        poses=np.where(np.arange(body.poses.shape[1])[:, None] < 3, body.poses, np.nan),
        orientations=np.full_like(body.orientations, np.nan),
    )
    people = {0: legless, 1: collection.people[1]}
    page = curves.page_of(replace(collection, people=people)).html()
    assert page.count("No joint with an angle was seen.") == 1
    assert "Person 1," in page
    with pytest.raises(ConfigError, match="no joint with an angle was seen"):
        curves.page_of(replace(collection, people={0: legless}))


def test_a_page_says_of_what_it_is_and_how_good(processed, plotted):
    for fact in (
        f"<h1>{processed}: /hiros/filtered</h1>",
        "recorded 2023-11-14 22:13 UTC; hiros 0.1.0, system fuse",
        "mean joint error ",
        "no warnings in the run</p>",
    ):
        assert fact in plotted


def test_a_long_log_does_not_make_a_large_picture():
    """Noise, which no compression makes smaller, of half an hour."""
    seconds = np.arange(54_000) / 30
    assert len(png_of(picture_of(one_plot(seconds, np.sin(54_321 * seconds))))) < 100_000


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["-o", "a.pdf"], "must end in .png or .html"),
        (["-o", "/nowhere/at/all.png"], "no such folder"),
        (["-o", "a.png", "--what", "dance"], "none of angles, limbs, error"),
        (["-o", "a.png", "--person", "9"], "{log}: /hiros/filtered: no person 9"),
        (["-o", "a.png", "--channel", "/hiros/none"], "/hiros/none"),
    ],
)
def test_faults_are_one_line(processed, tmp_path, monkeypatch, capsys, arguments, fault):
    monkeypatch.chdir(tmp_path)
    assert run(["plot", str(processed), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault.format(log=processed) in captured.err
    assert list(tmp_path.iterdir()) == []


def test_gaps_predictions_and_hidden_people_are_marked_and_named():
    seconds = np.array([0.0, 0.1, 0.2, 0.3, 5.0, 5.1, 5.2])
    unseen = np.array([False, True, True, False, False, False, True])
    hidden = [
        Event(2_000_000_000, "hidden", 3, "left", "behind person 1 for 0.4 s"),
        Event(2_000_000_000, "hidden", 4, "left", "behind person 1 for 0.4 s"),
    ]
    spans = [*hidden_marks(hidden, 3, 1_900_000_000), *marks_of(seconds, unseen)]
    assert [mark[:3] for mark in spans] == [
        ("hidden", 0.1, 0.5), ("gap", 0.3, 5.0), ("predicted", 0.1, 0.2), ("predicted", 5.2, 5.2)
    ]  # fmt: skip
    words = in_words(spans)
    assert words[0] == "Yellow: hidden: 0.1 to 0.5 s (behind person 1 for left)."
    assert words[2] == "Grey: not in the result: 0.3 to 5.0 s."
    grid = one_plot(seconds, seconds, marks=spans)
    (axes,) = picture_of(grid).axes
    assert axes.get_xlim() == grid.x_range
    assert len(axes.patches) == len(spans)


def test_a_long_name_may_wrap_behind_the_signs_in_it():
    html = Page("Evaluation of two_people.hiros.mcap: /hiros/<x>").html()
    assert "<h1>Evaluation of two_<wbr>people.<wbr>hiros.<wbr>mcap: /hiros" in html
    assert "&lt;x&gt;" in html
