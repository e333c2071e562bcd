"""Reports are one file that loads nothing."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from hiros_mcap.errors import LogError
from hiros_viewer.figures import Curve, CurveGrid, CurvePlot
from hiros_viewer.page import Page


def page():
    from matplotlib.figure import Figure

    result = Page("A <title> & more")
    result.heading("Errors")
    result.text("per joint")
    result.table(["joint", "mm"], [["<wrist>", "1.0"]], caption="Table")
    for _ in range(2):
        figure = Figure()
        figure.subplots().plot([0, 1], [0, 1], marker="o")
        result.figure(figure, "A line")
    ends = np.array([0.0, 1.0])
    plot = CurvePlot([Curve("knee", "#1f5fa8", ends, ends, has_dots=True)], (0.0, 1.0))
    result.figure(CurveGrid([[plot]], 3.0, (0.0, 1.0)), "A curve")
    return result


def test_the_page_is_self_contained_and_escaped(tmp_path):
    path = tmp_path / "report.html"
    page().write(path)
    text = path.read_text(encoding="utf-8")
    assert "&lt;wrist&gt;" in text
    assert "A &lt;title&gt; &amp; more" in text
    outside = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "<script>" not in outside
    assert not re.findall(r"""(?:src|href)=["'](?!#)|@import|url\((?!#)""", outside)
    assert "</script>" not in text.split("<script>")[2].split("</script>\n")[0]
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_ids_are_unique_and_every_reference_resolves():
    text = re.sub(r"<script>.*?</script>", "", page().html(), flags=re.DOTALL)
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    references = re.findall(r"url\(#([^)]+)\)", text) + re.findall(r'href="#([^"]+)"', text)
    assert references
    assert set(references) <= set(ids)


def test_a_page_that_cannot_be_written_leaves_nothing(tmp_path):
    target = tmp_path / "folder"
    target.mkdir()
    with pytest.raises(LogError, match="folder: cannot be written"):
        page().write(target)
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(("width", "cells"), [(390, [[0, 0], [1, 0]]), (1280, [[0, 0], [0, 1]])])
def test_a_telephone_gets_a_plot_per_row(width, cells):
    ends = np.array([0.0, 1.0])
    plot = CurvePlot([Curve("knee", "#1f5fa8", ends, ends)], (0.0, 1.0))
    result = Page("Knees")
    result.figure(CurveGrid([[plot, plot]], 3.0, (0.0, 1.0)))
    script = result.html().split("<script>")[2].split("</script>")[0]
    shown = (
        "console.log(JSON.stringify(item.doc.roots[0].attributes.children.map(c => [c[1], c[2]])))"
    )
    bokeh = f"globalThis.Bokeh = {{embed: {{embed_item(item) {{ {shown} }}}}}};"
    command = ["node", "-e", f"globalThis.innerWidth = {width}; {bokeh} {script}"]
    assert json.loads(subprocess.run(command, capture_output=True, check=True).stdout) == cells


def test_a_page_is_dark_where_the_reader_wants_that():
    style = page().html().split("<style>")[1].split("</style>")[0]
    assert "color-scheme: light dark" in style
    dark = style.split("@media (prefers-color-scheme: dark)")[1]
    assert "--page: #141414" in dark and "svg, .curves { filter: invert" in dark
