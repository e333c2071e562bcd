"""The public names: they exist, are documented and typed, and their objects print one line."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

import hiros_mcap
import hiros_viewer
from hiros_mcap import kernels
from hiros_mcap.errors import ConfigError
from hiros_mcap.frames import Block
from hiros_mcap.io.result import Motion, Result
from hiros_mcap.kernels import shipped

PACKAGES = ("hiros_mcap", "hiros_viewer", "hiros_schemas")
DOCUMENTED = (Path(__file__).parents[1] / "docs" / "python.md").read_text(encoding="utf-8")


def section(package):
    """The table of a package in the documentation."""
    start = DOCUMENTED.index(f"| `{package}` |")
    return DOCUMENTED[start:].split("\n\n")[0]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist_and_are_documented_once(package):
    module = import_module(package)
    names = set(module.__all__)
    assert all(getattr(module, name) is not None for name in names)
    first_column = "".join(row.split("|")[1] for row in section(package).splitlines()[2:])
    documented = re.findall(r"`(\w+)[^`]*`", first_column)
    also = re.findall(r"`(\w+Error)`", section(package))
    assert set(documented) | set(also) == names
    assert set(dir(module)) >= names


@pytest.mark.parametrize("package", PACKAGES)
def test_public_functions_are_typed_and_described(package):
    module = import_module(package)
    assert Path(str(module.__file__)).with_name("py.typed").is_file()
    for name in module.__all__:
        value = getattr(module, name)
        if not callable(value) or "." not in getattr(value, "__module__", ""):
            continue
        assert inspect.getdoc(value), name
        if inspect.isfunction(value):
            signature = inspect.signature(value)
            kinds = [p.annotation for p in signature.parameters.values()]
            assert signature.empty not in [*kinds, signature.return_annotation], name


def test_frames_and_blocks_print_one_line():
    frame = seen([person(), person(2)], at(0), ids=[3, -1])
    assert repr(frame) == "<Frame a in world at 1700000000.000 s: 2 people (3, ?), 8 markers>"
    assert repr(Block.of(frame)) == "<Block 1 frames, 2 people>"
    assert repr(frame.people) == "<People 2 rows, 8 markers, 7 links>"
    assert repr(MODEL) == "<SkeletonModel 8 markers, 7 links>"


def result(people):
    """Somebody who stands still for a second."""
    times = np.arange(30) / 30
    still = np.repeat(person()[None], 30, axis=0)
    motions = {k: Motion(k, times, still + k, np.ones((30, 8))) for k in range(people)}
    return Result(Path("lab.mcap"), "/hiros/filtered", MODEL, "world", 0, motions)


def test_results_print_one_line_and_are_drawn():
    one = result(1)
    assert repr(one) == "<Result lab.mcap /hiros/filtered: 1 person, 1.0 s, 8 markers>"
    assert repr(one.motions[0]) == "<Motion person 0: 0.0 to 1.0 s, 30 instants, 8 markers>"
    picture = hiros_viewer.show(result(2))
    assert picture._repr_png_().startswith(b"\x89PNG")
    room, above = picture.figure.axes
    assert len(room.lines) == 2 * 5 * len(MODEL.links)
    assert [text.get_text() for text in above.get_legend().get_texts()] == ["person 0", "person 1"]


def test_nobody_is_no_picture():
    for draw in (hiros_viewer.show, hiros_viewer.plot):
        with pytest.raises(ConfigError, match="holds no people"):
            draw(result(0))


def test_a_summary_leads_to_its_result(walking, tmp_path):
    summary = hiros_mcap.process(walking, tmp_path / "out.mcap")
    assert summary.result().people == (0,)
    assert summary.result("/hiros/merged").channel == "/hiros/merged"
    assert re.fullmatch(
        r"<Summary [^/]*: 1 person, 1.* s of log in .* s, \d+ warnings?>", repr(summary)
    )
    with pytest.raises(ConfigError, match="wrote no log"):
        hiros_mcap.process(walking).result()


def test_who_imports_process_is_told_of_a_compilation(monkeypatch, caplog):
    monkeypatch.setattr(kernels, "missing", kernels.sources)
    monkeypatch.setattr(shipped, "usable", lambda: False)
    for _ in range(2):
        shipped.announce.cache_clear()
        hiros_mcap.__getattr__("Config")
    assert caplog.messages == []
    hiros_mcap.__getattr__("process")
    hiros_mcap.__getattr__("process")
    assert caplog.messages == [kernels.NOTICE]
    monkeypatch.setattr(shipped, "usable", lambda: True)
    shipped.announce.cache_clear()
    hiros_mcap.__getattr__("process")
    assert caplog.messages == [kernels.NOTICE]
