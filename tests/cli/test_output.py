"""Files that commands may overwrite, and files that they may not: every kind that they write."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pytest

import hiros_mcap
from hiros_cli.app import run
from hiros_cli.output import check_outputs
from hiros_mcap.errors import LogError
from hiros_mcap.outputs import replacing
from hiros_mcap.running.pipeline import ProcessOptions

SAMPLE = Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap"
SUITE = '[[log]]\ninput = "walk.mcap"\nrequire = ["people = 1"]\n'


def check(target, *inputs, force=False, kind="log"):
    check_outputs((target, kind), inputs=inputs, force=force)


def test_a_new_file_may_be_written(tmp_path):
    check(tmp_path / "new.mcap")


def test_an_empty_file_may_be_replaced(tmp_path):
    target = tmp_path / "made-by-mktemp"
    target.touch()
    check(target)


def test_a_recording_is_not_replaced_without_force(tmp_path):
    target = tmp_path / "recording.mcap"
    target.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(LogError, match="--force"):
        check(target)
    check(target, force=True)


@pytest.mark.parametrize(
    ("name", "fault"),
    [(".", "is a folder"), ("missing/out.mcap", "no such folder"), ("pipe", "pipe")],
)
def test_what_no_file_can_be_is_refused_even_with_force(name, fault, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LogError, match=fault):
        check(tmp_path / name, force=True)


def test_an_input_is_refused_even_with_force_and_by_another_name(tmp_path):
    source, link = tmp_path / "in.mcap", tmp_path / "link.mcap"
    shutil.copy(SAMPLE, source)
    link.symlink_to(source)
    for name in (source, link, tmp_path / "." / "in.mcap"):
        with pytest.raises(LogError, match="is an input"):
            check(name, source, force=True)
        with pytest.raises(LogError, match="is an input"):
            check(name, tmp_path, force=True)


def test_two_outputs_must_differ(tmp_path):
    one, other = tmp_path / "a", tmp_path / "x" / ".." / "a"
    (tmp_path / "x").mkdir()
    with pytest.raises(LogError, match="written twice"):
        check_outputs((one, "log"), (other, "limb table"), inputs=(), force=True)


def test_a_failed_write_leaves_the_former_file(tmp_path):
    target = tmp_path / "page.html"
    target.write_text("before")
    with pytest.raises(KeyboardInterrupt), replacing(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert target.read_text() == "before"


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    target = tmp_path / "nowhere" / "a.html"
    fault = r"nowhere/a\.html: cannot be written: No such file"
    with pytest.raises(LogError, match=fault), replacing(target) as temporary:
        temporary.touch()


@pytest.fixture(scope="module")
def processed(short, tmp_path_factory):
    out = tmp_path_factory.mktemp("output") / "walk.hiros.mcap"
    hiros_mcap.process(short, out)
    return out


@pytest.fixture
def lab(short, processed, tmp_path):
    """A folder with a recording, its result, a suite, and somebody's notes."""
    shutil.copy(short, tmp_path / "walk.mcap")
    shutil.copy(processed, tmp_path / "result.mcap")
    (tmp_path / "suite.toml").write_text(SUITE)
    (tmp_path / "room.toml").write_text("")
    (tmp_path / "notes.html").write_text("<p>the only copy</p>")
    shutil.copy(tmp_path / "notes.html", tmp_path / "notes.png")
    return tmp_path


def contents(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


REFUSED = [
    ("process walk.mcap -o out.mcap --save-limbs out.mcap", "out.mcap: would be written twice"),
    ("process walk.mcap -o out.mcap --save-limbs walk.mcap", "walk.mcap: is an input"),
    (
        "process walk.mcap -o out.mcap --save-limbs notes.html",
        "notes.html: exists and is not a limb",
    ),
    ("process walk.mcap -o out.mcap --save-limbs no/x.toml", "no: no such folder"),
    ("process walk.mcap -o out.mcap --limbs l.toml --save-limbs l.toml", "l.toml: is an input"),
    ("process walk.mcap -o c.toml --config c.toml", "c.toml: is an input"),
    ("process walk.mcap -o walk.mcap --force", "walk.mcap: is an input"),
    ("process walk.mcap -o notes.html", "notes.html: exists and is not a log of hiros"),
    ("compare walk.mcap --system raw --html walk.mcap", "walk.mcap: is an input"),
    ("compare walk.mcap --system raw --html notes.html", "--force"),
    ("eval result.mcap --html result.mcap", "result.mcap: is an input"),
    ("eval result.mcap --html notes.html", "notes.html: exists and is not an HTML page of hiros"),
    ("eval result.mcap --html no/such.html", "no: no such folder"),
    ("eval result.mcap --truth walk.mcap --html walk.mcap", "walk.mcap: is an input"),
    ("plot result.mcap -o notes.html", "notes.html: exists and is not an HTML page of hiros"),
    ("plot result.mcap -o notes.png", "notes.png: exists and is not a PNG picture of hiros"),
    ("view walk.mcap --save walk.mcap", "walk.mcap: is an input"),
    ("view walk.mcap --save result.mcap", "result.mcap: exists and is not a Rerun recording"),
    ("check suite.toml --junit suite.toml", "suite.toml: is an input"),
    ("check suite.toml --junit walk.mcap --force", "walk.mcap: is an input"),
    ("check suite.toml --markdown notes.html", "notes.html: exists and is not a Markdown summary"),
    ("check suite.toml --junit a --markdown a", "a: would be written twice"),
    ("check suite.toml --keep .", "walk.mcap: is an input"),
    ("simulate room.toml --cameras room.toml --force", "room.toml: is an input"),
    ("calibrate people walk.mcap -o notes.html", "notes.html: exists and is not"),
    ("simulate notes.html", "notes.html: exists and is not a log of hiros"),
]


@pytest.mark.parametrize(("command", "said"), REFUSED, ids=[command for command, _ in REFUSED])
def test_what_must_stay_is_named_and_stays(command, said, lab, monkeypatch, capsys):
    monkeypatch.chdir(lab)
    if " --config" in command or " --limbs" in command:
        (lab / "c.toml").touch()
        (lab / "l.toml").write_text("[person.0.PELVIS]\nlength = 0.1\n")
    before = contents(lab)
    assert run(command.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert said in captured.err
    assert contents(lab) == before


AGAIN = [
    "process walk.mcap -o out.mcap --save-limbs limbs.toml -q",
    "compare walk.mcap --system raw --html page.html",
    "eval result.mcap --html page.html",
    "plot result.mcap -o page.html",
    "plot result.mcap -o page.png --what limbs",
    "view walk.mcap --save view.rrd",
    "check suite.toml --junit junit.xml --markdown sum.md --keep kept",
    "simulate new.mcap --seconds 0.2 --cameras 1 -q",
]


@pytest.mark.usefixtures("without_curves")
@pytest.mark.parametrize("command", AGAIN)
def test_what_hiros_wrote_is_replaced_by_the_next_run(command, lab, monkeypatch):
    monkeypatch.chdir(lab)
    before = {path.name for path in lab.iterdir()}
    assert run(command.split()) == 0
    after = {path.name for path in lab.iterdir()}
    assert after > before
    assert run(command.split()) == 0
    assert {path.name for path in lab.iterdir()} == after


@pytest.mark.usefixtures("without_curves")
def test_force_replaces_a_foreign_file(lab):
    page = lab / "notes.html"
    assert run(["eval", str(lab / "result.mcap"), "--html", str(page), "--force"]) == 0
    assert "Joints of" in page.read_text(encoding="utf-8")


def test_the_library_does_not_replace_a_foreign_file_either(tmp_path):
    target, limbs = tmp_path / "notes.txt", tmp_path / "limbs.toml"
    target.write_text("the only copy")
    limbs.write_text("the only copy")
    with pytest.raises(LogError, match="force=True overwrites it"):
        hiros_mcap.process(SAMPLE, target)
    with pytest.raises(LogError, match=r"limbs\.toml: exists"):
        options = ProcessOptions(limbs_out=limbs)
        hiros_mcap.process(SAMPLE, tmp_path / "out.mcap", options=options)
    assert target.read_text() == limbs.read_text() == "the only copy"
    assert not (tmp_path / "out.mcap").exists()
    hiros_mcap.process(SAMPLE, target, force=True)
    assert target.read_bytes().startswith(b"\x89MCAP0")


def test_an_unfinished_log_leaves_no_page(lab, capsys):
    page = lab / "page.html"
    (lab / "bad.mcap").write_bytes(b"no log at all")
    assert run(["eval", str(lab / "bad.mcap"), "--html", str(page)]) == 2
    assert not page.exists()
