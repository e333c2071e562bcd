"""Who may connect to the results, how many, and what a client that does not read costs."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from hiros_mcap.io import client_gate
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.io.foxglove_server import FoxgloveServer

pytest.importorskip("foxglove")
websockets = pytest.importorskip("websockets")
client = pytest.importorskip("websockets.sync.client")

PROTOCOL, MEGABYTE = ["foxglove.sdk.v1"], 1 << 20
connect = client.connect


@contextmanager
def server(lines):
    """Yield a server with one channel, and what publishes a message there."""
    made = FoxgloveServer("ws://:0", lines.append)
    try:
        writer = LiveWriter(made)
        channel = writer.add_channel("/numbers", writer.add_schema("Numbers", b"int32[] x"))

        def publish(number):
            writer.write(channel, number + 1, number.to_bytes(4, "little") * (MEGABYTE // 4))
            writer.flush()

        writer.flush()
        yield made, publish
    finally:
        made.discard()


def subscribed(stack, url, **options):
    """Connect a client that subscribes to the channel."""
    options |= {"subprotocols": PROTOCOL, "compression": None, "max_size": None, "close_timeout": 0}
    connection = stack.enter_context(connect(url, **options))
    while (entry := json.loads(connection.recv(timeout=20)))["op"] != "advertise":
        pass
    pairs = [{"id": 1, "channelId": entry["channels"][0]["id"]}]
    connection.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))
    return connection


def memory():
    """Bytes that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def sent(publish, numbers, good):
    """Send messages of a megabyte; return those that the good client has got."""
    got = []
    for number in numbers:
        publish(number)
        data = good.recv(timeout=20)
        while not isinstance(data, bytes):
            data = good.recv(timeout=20)
        got.append(int.from_bytes(data[-4:], "little"))
    return got


def test_the_seventeenth_client_is_refused_with_a_reason():
    lines = []
    with server(lines) as (made, _), ExitStack() as stack:
        clients = [subscribed(stack, made.url) for _ in range(16)]
        for _ in range(2):
            with pytest.raises(websockets.exceptions.InvalidStatus) as refused, connect(made.url):
                pass
            assert refused.value.response.status_code == 503
            assert b"hiros serves 16 clients at most" in refused.value.response.body
        clients[3].close()
        time.sleep(0.2)
        subscribed(stack, made.url)
    (line,) = lines
    assert line.startswith("127.0.0.1:")
    assert line.endswith("was refused: 16 clients are connected")


def test_who_does_not_read_is_disconnected_and_the_others_get_everything():
    lines = []
    with server(lines) as (made, publish), ExitStack() as stack:
        good = subscribed(stack, made.url, max_queue=None)
        bad = [subscribed(stack, made.url, max_queue=1) for _ in range(3)]
        time.sleep(0.5)
        before = memory()
        assert sent(publish, range(200), good) == [*range(200)]
        after = memory()
        assert len(lines) == 3
        for each in bad:
            with pytest.raises(websockets.exceptions.ConnectionClosedError):
                while True:
                    each.recv(timeout=20)
    assert all("does not read, and 32 MiB wait for it; it is disconnected" in x for x in lines)
    assert after - before < 250 * MEGABYTE  # three times 200 are not kept


def test_a_connection_that_asks_for_nothing_takes_no_place_for_long(monkeypatch):
    monkeypatch.setattr(client_gate, "_SILENT_S", 0.3)
    lines = []
    with server(lines) as (made, _), ExitStack() as stack:
        port = int(made.url.rpartition(":")[2])
        for _ in range(16):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        time.sleep(1)
        subscribed(stack, made.url)
    assert lines == []


def test_what_waits_at_the_end_is_taken():
    with server([]) as (made, publish), ExitStack() as stack:
        late = subscribed(stack, made.url)
        time.sleep(0.5)
        for number in range(20):
            publish(number)
        made.commit()
        threading.Thread(target=made.discard).start()
        got = 0
        with pytest.raises(websockets.exceptions.ConnectionClosed):
            while True:
                got += isinstance(late.recv(timeout=20), bytes)
        assert got == 20


def test_a_client_that_goes_is_no_fault(caplog):
    with server([]) as (made, _), ExitStack() as stack:
        leaving = subscribed(stack, made.url)
        leaving.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [1]}))
        time.sleep(0.5)
    assert "Callback failed" not in caplog.text


def test_a_page_of_any_origin_may_connect():
    """The docs say so."""
    with server([]) as (made, _), ExitStack() as stack:
        subscribed(stack, made.url, origin="https://elsewhere.example")
