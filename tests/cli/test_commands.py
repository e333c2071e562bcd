"""``hiros info``, ``simulate``, ``config`` and ``warmup`` from outside."""

from __future__ import annotations

import gc
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hiros_cli import compiling
from hiros_cli.app import run
from hiros_cli.commands import program
from hiros_cli.commands.simulate import simulate_params
from hiros_cli.compiling import importing, independent, prepare
from hiros_cli.options import EXAMPLES
from hiros_mcap import __version__, kernels, progress, workers
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.log import open_log
from hiros_mcap.kernels import shipped
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.systems import SYSTEMS


def test_info_tells_cameras_frames_and_skeleton(crossing, capsys):
    assert run(["info", str(crossing)]) == 0
    text = capsys.readouterr().out
    assert "32 markers, 31 links" in text
    assert "fixed frame: world" in text
    assert text.count("(resolved)") == 3


def test_info_as_json(crossing, capsys):
    assert run(["info", str(crossing), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["fixed_frame"] == "world"
    assert len(data["markers"]) == 32
    for camera in data["cameras"]:
        assert camera["most_people"] == 2
        assert 25 < camera["rate_hz"] <= 30.5
        assert camera["frame"] == camera["name"]


def test_simulate_twice_gives_the_same_bytes_and_a_readable_log(tmp_path):
    options = ["--seconds", "0.5", "--people", "1", "--cameras", "2", "--seed", "3", "-q"]
    for name in ("a.mcap", "b.mcap"):
        assert run(["simulate", str(tmp_path / name), *options]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    with open_log(tmp_path / "a.mcap") as log:
        assert len(log.cameras) == 2
        assert log.fixed_frame == "world"
        assert any(frame.n_people == 1 for frame in log.frames())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--people", "99"], "--people: should be less than or equal to 10, is 99"),
        (["--action", "fly"], "--action: should be 'walk', 'squat'"),
        (["--detector", "radar"], "--detector: should be 'ideal' or 'kinect', is 'radar'"),
        (["--rate", "0"], "--rate: should be greater than 0"),
        (["--seconds", "many"], "Invalid value for '--seconds'"),
        (["--seconds", "inf"], "--seconds: should be less than or equal to 86400, is inf"),
        (["--rate", "1e6"], "--rate: should be less than or equal to 1000"),
        (["--noise", "inf"], "--noise: should be less than or equal to 100, is inf"),
        (["--rate", "1000", "--seconds", "3600"], "GB of memory, more than 16; make it shorter"),
    ],
)
def test_simulate_refuses_in_one_line(options, said, tmp_path, capsys):
    assert run(["simulate", str(tmp_path / "out.mcap"), *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert list(tmp_path.iterdir()) == []


def test_the_help_of_simulate_states_the_defaults_that_hold(capsys):
    assert run(["simulate", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    stated = dict(re.findall(r"--([a-z-]+) (?:(?!--).)*?Default: (\w+)\.", text))
    defaults = SimulateParams()
    assert float(stated.pop("rate")) == defaults.rig.rate
    assert stated.pop("camera", "depth") == "depth"
    assert stated.pop("joints", "coco") == "coco"
    for name, value in stated.items():
        key = name.replace("-", "_")
        default = getattr(defaults if hasattr(defaults, key) else defaults.rig, key, value)
        default = getattr(default, "kind", default)
        assert value == default or float(value) == default
    assert len(stated) >= 13


def test_the_help_of_simulate_states_the_bounds_that_hold(capsys):
    assert run(["simulate", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    stated = re.findall(r"--([a-z-]+) (?:(?!--).)*?at most (\d+)\.", text)
    assert [name for name, _ in stated] == ["people", "cameras", "seconds", "rate"]
    for name, bound in stated:
        with pytest.raises(ConfigError, match=rf"--{name}: .* {bound}, is"):
            simulate_params({name: int(bound) + 1})
    assert "real depth camera has, at most 100." in text


def test_config_prints_the_sections_of_the_system(capsys):
    assert run(["config", "--system", "malaguti", "--all"]) == 0
    sections = tomllib.loads(capsys.readouterr().out).keys()
    assert [*sections] == ["input", "output", "associate", "kalman", "straighten"]
    assert run(["config", "--system", "nobody"]) == 2


def test_config_takes_the_system_as_its_argument(capsys):
    printed = []
    for arguments in (["lee"], ["--system", "lee"], ["lee", "--system", "lee"]):
        assert run(["config", *arguments]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] == printed[2] != ""
    assert run(["config", "lee", "--system", "fuse"]) == 2
    assert "name one system: lee or --system fuse" in capsys.readouterr().err


def test_a_long_compilation_without_a_bar_says_each_while_that_it_goes_on(monkeypatch, capsys):
    monkeypatch.setattr(progress, "MINUTE_S", 0.1)
    monkeypatch.setattr(compiling, "_POLL_S", 0.01)
    files = {"hiros_mcap.kernels.cdr": [Path("ready"), Path("other")]}
    monkeypatch.setattr(workers, "run_tasks", lambda *_: (time.sleep(t) for t in (0.3, 0.0)))
    compiling._compile(files, quiet=False)
    assert "hiros: compiling kernels: 1 min" in capsys.readouterr().err
    compiling._compile(files, quiet=True)
    assert capsys.readouterr().err == ""


def test_warmup_says_when_it_is_done(capsys):
    assert run(["warmup"]) == 0
    assert capsys.readouterr().out.startswith("kernels ready after ")


def test_imports_at_the_top_level_are_found():
    source = (
        "from hiros_mcap.kernels import cdr, batch as b  # both\n"
        "from hiros_mcap.frames import (\n    Block,\n    join,\n)\n"
        "import numpy\n"
        "def f():\n    from hiros_mcap.kernels import encode\n"
    )
    names = kernels.imported(source)
    assert {"hiros_mcap.kernels.cdr", "hiros_mcap.kernels.batch", "hiros_mcap.frames"} <= {*names}
    assert not any("encode" in name for name in names)


def test_no_kernel_is_compiled_by_two_processes():
    sources = kernels.sources()
    groups = independent(sources)
    assert sorted(chain(*groups)) == sorted(sources)
    for group in groups:
        for name in group:
            assert sources.keys() & kernels.imported(sources[name]) <= {*group}


def test_modules_that_share_a_third_are_compiled_together():
    use, other = "from hiros_mcap.a import f", "longer than all others" * 9
    texts = {"hiros_mcap.a": "", "hiros_mcap.b": use, "hiros_mcap.c": use, "hiros_mcap.d": other}
    groups = [["hiros_mcap.d"], ["hiros_mcap.a", "hiros_mcap.b", "hiros_mcap.c"]]
    assert independent(texts) == groups


def test_two_cores_share_the_compilation():
    sources = kernels.sources()
    sizes = [sum(len(sources[name]) for name in group) for group in independent(sources)]
    assert max(sizes) < 0.6 * sum(sizes)


def test_kernels_that_all_others_need_are_compiled_first():
    sources = kernels.sources()
    groups = independent(sources)
    needed = [sources.keys() & frozenset().union(*map(kernels.reached, g)) - {*g} for g in groups]
    assert "hiros_mcap.kernels.people_rows" in groups[0]
    assert [bool(names) for names in needed] == sorted(map(bool, needed))


def test_what_is_compiled_in_advance_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("HIROS_KERNELS", "compile")
    found, module = [], "hiros_mcap.kernels.local_line"
    for _ in range(2):
        code = (
            "from hiros_mcap.kernels import load, missing, sources; "
            f"load([{module!r}]); print({{*sources()}} - {{*missing()}} == {{{module!r}}})"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
        assert done.stdout == b"True\n"
        found.append({path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")})
    assert found[0] == found[1]
    assert any(path.name.startswith(f"{module}.") for path in found[0])


def test_a_changed_callee_is_compiled_again(tmp_path, monkeypatch):
    package = tmp_path / "hiros_mcap"
    shutil.copytree(Path(kernels.__file__).parent.parent, package)
    monkeypatch.setattr(kernels, "_PACKAGE", package)
    names = ("hiros_mcap.stages.track.tracking", "hiros_mcap.kernels.encode")
    folders = []
    for _ in range(2):
        kernels.digest.cache_clear()
        folders.append([kernels.folder_of(name) for name in names])
        with (package / "kernels" / "distance.py").open("a") as source:
            source.write("# edited\n")
    kernels.digest.cache_clear()
    assert [a == b for a, b in zip(*folders, strict=True)] == [False, True]


def test_a_configuration_needs_no_kernels():
    code = "import sys, hiros_mcap.config; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numba", "scipy", "hiros_mcap.kernels"} & {*done.stdout.split()}


def test_a_run_imports_its_own_stages_only(tmp_path):
    log, out = "sample_data/one_person_walking.mcap", str(tmp_path / "o.mcap")
    code = (
        "import sys; from hiros_cli.app import run; "
        f"run(['process', {log!r}, '-o', {out!r}, '--quiet']); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    modules = {*done.stdout.split()}
    prefix = "hiros_mcap.stages."
    assert {f"{prefix}{name}" for name in ("track.tracking", "fuse.fusing")} <= modules
    others = ("merge.merging", "optimize.energy", "lee.clustering", "detections.facing_live")
    assert not {f"{prefix}{name}" for name in others} & modules


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
@pytest.mark.parametrize(("variables", "shared"), [({}, True), ({"MALLOC_ARENA_MAX": "8"}, False)])
def test_threads_share_a_heap_unless_the_user_wants_more(variables, shared):
    code = (
        "import ctypes, threading\n"
        "from hiros_cli.compiling import prepare\n"
        "prepare(quiet=True)\n"
        "libc, ready = ctypes.CDLL(None), threading.Barrier(5)\n"
        "def work():\n"
        "    libc.malloc(100)\n"
        "    ready.wait()\n"
        "for _ in range(4):\n"
        "    threading.Thread(target=work).start()\n"
        "ready.wait()\n"
        "stdout = ctypes.c_void_p.in_dll(libc, 'stdout')\n"
        "libc.malloc_info(0, stdout)\n"
        "libc.fflush(stdout)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "MALLOC_ARENA_MAX"} | variables
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert (done.stdout.count("<heap") == 1) == shared


def test_nothing_is_collected_while_a_command_imports():
    with importing():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.unfreeze()


@pytest.fixture
def full_cache(tmp_path, monkeypatch):
    """A folder for kernels that takes none: it is read-only, and for root the disk is full."""
    monkeypatch.setenv("HIROS_KERNELS", "compile")
    shipped.usable.cache_clear()
    kernels.is_private.cache_clear()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    files = [file for paths in kernels.missing().values() for file in paths]
    folder = kernels.cache_folder()
    folder.mkdir(mode=0o755, parents=True)
    for file in files:
        file.parent.mkdir(mode=0o755, exist_ok=True)
        file.touch()
    yield files
    folder.chmod(0o755)
    shipped.usable.cache_clear()
    kernels.is_private.cache_clear()


def test_a_complete_cache_is_used_where_nothing_can_be_written(full_cache, tmp_path):
    kernels.cache_folder().chmod(0o555)
    prepare(quiet=True)
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "kernels")


@pytest.mark.parametrize("fault", ["it is full", "other users may write there"])
def test_else_kernels_go_to_a_folder_of_the_process_and_a_line_says_why(fault, full_cache, capsys):
    if fault == "it is full":
        full_cache[7].unlink()
    else:
        kernels.cache_folder().chmod(0o777)
    prepare(quiet=True)
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.name.startswith("hiros-kernels-")
    assert folder.is_dir()
    (line,) = capsys.readouterr().err.splitlines()
    assert f": {fault}" in line
    assert line.endswith(", or name a folder of your own in NUMBA_CACHE_DIR")


def test_nothing_is_taken_from_the_folder_in_which_one_stands(tmp_path):
    (tmp_path / "multiprocessing.py").write_text("raise SystemExit('taken')")
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"no log")
    hiros = Path(sys.executable).with_name("hiros")
    command = [hiros, "process", "a.mcap", "b.mcap", "-o", "out", "--jobs", "2"]
    done = subprocess.run(command, check=False, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("is not an MCAP file")) == (2, 2)
    assert "taken" not in done.stdout + done.stderr


def test_systems_are_listed_once_with_their_chains(capsys):
    assert run(["systems"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert sorted(row[0] for row in rows) == sorted(SYSTEMS)
    (malaguti,) = (row for row in rows if row[0] == "malaguti")
    assert malaguti[-3:] == ["T,", "TM,", "TMO"]
    (lee,) = (k for k, row in enumerate(rows) if row[0] == "lee")
    assert [row[0] for row in rows[lee + 1 :]] == ["lee-a1", "lee-a2", "lee-a3", "lee-a4"]


def test_calibrate_noise_prints_what_config_reads(tmp_path, capsys):
    from hiros_mcap.simulate.simulation import write_log

    log, config = tmp_path / "still.mcap", tmp_path / "noise.toml"
    params = {"people": 1, "cameras": 2, "seconds": 4, "action": "free_static", "flips": 0.0}
    write_log(log, SimulateParams.model_validate(params))
    assert run(["calibrate", "noise", str(log), "--window", "1:3"]) == 0
    captured = capsys.readouterr()
    assert "somebody moved" not in captured.err
    config.write_text(captured.out)
    assert 0.005 < load_config(config).kalman.measurement_noise < 0.2
    assert run(["calibrate", "noise", str(log), "--window", "50:60"]) == 2
    assert "no camera sees anybody twice" in capsys.readouterr().err


@pytest.mark.parametrize("options", [[], ["--json"]], ids=["toml", "json"])
def test_calibrate_noise_warns_beside_its_output_when_people_walk(options, whole_walking, capsys):
    assert run(["calibrate", "noise", str(whole_walking), *options]) == 0
    captured = capsys.readouterr()
    assert "hiros: warning: joints scatter by 55 cm about their mean" in captured.err
    assert "hiros: warning" not in captured.out


COMMANDS = (
    *("process", "view", "plot", "export", "eval", "check", "compare", "info", "simulate"),
    *("systems", "config", "warmup", "recover", "import"),
    *("calibrate", "calibrate people", "calibrate ball", "calibrate board", "calibrate noise"),
)


def test_options_of_a_run_are_in_groups(capsys):
    assert run(["process", "--help"]) == 0
    text = capsys.readouterr().out
    titles = ["Arguments:", "Output:", "Parameters:", "Input:", "Many logs:"]
    assert re.findall(r"^[A-Z].*:$", text, re.MULTILINE) == [*titles, "Options:", "Examples:"]
    assert text.count("--set") == 2  # its row, and an example


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines])
def test_examples_are_commands(line):
    command: Any = program()
    arguments = shlex.split(line.split(" > ")[0])[1:] if line.startswith("hiros") else []
    while arguments and hasattr(command, "commands"):
        command, arguments = command.commands[arguments[0]], arguments[1:]
    if arguments:
        command.make_context(command.name, arguments)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_no_python_types(command, capsys):
    assert run([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert not re.findall(r"<\w+|\bPath\b|\{[A-Z]|[<>]=|\[default: \(", text)
    assert max(map(len, text.splitlines())) <= 100


def test_the_version_and_help_have_the_spellings_that_people_try(capsys):
    assert run(["-V"]) == 0
    assert capsys.readouterr().out == f"hiros {__version__}\n"
    assert run(["export", "--help"]) == 0
    shown = capsys.readouterr().out
    assert run(["help", "export"]) == 0
    assert capsys.readouterr().out == shown
    assert run(["help"]) == 0
    assert "process" in capsys.readouterr().out
    assert run(["calibrate"]) == 2
    assert "people" in capsys.readouterr().out


def test_demo_writes_a_log_and_names_what_comes_next(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["demo"]) == 0
    first, process, view = capsys.readouterr().out.splitlines()
    assert first == "wrote demo.mcap; go on with"
    assert Path("demo.mcap").stat().st_size < 8e6
    assert run([*shlex.split(process)[1:], "-q"]) == 0
    assert run([*shlex.split(view)[1:], "--save", "demo.rrd", "--time-range", "0:1", "-q"]) == 0
    capsys.readouterr()
    assert run(["eval", "demo.hiros.mcap", "--channel", "/hiros/filtered", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["true_people"] == [0, 1]
    Path("demo.mcap").write_bytes(b"mine")
    assert run(["demo", "-q"]) == 2
