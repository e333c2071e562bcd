"""Logs in a store: a real S3-compatible server on the loopback address."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request

import fsspec
import pytest
from rosbag2_recorder import SINCE_LYRICAL, record, sample

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io import remote
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.remote import local_copy
from hiros_mcap.many.find import find_logs


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


def test_logs_of_the_store(store, walking, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    out = tmp_path / "out"
    command = ["process", "s3://lab/in/", "-o", str(out), "--jobs", "1", "-q"]
    assert run(command) == 0
    results = ["mon_walk.hiros.mcap", "tue_walk.hiros.mcap"]
    assert sorted(path.name for path in out.iterdir()) == ["hiros-process.json", *results]
    assert run(["process", str(walking), "-o", str(tmp_path / "here.mcap"), "-q"]) == 0
    assert (out / results[0]).read_bytes() == (tmp_path / "here.mcap").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"here.mcap", "out"}  # no copy is left
    (out / results[1]).unlink()
    before = (out / results[0]).stat()
    assert run(command) == 0  # takes up where the first stopped
    assert (out / results[0]).stat().st_mtime_ns == before.st_mtime_ns
    assert (out / results[1]).exists()


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


@pytest.mark.parametrize("names", ["{folder}_{k}", SINCE_LYRICAL])
@pytest.mark.parametrize(
    "options", [{}, {"metadata": False}, {"storage": "sqlite3", "mode": "file"}]
)
def test_the_parts_of_a_recording_in_the_store_are_one_log(store, names, options, tmp_path):
    folder = record(tmp_path / "lab", sample(), parts=3, names=names, **options)
    for path in folder.iterdir():
        store.put_file(str(path), f"lab/bags/lab/{path.name}")
    store.put_file(str(next(folder.glob("*0*"))), "lab/bags/other.mcap.txt")
    for text in ("s3://lab/bags/", "s3://lab/bags/*/*", "s3://lab/bags/lab/*1*"):
        assert find_logs([text]) == ["s3://lab/bags/lab"]
    command = ["process", "s3://lab/bags/", "-o", str(tmp_path / "out"), "--jobs", "1", "-q"]
    assert run(command) == 0
    assert [path.name for path in (tmp_path / "out").glob("*.mcap")] == ["lab.hiros.mcap"]


def test_files_whose_metadata_is_not_of_rosbag2_are_logs_of_their_own(store):
    store.pipe_file("lab/in/mon/metadata.yaml", b"title: our data")
    assert len(find_logs(["s3://lab/in/"])) == 2
    store.pipe_file("lab/in/mon/metadata.yaml", b"rosbag2_bagfile_information: {}")
    assert find_logs(["s3://lab/in/"]) == ["s3://lab/in/mon", "s3://lab/in/tue/walk.mcap"]


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


def test_a_bag_folder_of_the_store_is_one_log(store, walking, tmp_path):
    bag = tmp_path / "walk"
    assert run(["process", str(walking), "-o", f"{bag}/", "-q"]) == 0
    for path in bag.iterdir():
        store.put_file(str(path), f"lab/bags/walk/{path.name}")
    assert run(["info", "s3://lab/bags/", "--csv", str(tmp_path / "t.csv"), "-q"]) == 0
    assert (tmp_path / "t.csv").read_text().splitlines()[1].startswith("s3://lab/bags/walk,")


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
        with pytest.raises(LogError, match="permission denied; sign in as"):
            remote.size_and_date("s3://lab/in/mon/walk.mcap")
    finally:
        ask_for_keys(server, after=b"inf")


def test_a_copy_needs_room(store, monkeypatch):
    usage = shutil.disk_usage(os.curdir)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with (
        pytest.raises(LogError, match="no room for a copy"),
        remote.local_copy("s3://lab/in/mon/walk.mcap"),
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
        remote.local_copy("s3://lab/in/mon/walk.mcap"),
    ):
        pass


@pytest.mark.parametrize("folder", ["https://lab.org/out/", "s3://lab/out"])
def test_results_go_to_this_machine(folder, walking, capsys):
    assert run(["process", str(walking), "-o", folder]) == 2
    assert f"{folder}: results go to a folder of this machine" in capsys.readouterr().err
