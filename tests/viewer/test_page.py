"""Reports are one file that loads nothing."""

from __future__ import annotations

import re

import pytest

from hiros_mcap.errors import LogError
from hiros_viewer.page import Page


def page():
    from matplotlib.figure import Figure

    result = Page("A <title> & more")
    result.heading("Errors")
    result.text("per joint")
    result.table(["joint", "mm"], [["<wrist>", "1.0"]], caption="Table")
    result.figure(Figure(), "A <line>")
    return result


def test_the_page_is_self_contained_and_escaped(tmp_path):
    path = tmp_path / "report.html"
    page().write(path)
    text = path.read_text(encoding="utf-8")
    assert "&lt;wrist&gt;" in text
    assert "A &lt;title&gt; &amp; more" in text
    assert 'alt="A &lt;line&gt;"' in text
    assert "<script" not in text
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:image/png)|@import|url\((?!#)""", text)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_a_page_that_cannot_be_written_leaves_nothing(tmp_path):
    target = tmp_path / "folder"
    target.mkdir()
    with pytest.raises(LogError, match="folder: cannot be written"):
        page().write(target)
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_page_is_dark_where_the_reader_wants_that():
    style = page().html().split("<style>")[1].split("</style>")[0]
    assert "color-scheme: light dark" in style
    dark = style.split("@media (prefers-color-scheme: dark)")[1]
    assert "--page: #141414" in dark and "img { filter: invert" in dark
