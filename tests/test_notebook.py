"""The notebook of the documentation runs, and its cells show what they say."""

from __future__ import annotations

import base64
import os
import sys
import warnings
from pathlib import Path

import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "walkthrough.ipynb"


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """The code cells, executed outside of any checkout."""
    book = nbformat.read(NOTEBOOK, as_version=4)
    with warnings.catch_warnings(action="ignore"), pytest.MonkeyPatch.context() as patch:
        from nbclient import NotebookClient

        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        resources = {"metadata": {"path": str(tmp_path_factory.mktemp("elsewhere"))}}
        NotebookClient(book, timeout=300, resources=resources).execute()
    return [cell for cell in book.cells if cell.cell_type == "code"]


def shown(cells, source, kind="text/plain"):
    """The output of the cell with this source."""
    (cell,) = (cell for cell in cells if source in cell.source)
    texts = [out["text"] if "text" in out else out["data"][kind] for out in cell.outputs]
    return str(texts[-1])


def test_the_repository_holds_no_outputs():
    book = nbformat.read(NOTEBOOK, as_version=4)
    assert 10 <= len(book.cells) <= 14
    assert not any(cell.get("outputs") for cell in book.cells)


def test_objects_are_one_line(cells):
    assert shown(cells, "summary.result()") == (
        "<Result demo.hiros.mcap /hiros/filtered: 2 people, 10.0 s, 32 markers>"
    )
    assert shown(cells, "hiros_mcap.process(").count("\n") == 0
    assert shown(cells, "hiros_mcap.process(").startswith("<Summary ")


@pytest.mark.parametrize("source", ["hiros_viewer.show(", "hiros_viewer.plot("])
def test_pictures_are_drawn(cells, source):
    png = base64.b64decode(shown(cells, source, "image/png"))
    assert png.startswith(b"\x89PNG")
    assert len(png) > 20_000


def test_tables_are_tables(cells):
    assert "WRIST_RIGHT" in shown(cells, "result.joints()", "text/html")
    assert "left knee flexion" in shown(cells, "result.angles()", "text/html")
    assert "track born" in shown(cells, "result.events()", "text/html")


def test_the_motion_leaves_as_trc(cells):
    assert shown(cells, "hiros_mcap.export(").startswith("PathFileType\t4\t(X/Y/Z)")
