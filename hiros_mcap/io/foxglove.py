"""Live messages of a Foxglove WebSocket server, such as foxglove_bridge beside a ROS 2 system.

Protocol: foxglove.websocket.v1, docs/spec.md of github.com/foxglove/ws-protocol. The server
advertises its channels in JSON. Each message comes in binary: opcode 1, the number of the
subscription (4 bytes), the time at which the server took it (8 bytes, ns), and its data.
"""

from __future__ import annotations

import json
import logging
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import SplitResult, urlsplit

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.records import Channel, McapRecord, Message, Schema
from hiros_mcap.outside import parse

_PROTOCOLS: Any = ("foxglove.websocket.v1", "foxglove.sdk.v1")
_DATA = struct.Struct("<BIQ")
_PATIENCE = 0.1  # s: how soon a request to stop is heard
LARGEST = 64 << 20
"""Bytes of the largest message; one of a camera has less than 1 MiB."""
_FAREWELL_S = 1.0
_TOO_EARLY = "Unknown channel ID: "
_ATTEMPTS, _PAUSE_S = 100, 0.01
_SILENT_S = {"TCP_KEEPIDLE": 15, "TCP_KEEPALIVE": 15, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}
"""When the system asks a silent server whether it is there; some of the names exist on each."""
_QUEUED = 4  # messages that wait for a busy run, before the server has to

Wanted = Callable[[str, str], bool]
"""Tells from topic and message type whether to subscribe."""


class FoxgloveInput(LiveInput):
    """The channels of a server.

    Parameters
    ----------
    url : ``ws://HOST:PORT`` or ``wss://...``.
    wanted : which channels to subscribe to; others are not sent.
    largest : bytes of the largest message that is taken.

    Raises ConfigError for what is no address.
    """

    def __init__(self, url: str, wanted: Wanted, largest: int = LARGEST) -> None:
        if not split_address(url).hostname:
            raise ConfigError(f"{url}: names no host; a server is at ws://HOST:PORT")
        super().__init__(url)
        self._largest = largest
        self._connection: Any = None
        self._wanted = wanted
        self._ids: dict[int, int] = {}
        """Channel of the server -> our number of it and of the subscription."""
        self._counts: dict[int, int] = {}  # our number of a channel -> messages so far
        self._again: Counter[int] = Counter()
        """Channel of the server -> how often it was too early to subscribe."""

    def close(self) -> None:
        """Cut the connection, without a farewell, which a server may leave unanswered."""
        if self._connection is not None:
            self._connection.close_socket()

    def records(self) -> Iterator[McapRecord | None]:
        """Subscribe, and yield what comes until the server closes the connection.

        Raises LogError if there is no such server, or it does not speak the protocol.
        """
        try:
            from websockets.exceptions import (
                ConnectionClosedError,
                ConnectionClosedOK,
                InvalidHandshake,
                InvalidURI,
            )
            from websockets.sync.client import connect
        except ImportError:
            raise LogError(
                "needs the package websockets: pip install websockets", path=self.name
            ) from None
        # Its thread may outlive the run; Python would print that nobody takes what it logs.
        logging.getLogger("websockets").addHandler(logging.NullHandler())
        try:
            with connect(
                self.name,
                subprotocols=_PROTOCOLS,
                max_size=self._largest,
                max_queue=_QUEUED,
                close_timeout=_FAREWELL_S,
                compression=None,
                ping_interval=None,  # the answer would lie behind messages that a busy run leaves
            ) as self._connection:
                _keep_alive(self._connection.socket)
                yield from self._received(self._connection)
        except ConnectionClosedOK:
            return
        except ConnectionClosedError as error:
            if not self._stopped:
                self.fault = f"the connection broke: {error}; what came before was used"
        except (OSError, InvalidHandshake, InvalidURI, TimeoutError) as error:
            raise LogError(
                f"no Foxglove WebSocket server answers: {error}; start one, for example "
                "`ros2 run foxglove_bridge foxglove_bridge`",
                path=self.name,
            ) from None

    def _received(self, connection: Any) -> Iterator[McapRecord | None]:
        patience = 0.0
        while not self._stopped:
            try:
                data = connection.recv(timeout=patience)
            except TimeoutError:
                yield None
                patience = _PATIENCE
                continue
            patience = 0.0
            if isinstance(data, bytes):
                yield from self._message(data)
            else:
                yield from self._advertised(connection, data)

    def _advertised(self, connection: Any, text: str) -> Iterator[McapRecord]:
        """Subscribe to what is wanted of the entry channels, and yield the definitions."""
        try:
            entry = parse(text, "JSON", "text")
            if entry.get("op") == "status" and entry["message"].startswith(_TOO_EARLY):
                self._ask_again(connection, int(entry["message"].removeprefix(_TOO_EARLY)))
            channels = entry["channels"] if entry.get("op") == "advertise" else []
            news = [c for c in channels if c["id"] not in self._ids]
            wanted = [c for c in news if self._wanted(c["topic"], c["schemaName"])]
            numbers = {c["id"]: len(self._ids) + k for k, c in enumerate(wanted, 1)}
            definitions = [_definitions(c, numbers[c["id"]]) for c in wanted]
        except (ConfigError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise LogError(f"sent an odd message: {error!r}", path=self.name) from None
        if not wanted:
            return
        for schema, channel in definitions:
            self._counts[channel.id] = 0
            yield schema
            yield channel
        self._ids |= numbers
        _subscribe(connection, numbers)

    def _ask_again(self, connection: Any, channel: int) -> None:
        """Subscribe to a channel that the server has advertised and does not know yet.

        foxglove-sdk advertises a channel a moment before it takes subscriptions of it.
        """
        if self._again[channel] < _ATTEMPTS and channel in self._ids:
            self._again[channel] += 1
            time.sleep(_PAUSE_S)
            _subscribe(connection, {channel: self._ids[channel]})

    def _message(self, data: bytes) -> Iterator[Message]:
        if data[:1] != b"\x01" or len(data) < _DATA.size:
            return
        _, ident, log_time = _DATA.unpack_from(data)
        if ident in self._counts:
            self._counts[ident] += 1
            yield Message(ident, log_time, data[_DATA.size :], log_time, self._counts[ident])


def split_address(url: str) -> SplitResult:
    """Return the parts of an address; raises ConfigError for a port or a host that cannot be."""
    try:
        parts = urlsplit(url)
        _ = parts.port  # is parsed now
        (parts.hostname or "").encode("idna")
    except ValueError as error:
        raise ConfigError(f"{url}: {error}; a server is at ws://HOST:PORT") from None
    return parts


def _subscribe(connection: Any, numbers: dict[int, int]) -> None:
    """Subscribe to channels of the server, each with our number of it."""
    pairs = [{"id": ours, "channelId": theirs} for theirs, ours in numbers.items()]
    connection.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))


def _keep_alive(end: socket.socket) -> None:
    """Let the connection break half a minute after the server has gone without a farewell.

    A connection that has closed already is left alone: the next read from it says why.
    """
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _SILENT_S.items():
            if hasattr(socket, name):
                end.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _definitions(entry: dict[str, Any], ident: int) -> tuple[Schema, Channel]:
    """Return schema and channel, both with our number of the channel."""
    text, encoding = str(entry["schema"]), str(entry.get("schemaEncoding") or "ros2msg")
    schema = Schema(id=ident, name=str(entry["schemaName"]), encoding=encoding, data=text.encode())
    channel = Channel(
        id=ident,
        topic=str(entry["topic"]),
        message_encoding=str(entry["encoding"]),
        metadata={},
        schema_id=ident,
    )
    return schema, channel
