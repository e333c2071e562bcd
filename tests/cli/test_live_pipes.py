"""``hiros process - -o -`` as a Unix tool."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader
from whole_commands import first_seconds

from hiros_cli.app import run as hiros
from hiros_mcap.io.container import McapReader
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

HIROS = [sys.executable, "-m", "hiros_cli"]
TWO_PASS = ["--system", "hiros-realtime", "--set", "optimize.calibration=two-pass"]


def topics(data):
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    return {channel.topic for _, channel, _ in reader.iter_messages(log_time_order=False)}


def messages_of(path):
    """Messages of each camera."""
    with McapReader(path) as reader:
        topics = {i: channel.topic for i, channel in reader.channels.items()}
        return {topics[i]: n for i, n in reader.counts.items() if "camera" in topics[i]}


def test_a_pipe_in_and_a_pipe_out(crossing):
    with crossing.open("rb") as file:
        done = subprocess.run(
            [*HIROS, "process", "-", "-o", "-"], stdin=file, capture_output=True, check=True
        )
    assert {"/hiros/filtered", "/tf_static", "/truth/skeletons"} <= topics(done.stdout)
    assert b"camera_0" in done.stderr  # the summary


def test_a_reader_that_has_seen_enough(crossing):
    with crossing.open("rb") as file:
        run = subprocess.Popen(
            [*HIROS, "process", "-", "-o", "-", "-q"],
            stdin=file,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert run.stdout is not None
        assert run.stderr is not None
        run.stdout.read(100)
        run.stdout.close()
        assert run.wait(120) == 128 + signal.SIGPIPE
        assert run.stderr.read() == b""
        run.stderr.close()


def is_read(path):
    """Whether this process has read an open file to its end."""
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if link.readlink() == path:
                place = Path("/proc/self/fdinfo", link.name).read_text().split()[1]
                return int(place) == path.stat().st_size
    return False


@pytest.mark.skipif(not Path("/proc/self/fdinfo").exists(), reason="no /proc")
def test_a_file_that_grows_is_read_to_its_end(walking, tmp_path):
    growing, out, data = tmp_path / "growing.mcap", tmp_path / "out.mcap", walking.read_bytes()
    growing.write_bytes(data[:1000])
    latest = time.monotonic() + 60

    def grow():
        while not is_read(growing) and time.monotonic() < latest:
            time.sleep(0.01)
        time.sleep(0.2)
        with growing.open("ab") as file:
            file.write(data[1000:])

    thread = threading.Thread(target=grow)
    thread.start()
    assert hiros(["process", str(growing), "--follow", "-o", str(out), "-q"]) == 0
    thread.join()
    assert messages_of(out).items() >= messages_of(walking).items()


@pytest.mark.parametrize("change", ["cut short", "begun anew", "replaced"])
def test_a_file_that_cannot_grow_any_more_ends_with_a_warning(change, crossing, tmp_path):
    growing, other = tmp_path / "growing.mcap", tmp_path / "other.mcap"
    data = crossing.read_bytes()
    growing.write_bytes(data[:-100])  # the end mark is still to come
    command = [*HIROS, "process", str(growing), "--follow", "-o", str(tmp_path / "out.mcap")]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert run.stderr is not None
    while "running" not in run.stderr.readline():
        pass
    time.sleep(1)
    if change == "replaced":
        other.write_bytes(data)
        other.replace(growing)
    else:
        growing.write_bytes(data[:1000] if change == "begun anew" else b"")
    _, text = run.communicate(timeout=120)
    assert run.returncode == 0
    assert "warning: the file was cut short or replaced by another while it was followed" in text
    assert messages_of(tmp_path / "out.mcap")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_input(number, crossing, tmp_path):
    growing, out = tmp_path / "growing.mcap", tmp_path / "out.mcap"
    shutil.copy(crossing, growing)
    os.truncate(growing, crossing.stat().st_size - 100)  # the end mark is still to come
    run = subprocess.Popen(
        [*HIROS, "process", str(growing), "--follow", "-o", str(out)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    assert run.stderr is not None
    while "running" not in run.stderr.readline():
        pass
    time.sleep(1)
    run.send_signal(number)
    assert run.wait(120) == 0
    run.stderr.close()
    assert "/hiros/filtered" in topics(out.read_bytes())


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["-"], "name the output"),
        (["LOG", "-o", "-"], "add --follow"),
        (["-", "--follow", "-o", "-"], "is live anyway"),
        (["nowhere.mcap", "--follow"], "does not exist yet"),
        (["-", "-o", "-", "--unit", "mm"], "are for files"),
        (["-", "-o", "-", "--model", "kinect-v2"], "are for files"),
        (["-", "-o", "-", "--strict"], "are for files"),
        (["-", "-o", "bag/"], "process writes MCAP"),
        (["-", "-o", "-", *TWO_PASS], "reads the whole log first"),
        (["-", "-o", "-", "--recover"], "are for files"),
    ],
)
def test_what_cannot_be_live(arguments, fault, crossing, tmp_path, monkeypatch, capfd):
    given = [str(crossing) if text == "LOG" else text for text in arguments]
    monkeypatch.chdir(tmp_path)
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert hiros(["process", *given]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert fault in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("redirection", "fault"), [("<&-", "standard input is closed"), (">&-", "output is closed")]
)
def test_a_stream_that_is_closed_is_named(redirection, fault, crossing, tmp_path):
    command = f'"$0" -m hiros_cli process - -o - {redirection}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert fault in done.stderr
    assert done.stderr.count("\n") == 1


SERVER = """
import json, struct, sys, threading
from websockets.sync.server import serve

def publish(socket):
    channel = dict(id=1, topic="/camera/skeletons", encoding="cdr", schemaEncoding="ros2msg",
                   schemaName="hiros_skeleton_msgs/msg/SkeletonGroup", schema="float64 x\\n")
    socket.send(json.dumps({"op": "advertise", "channels": [channel]}))
    socket.recv()
    socket.recv_messages.pause()  # reads nothing any more, not even a farewell
    time = 0
    while True:
        time += 10_000_000
        socket.send(b"\\x01" + struct.pack("<IQ", 1, time) + bytes(100_000))

with serve(publish, "127.0.0.1", 0) as server:
    print(server.socket.getsockname()[1], flush=True)
    server.serve_forever()
"""


def test_a_run_that_fails_ends_though_the_server_goes_on(tmp_path):
    pytest.importorskip("websockets")
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert server.stdout is not None
        url = f"ws://127.0.0.1:{server.stdout.readline().strip()}"
        done = subprocess.run(
            [*HIROS, "process", url, "-o", str(tmp_path / "out.mcap"), "-q"],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
    finally:
        server.kill()
        server.communicate()
    assert done.returncode == 2
    assert done.stderr.startswith(f"hiros: error: {url}: /camera/skeletons: schema is not that of")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@contextlib.contextmanager
def serving(*options):
    """Yield a hiros that serves what it makes of its standard input, and its address."""
    pytest.importorskip("foxglove")
    run = subprocess.Popen(
        [*HIROS, "process", "-", "-o", "ws://:0", *options],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    assert run.stdin is not None
    assert run.stderr is not None
    try:
        address = ""
        while "serving" not in (line := run.stderr.readline().decode()):
            assert line, "it ended"
        address = line.split()[-1]
        yield run, address
    finally:
        run.kill()
        run.wait()
        run.stdin.close()
        run.stderr.close()


def test_another_hiros_reads_what_is_served(whole_crossing, tmp_path):
    """It joins when the static transforms are long sent, and gets them again."""
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    data = first_seconds(whole_crossing, 4.0, log).read_bytes()
    with serving("--markers") as (run, address):
        assert address.startswith("ws://127.0.0.1:")  # nobody else on the network
        run.stdin.write(data[: len(data) // 2])
        run.stdin.flush()
        while "running" not in run.stderr.readline().decode():
            pass
        command = f"process {address} -o {out} --keep /hiros/markers --keep /tf*"
        reader = subprocess.Popen([*HIROS, *command.split()], stderr=subprocess.PIPE)
        assert reader.stderr is not None
        assert b"listening" in reader.stderr.readline()
        time.sleep(1)
        for at in range(len(data) // 2, len(data), 20_000):
            run.stdin.write(data[at : at + 20_000])
            run.stdin.flush()
            time.sleep(0.02)
        run.stdin.close()
        assert run.wait(120) == 0
        assert reader.wait(120) == 0
        reader.stderr.close()
    with McapReader(out) as log:
        counts = {log.channels[i].topic: n for i, n in log.counts.items()}
    assert counts["/tf_static"] > 0
    assert counts["/hiros/markers"] > 20
    assert counts["/hiros/filtered"] > 20


def test_a_client_that_does_not_read_loses_messages_and_does_not_stop_the_run(tmp_path):
    client_of = pytest.importorskip("websockets.sync.client")
    broken = pytest.importorskip("websockets.exceptions").WebSocketException
    log = tmp_path / "log.mcap"
    write_log(log, SimulateParams(people=2, cameras=4, seconds=9))  # more than waits for a client
    data, mode = log.read_bytes(), {"subprotocols": ["foxglove.sdk.v1"], "max_queue": 1}
    with (
        serving() as (run, address),
        client_of.connect(address, compression=None, ping_interval=None, **mode) as client,
    ):
        begin = len(data) // 6
        run.stdin.write(data[:begin])
        run.stdin.flush()
        while "running" not in run.stderr.readline().decode():
            pass
        topics = []
        while len(topics) < 8:
            entry = json.loads(client.recv(timeout=60))
            topics += [c["id"] for c in entry.get("channels", ())]
        pairs = [{"id": k, "channelId": ident} for k, ident in enumerate(topics)]
        client.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))
        run.stdin.write(data[begin:])
        run.stdin.close()
        assert run.wait(120) == 0
        got = 0
        with contextlib.suppress(broken):
            for _ in client:
                got += 1
    with McapReader(log) as reader:
        assert got < sum(reader.counts.values())


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("ws://127.0.0.1:99999", "Port out of range 0-65535; a server is at ws://HOST:PORT"),
        ("ws://127.0.0.1:abc", "as 'abc'; a server is at"),
        ("ws://[::1", "Invalid IPv6 URL; a server is at"),
        ("ws://:8765", "names no host; a server is at"),
        ("ws://a..b:80", "a server is at"),
        ("ws://127.0.0.1:1/\x1b[31m", "no Foxglove WebSocket server answers"),
    ],
)
def test_what_is_no_address_of_a_server(source, fault, tmp_path, capfd):
    pytest.importorskip("websockets")
    assert hiros(["process", source, "-o", str(tmp_path / "out.mcap")]) == 2
    shown = capfd.readouterr().err
    assert fault in shown
    assert "\x1b" not in shown
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("output", "fault"),
    [
        ("wss://127.0.0.1:1", "results are served at ws://HOST:PORT"),
        ("ws://127.0.0.1:70000", "out of range"),
        ("ws://nowhere.invalid:8765", "cannot be served"),
    ],
)
def test_what_cannot_be_served(output, fault, crossing, monkeypatch, capfd):
    pytest.importorskip("foxglove")
    with crossing.open("rb") as file:
        monkeypatch.setattr(sys, "stdin", file)
        assert hiros(["process", "-", "-o", output]) == 2
    assert fault in capfd.readouterr().err
