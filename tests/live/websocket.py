"""A client of a WebSocket (RFC 6455) that speaks Foxglove's protocol, of nothing but Python's sockets."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import time
from typing import Any


class Client:
    """Connected, and told what channels there are."""

    def __init__(self, port: int, buffer: int | None = None) -> None:
        self._socket = socket.socket()
        if buffer is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(5.0)
        self._data = b""
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ["GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Protocol: foxglove.sdk.v1", "", ""]
        self._socket.sendall("\r\n".join(lines).encode())
        while b"\r\n\r\n" not in self._data:
            self._data += self._socket.recv(4096)
        head, _, self._data = self._data.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101")
        self.channels: dict[int, dict[str, Any]] = {}
        self.received: list[tuple[str, int, bytes]] = []
        self._subscribed: dict[int, int] = {}

    def tell(self, **message: Any) -> None:
        self._send(1, json.dumps(message).encode())

    def publish(self, channel: int, raw: bytes) -> None:
        self._send(2, b"\x01" + struct.pack("<I", channel) + raw)

    def listen(self, seconds: float) -> None:
        """Read what comes for a while, and subscribe to every channel that is told."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            self._socket.settimeout(left)
            try:
                opcode, data = self._frame()
            except TimeoutError:
                return
            if opcode == 1:
                self._told(json.loads(data))
            elif opcode == 2 and data[0] == 1:
                subscription, stamp_ns = struct.unpack_from("<IQ", data, 1)
                topic = self.channels[self._subscribed[subscription]]["topic"]
                self.received.append((topic, stamp_ns, data[13:]))

    def close(self) -> None:
        self._socket.close()

    def _told(self, message: dict[str, Any]) -> None:
        if message["op"] != "advertise":
            return
        for channel in message["channels"]:
            self.channels[channel["id"]] = channel
            self._subscribed[len(self._subscribed)] = channel["id"]
        wanted = [{"id": number, "channelId": channel} for number, channel in self._subscribed.items()]
        self.tell(op="subscribe", subscriptions=wanted[-len(message["channels"]) :])

    def _frame(self) -> tuple[int, bytes]:
        first, second = self._take(2)
        size = second & 127
        if size == 126:
            (size,) = struct.unpack(">H", self._take(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._take(8))
        return first & 15, self._take(size)

    def _take(self, count: int) -> bytes:
        while len(self._data) < count:
            part = self._socket.recv(65536)
            if not part:
                raise ConnectionError
            self._data += part
        found, self._data = self._data[:count], self._data[count:]
        return found

    def _send(self, opcode: int, data: bytes) -> None:
        mask, size = os.urandom(4), len(data)
        head = bytes([128 | size]) if size < 126 else bytes([128 | 126]) + struct.pack(">H", size)
        self._socket.sendall(bytes([128 | opcode]) + head + mask + bytes(b ^ mask[k % 4] for k, b in enumerate(data)))
