"""Logs in a store: a real S3-compatible server on the loopback address."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import fsspec
import pytest
from rosbag2_recorder import record, sample

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.remote import local_copy


@pytest.fixture(scope="module")
def server():
    """Start moto's server; yield its address."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        address = f"http://127.0.0.1:{port}"
        for _ in range(1200):
            try:
                urllib.request.urlopen(f"{address}/moto-api/", timeout=5).read()
                break
            except OSError:
                time.sleep(0.1)
        yield address
        process.terminate()


@pytest.fixture
def store(server, walking, monkeypatch):
    """Yield a file system with the bucket ``lab``, which has two logs."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    urllib.request.urlopen(urllib.request.Request(f"{server}/moto-api/reset", method="POST")).read()
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    system = fsspec.filesystem("s3")
    system.mkdir("lab")
    system.put_file(str(walking), "lab/in/mon/walk.mcap")
    system.put_file(str(walking), "lab/in/tue/walk.mcap")
    yield system
    system.clear_instance_cache()


def test_one_log_of_the_store(store, tmp_path, capsys):
    assert run(["info", "s3://lab/in/mon/walk.mcap", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["cameras"]) == 3
    out = tmp_path / "out.mcap"
    assert run(["process", "s3://lab/in/mon/walk.mcap", "-o", str(out), "-q"]) == 0
    assert out.stat().st_size > 600_000


def test_an_error_names_the_address_and_not_the_copy(walking):
    fsspec.filesystem("memory").pipe_file("/lab/cut.mcap", walking.read_bytes()[:300_000])
    address = "memory://lab/cut.mcap"
    with pytest.raises(LogError) as caught, local_copy(address) as path, McapReader(path):
        pass
    assert str(caught.value).startswith(f"{address}: truncated")
    assert f"hiros recover {address}" in str(caught.value)
    with pytest.raises(ConfigError, match=f"^{address}: no camera"), local_copy(address) as path:
        raise ConfigError(f"{path}: no camera")


@pytest.mark.parametrize("options", [{}, {"metadata": False}, {"storage": "sqlite3"}])
def test_a_folder_of_the_store_is_one_recording(store, options, tmp_path):
    for path in record(tmp_path / "lab", sample(), parts=3, **options).iterdir():
        store.put_file(str(path), f"lab/bags/lab/{path.name}")
    out = tmp_path / "out.mcap"
    assert run(["process", "s3://lab/bags/lab", "-o", str(out), "-q"]) == 0
    assert out.is_file()


def test_an_address_is_one_log(tmp_path, capsys):
    assert run(["info", "s3://lab/a.mcap", "s3://lab/b.mcap"]) == 2
    assert "s3://lab/a.mcap: an address is for one log; copy several" in capsys.readouterr().err


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_part_in_the_store_names_its_neighbours(store, storage, tmp_path, capsys):
    folder = record(tmp_path / "lab", sample(), parts=3, storage=storage)
    for path in folder.iterdir():
        store.put_file(str(path), f"lab/bags/lab/{path.name}")
    (part,) = folder.glob("lab_1.*")
    address = f"s3://lab/bags/lab/{part.name}"
    assert run(["process", address, "-o", str(tmp_path / "out.mcap")]) == 2
    text = capsys.readouterr().err
    assert f"{part.name.replace('1', '0')} and 1 more file beside it" in text
    assert "name the folder s3://lab/bags/lab instead" in text


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("s3://nowhere/walk.mcap", "does not exist: neither the file nor perhaps the bucket"),
        ("s3://lab/in/no.mcap", "does not exist"),
        ("nope://lab/walk.mcap", "nobody knows the protocol nope://"),
        ("http://127.0.0.1:1/walk.mcap", "cannot be reached; check the network"),
    ],
)
def test_a_log_that_is_not_there_is_one_line(address, said, store, capsys):
    assert run(["info", address]) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith(f"hiros: error: {address}: {said}")
    assert stderr.count("\n") == 1


def ask_for_keys(server, *, after):
    """Have the server accept a number of requests with any key, and then none."""
    headers = {"Content-Type": "text/plain"}
    address = f"{server}/moto-api/reset-auth"
    request = urllib.request.Request(address, data=after, headers=headers, method="POST")
    urllib.request.urlopen(request).read()


def test_a_wrong_key_is_one_line_with_the_remedy(server, store):
    ask_for_keys(server, after=b"0")
    try:
        with (
            pytest.raises(LogError, match="permission denied; sign in as"),
            local_copy("s3://lab/in/mon/walk.mcap"),
        ):
            pass
    finally:
        ask_for_keys(server, after=b"inf")


def test_a_copy_needs_room(store, monkeypatch):
    usage = shutil.disk_usage(os.curdir)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with (
        pytest.raises(LogError, match="no room for a copy"),
        local_copy("s3://lab/in/mon/walk.mcap"),
    ):
        pass


def test_a_copy_that_is_cut_off_is_no_log(store, monkeypatch):
    opened = type(store).open

    def cut(self, path, *args, **settings):
        file = opened(self, path, *args, **settings)
        monkeypatch.setattr(file, "size", file.size + 1)
        return file

    monkeypatch.setattr(type(store), "open", cut)
    with (
        pytest.raises(LogError, match=r"is cut off: \d+ of \d+ bytes came"),
        local_copy("s3://lab/in/mon/walk.mcap"),
    ):
        pass


@pytest.mark.parametrize("folder", ["https://lab.org/out/", "s3://lab/out"])
def test_results_go_to_this_machine(folder, walking, capsys):
    assert run(["process", str(walking), "-o", folder]) == 2
    assert f"{folder}: results go to a folder of this machine" in capsys.readouterr().err
