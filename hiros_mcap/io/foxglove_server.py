"""Results for others: a Foxglove WebSocket server that gives what a pipe would get.

The package foxglove-sdk speaks the protocol. The run never waits: who reads too slowly loses the
oldest messages.
"""

from __future__ import annotations

import logging
import time
from threading import Thread
from types import SimpleNamespace
from typing import Any

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.channels import is_static_topic
from hiros_mcap.io.container.live_output import MessageSink
from hiros_mcap.io.container.records import Channel, Schema
from hiros_mcap.io.foxglove import split_address

_LOOPBACK, _PORT = "127.0.0.1", 8765
_QUEUED = 512  # messages that wait for a client: about 2 s of five cameras, with the results
_LATCHED = 1000
"""Messages with static transforms that a client gets that comes later; a camera has one or two."""
_FAREWELL_S = 0.5  # for clients to take what is left


class FoxgloveServer(MessageSink):
    """Takes the records of an MCAP and sends their messages to whoever subscribed.

    A client that comes later gets the static transforms again.

    Parameters
    ----------
    url : ``ws://HOST:PORT``; without a host only this computer is served, port 0 is any free one.

    Raises ConfigError for another address, LogError if the server cannot start.
    """

    def __init__(self, url: str) -> None:
        host, port = _address(url)
        try:
            import foxglove
        except ImportError:
            raise LogError(
                "needs the package foxglove-sdk: pip install foxglove-sdk", path=url
            ) from None
        self._library: Any = foxglove
        # Else the library complains on stderr that nobody takes its log.
        for name in ("foxglove", "foxglove_py"):
            logging.getLogger(name).addHandler(logging.NullHandler())
        self._context = foxglove.Context()
        self._channels: dict[int, Any] = {}
        self._static: dict[tuple[int, bytes], None] = {}
        """Messages with static transforms, each once, in order."""
        self._time = 0  # log time of the latest message, ns
        greeter = SimpleNamespace(
            on_subscribe=lambda _, channel: self.greet(channel.id),
            on_unsubscribe=lambda *_: None,
        )
        listener: Any = greeter
        try:
            self._server: Any = foxglove.start_server(
                name="hiros",
                host=host,
                port=port,
                server_listener=listener,
                context=self._context,
                message_backlog_size=_QUEUED,
            )
        except (OSError, RuntimeError, OverflowError) as error:
            raise LogError(f"cannot be served: {error}", path=url) from None
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._server.port}"
        super().__init__(self.url)

    def commit(self) -> None:
        """Give the clients a moment to take what is left."""
        time.sleep(_FAREWELL_S)

    def discard(self) -> None:
        """Close the server; a client that reads nothing is not waited for."""
        server, self._server = self._server, None
        if server is not None:
            stopping = Thread(target=server.stop, daemon=True)
            stopping.start()
            stopping.join(_FAREWELL_S)

    def greet(self, channel: int) -> None:
        """Send the static transforms again if ``channel``, the library's number, has them."""
        for ident, data in list(self._static):
            if (ours := self._channels[ident]).id() == channel:
                ours.log(data, log_time=self._time)

    def _open(self, channel: Channel, schema: Schema | None) -> None:
        """Advertise a channel."""
        self._channels[channel.id] = self._library.Channel(
            channel.topic,
            message_encoding=channel.message_encoding,
            schema=schema
            and self._library.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
            metadata=dict(channel.metadata),
            context=self._context,
        )

    def _send(self, ident: int, log_time: int, data: bytes) -> None:
        channel = self._channels[ident]
        if is_static_topic(channel.topic()):
            self._static.pop((ident, data), None)
            self._static[ident, data] = None
            if len(self._static) > _LATCHED:
                del self._static[next(iter(self._static))]
        self._time = max(self._time, log_time)
        channel.log(data, log_time=log_time)


def _address(url: str) -> tuple[str, int]:
    """Return host and port; raises ConfigError for what is no address of a server."""
    parts = split_address(url)
    if parts.scheme != "ws" or parts.path not in ("", "/") or parts.query:
        raise ConfigError(f"{url}: results are served at ws://HOST:PORT")
    return parts.hostname or _LOOPBACK, _PORT if parts.port is None else parts.port
