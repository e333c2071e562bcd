"""A proxy before a server: it bounds the number of clients, and the bytes that wait for each.

The library that speaks Foxglove's protocol bounds neither, and cannot disconnect anybody. So its
server listens on this computer only, and clients connect to the proxy.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import cast

MOST_CLIENTS = 16
MOST_BYTES = 32 << 20
"""Bytes that wait for a client: 4 s of five cameras and four people, with the results."""
_MOST_ASKED = 1 << 20
"""Bytes that a client has sent and the server has not read; a subscription takes 40."""
_SILENT_S = 10.0  # a connection that asks for nothing is no client
_REASON = f"hiros serves {MOST_CLIENTS} clients at most; disconnect another one\n"
_REFUSAL = (
    "HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nConnection: close\r\n"
    f"Content-Length: {len(_REASON)}\r\n\r\n{_REASON}"
).encode()


class ClientGate:
    """Passes bytes between clients and a server, in a thread of its own.

    Parameters
    ----------
    host, port : where clients connect; port 0 is any free one.
    server : port of the server on this computer.
    report : takes a line about a client that is refused (the first one only) or disconnected.

    Raises OSError where the address is taken, or is none of this computer.
    """

    def __init__(self, host: str, port: int, server: int, report: Callable[[str], object]) -> None:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
        self.port: int = listening.getsockname()[1]
        self.server, self.report = server, report
        self.clients: set[_Client] = set()
        self.has_refused = False
        self.loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._run, args=(listening,), daemon=True)
        self._thread.start()

    def close(self, patience: float) -> None:
        """Let clients take what waits for them for some time, s, then disconnect them."""
        self.loop.call_soon_threadsafe(self.loop.create_task, self._end(patience))
        self._thread.join(2 * patience)

    def _run(self, listening: socket.socket) -> None:
        opened = self.loop.create_server(lambda: _Client(self), sock=listening)
        server = self.loop.run_until_complete(opened)
        self.loop.run_forever()
        server.close()
        self.loop.close()

    async def _end(self, patience: float) -> None:
        for client in [*self.clients]:
            client.transport.close()
        until = self.loop.time() + patience
        while self.clients and self.loop.time() < until:
            await asyncio.sleep(0.01)
        for client in [*self.clients]:
            client.transport.abort()
        self.loop.call_soon(self.loop.stop)


class _Client(asyncio.Protocol):
    """The side of a client."""

    transport: asyncio.Transport

    def __init__(self, gate: ClientGate) -> None:
        self._gate = gate
        self._server: asyncio.Transport | None = None
        self._is_refused = False
        self._has_asked = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._gate.loop.call_later(_SILENT_S, self._end_silence)
        self._is_refused = len(self._gate.clients) >= MOST_CLIENTS
        if not self._is_refused:
            self._gate.clients.add(self)
            self.transport.pause_reading()
            self._gate.loop.create_task(self._connect())

    def data_received(self, data: bytes) -> None:
        self._has_asked = True
        if self._server is not None:
            self._server.write(data)
            if self._server.get_write_buffer_size() > _MOST_ASKED:
                self._disconnect("asks for too much")
        elif self._is_refused:  # now it listens to an answer
            if not self._gate.has_refused:
                self._gate.report(f"{self._name} was refused: {MOST_CLIENTS} clients are connected")
            self._gate.has_refused = True
            self.transport.write(_REFUSAL)
            self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        self._gate.clients.discard(self)
        if self._server is not None:
            self._server.abort()

    def take(self, data: bytes) -> None:
        """Send what the server has sent, or part with who does not read."""
        self.transport.write(data)
        if self.transport.get_write_buffer_size() > MOST_BYTES:
            self._disconnect(f"does not read, and {MOST_BYTES >> 20} MiB wait for it")

    async def _connect(self) -> None:
        made = self._gate.loop.create_connection(
            lambda: _Server(self), "127.0.0.1", self._gate.server
        )
        try:
            self._server, _ = await made
        except OSError:  # the run is over
            self.transport.abort()
            return
        if self.transport.is_closing():
            self._server.abort()
        else:
            self.transport.resume_reading()

    @property
    def _name(self) -> str:
        host, port = (self.transport.get_extra_info("peername") or ("a client", 0))[:2]
        return f"{host}:{port}"

    def _disconnect(self, why: str) -> None:
        if not self.transport.is_closing():
            self._gate.report(f"{self._name} {why}; it is disconnected")
            self.transport.abort()

    def _end_silence(self) -> None:
        if not self._has_asked:
            self.transport.abort()


class _Server(asyncio.Protocol):
    """The side of the server, a connection for each client."""

    def __init__(self, client: _Client) -> None:
        self._client = client

    def data_received(self, data: bytes) -> None:
        self._client.take(data)

    def connection_lost(self, exc: Exception | None) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._client.transport.close()
