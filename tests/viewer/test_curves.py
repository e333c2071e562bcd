"""Plots: what is in them, and that the same result gives the same bytes."""

from __future__ import annotations

import base64
import gzip
import json
import re
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
from hiros_viewer.page import Page, curves_json
from hiros_viewer.pictures import picture_of


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
        patch.setattr("hiros_viewer.page.curves_json", lambda figure, target: "{}")
        return plot(processed, processed.with_name("a.html")).decode().replace("<wbr>", "")


def plot(log, path, *options):
    assert run(["plot", str(log), "-o", str(path), "-q", *options]) == 0
    return path.read_bytes()


def test_the_same_log_gives_the_same_bytes(processed, tmp_path, without_curves):
    for suffix in ("png", "html"):
        one, other = (
            plot(processed, tmp_path / f"{name}.{suffix}", "--what", "limbs")
            for name in ("one", "other")
        )
        assert one == other


def test_the_same_curves_give_the_same_bytes(processed):
    collection = collected(processed)
    grid = curves.grid_of(collection, collection.body(1)[1], "limbs")
    assert curves_json(grid, "f1") == curves_json(grid, "f1")


def test_the_page_holds_everybody(plotted):
    assert plotted.count('<div class="curves"') == 6
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


def test_a_page_says_of_what_it_is_and_how_good(processed, plotted):
    for fact in (
        f"<h1>{processed}: /hiros/filtered</h1>",
        "recorded 2023-11-14 22:13 UTC; hiros 0.1.0, system fuse",
        "mean joint error ",
        "no warnings in the run</p>",
    ):
        assert fact in plotted


def curves_in(text):
    """The x and y of every curve of a page's plots."""

    def objects(node):
        if isinstance(node, dict):
            yield node
        children = node.values() if isinstance(node, dict) else node
        for child in children if isinstance(node, dict | list) else ():
            yield from objects(child)

    def values(array):
        return np.frombuffer(
            gzip.decompress(base64.b64decode(array["array"]["data"])), array["dtype"]
        )

    sources = [n for n in objects(json.loads(text)) if n.get("name") == "ColumnDataSource"]
    columns = [dict(n["attributes"]["data"]["entries"]) for n in sources]
    return [(values(c["x"]), values(c[y])) for c in columns for y in c if y != "x"]


def test_a_page_holds_the_values_of_its_curves(processed):
    collection = collected(processed)
    grid = curves.grid_of(collection, collection.body(1)[1], "angles")
    shown = curves_in(curves_json(grid, "f1"))
    assert len(shown) == 28  # truth and result of 14 angles
    for curve in (curve for row in grid.rows for plot in row for curve in plot.curves):
        drawn = np.asarray(curve.y, np.float32)
        assert any(np.array_equal(y, drawn, equal_nan=True) for _, y in shown)


def test_a_page_loads_nothing_and_five_minutes_of_two_people_stay_below_4_mb():
    """With a truth. Noise, which no compression makes smaller; the times stand there once."""
    page = Page("two people")
    seconds = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.04, 9000))
    for _ in range(2):
        # 14 angles and 4 limbs of each side, with the truth; two errors
        values = [np.random.default_rng(k).normal(size=9000) for k in range(38)]
        page.figure(one_plot(seconds, *values))
    html = page.html()
    assert len(html.encode()) < 4_000_000
    outside = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert not re.findall(r"""(?:src|href)=["'](?!#)""", outside)


def test_a_long_curve_is_thinned_and_the_page_says_so():
    page = Page("long")
    grid = one_plot(np.arange(9000) / 30, np.sin(np.arange(9000)))
    page.figure(grid, "Angles.")
    (points,) = {len(x) for x, _ in curves_in(curves_json(grid, "f1"))}
    assert points == 4500
    assert "Angles. 1 of 2 instants is drawn." in page.html()


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
    drawn = curves_json(grid, "f1")
    bands = re.findall(r'"BoxAnnotation".*?"left":([\d.]+),"right":([\d.]+)', drawn)
    assert [[round(float(x), 3) for x in band] for band in bands] == [
        [0.1, 0.5], [0.3, 5.0], [0.1, 0.2], [5.2, 5.2]
    ]  # fmt: skip


def test_a_long_name_may_wrap_behind_the_signs_in_it():
    html = Page("Evaluation of two_people.hiros.mcap: /hiros/<x>").html()
    assert "<h1>Evaluation of two_<wbr>people.<wbr>hiros.<wbr>mcap: /hiros" in html
    assert "&lt;x&gt;" in html
