"""How the program ends: exit codes, one line instead of a traceback, signals, broken pipes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hiros_cli import app

SAMPLES = Path(__file__).parents[2] / "sample_data"

HIROS = [sys.executable, "-m", "hiros_cli"]


def hiros(*arguments, **options):
    return subprocess.run(  # type: ignore[call-overload, no-any-return]
        [*HIROS, *arguments], capture_output=True, text=True, check=False, **options
    )


def python(code):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_help_names_every_command_and_imports_nothing_heavy():
    code = "import sys; from hiros_cli.app import run; run(['--help']); print(sorted(sys.modules))"
    text = python(code)
    assert all(name in text for name in ("process", "info", "simulate", "config", "warmup"))
    assert not any(f"'{name}'" in text for name in ("numpy", "numba", "pydantic", "mcap"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["frobnicate"], "No such command 'frobnicate'. (see hiros --help)"),
        (["process", "--frobnicate"], "(see hiros process --help)"),
        (["process"], "Missing argument 'LOG'. (see hiros process --help)"),
        (["process", "missing.mcap"], "missing.mcap: No such file or directory"),
        (["process", "none*"], "none*: no log matches this pattern (.mcap, .bag, .db3)"),
        (["check", "none*"], "none*: no file matches this pattern"),
        (["view", "none*"], "none*: no file matches this pattern"),
        (["compare", "none*"], "none*: no file matches this pattern"),
        (
            ["view", f"{SAMPLES}/*.mcap"],
            "*.mcap: a pattern in quotes; this command takes the names of files",
        ),
        (["process", ""], "an argument is empty; is a variable not set?"),
        (["plot", "/"], "/: gives no name for the output; choose one with --output"),
        (["process", "/"], "with many logs, name a folder for the results: -o FOLDER"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(arguments, said, capsys):
    assert app.run(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("hiros: error: ")
    assert err.endswith(f"{said}\n")
    assert err.count("\n") == 1


def test_no_description_of_a_command_is_cut_at_80_columns():
    text = hiros("--help", env={**os.environ, "COLUMNS": "80"}).stdout
    assert "..." not in text.partition("Commands:")[2]
    assert max(map(len, text.splitlines())) <= 80


def test_no_command_shows_the_help():
    result = hiros()
    assert result.returncode == 2
    assert result.stdout.startswith("Usage: hiros")


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (MemoryError(), 2, "hiros: error: not enough memory\n"),
        (RuntimeError("can't start new thread"), 2, "hiros: error: not enough memory\n"),
        (OSError(28, "No space left on device", "x.mcap"), 2, "x.mcap: No space left on device\n"),
        (KeyError("tibia"), 70, "(this is a fault of hiros, not of your input; "),
    ],
)
def test_every_fault_ends_as_one_line(error, code, said, monkeypatch, capsys):
    def dispatch(_):
        raise error

    monkeypatch.setattr("hiros_cli.commands.dispatch", dispatch)
    assert app.run(["info"]) == code
    stderr = capsys.readouterr().err
    assert said in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize("kib", [60_000, 100_000, 180_000, 300_000, 450_000])
def test_too_little_memory_is_one_line(kib, walking, tmp_path):
    limited = f'ulimit -v {kib}; exec "$@"'
    command = ["bash", "-c", limited, "bash", *HIROS, "process", str(walking), "-o", "out.mcap"]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("hiros: error: not enough memory")
    assert (result.stdout, result.stderr.count("\n")) == ("", 1)
    assert not list(tmp_path.iterdir())


def test_debug_shows_where_an_error_comes_from():
    result = hiros("process", "missing.mcap", "--debug")
    assert result.returncode == 2
    assert "Traceback" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("hiros: error: ")


def test_a_reader_that_leaves_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    result = subprocess.run([*HIROS, "--help"], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_one_line():
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(
            [*HIROS, "--version"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert result.returncode == 2
    assert result.stderr == "hiros: error: No space left on device\n"


def test_closed_standard_streams_are_no_error():
    result = subprocess.run(
        ["sh", "-c", '"$0" -m hiros_cli --version <&- >&- 2>&-', sys.executable], check=False
    )
    assert result.returncode == 0


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_stops_the_compilation_without_a_traceback(name, tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "HIROS_KERNELS": "compile"}
    with subprocess.Popen([*HIROS, "warmup"], stderr=subprocess.PIPE, env=environment) as run:
        assert run.stderr is not None
        assert b"compiling kernels" in run.stderr.readline()
        run.send_signal(getattr(signal, name))
        assert run.stderr.read() == b""
    assert run.returncode == 128 + getattr(signal, name)


def test_a_signal_that_the_parent_ignores_stays_ignored():
    code = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from hiros_cli.app import Stop; Stop().catch()\n"
        "signal.raise_signal(signal.SIGHUP); print('alive')"
    )
    assert python(code) == "alive\n"


INTERRUPTED = """
import signal, sys, threading
from hiros_cli import app

def interrupt():
    signal.raise_signal(signal.SIGHUP)

class Lost:
    def __del__(self):
        interrupt()

def in_del():
    del [Lost()][0]
    while True:
        pass

def as_another_error():
    try:
        interrupt()
    finally:
        raise RuntimeError("cannot release un-acquired lock")

def in_the_report():
    app._report = lambda error, debug: interrupt()
    raise KeyError("tibia")

def with_a_lock():
    condition = threading.Condition()
    lock = condition._lock

    class Lock:
        def __enter__(self):
            lock.__enter__()
            interrupt()  # within threading.Condition.__enter__

        def __exit__(self, *error):
            lock.__exit__(*error)

    condition._lock = Lock()
    try:
        with condition:
            while True:
                pass
    finally:
        thread = threading.Thread(target=lock.acquire)
        thread.start()
        thread.join()

app._run = lambda arguments: globals()[arguments[0]]()
code = app.run(sys.argv[1:])
interrupt()  # too late to matter
sys.exit(code)
"""


@pytest.mark.parametrize("where", ["in_del", "as_another_error", "in_the_report", "with_a_lock"])
def test_a_signal_anywhere_ends_the_program_silently(where):
    command = [sys.executable, "-c", INTERRUPTED, where]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20)
    assert (result.returncode, result.stdout, result.stderr) == (129, "", "")
