"""Sockets between the engine and robots or viewers: Zenoh, as ROS 2's rmw_zenoh speaks it, and Foxglove's WebSocket.

A `Wire` hands over the messages that come, with topic and type, and sends what it is given; it never blocks the one who
sends: to a reader that is slow, messages are dropped. Messages are CDR, serialised once for all wires.

rmw_zenoh (docs/design.md and attachment_helpers.cpp there): a topic is the key `domain/topic/type/hash of the type`;
beside a message go its number, its time [ns] and the 16 bytes that identify its publisher.
"""

from __future__ import annotations

import json
import os
import re
import struct
import threading
import time
from collections import deque
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from evermap.errors import ConfigError, InputError, MissingExtraError, printable
from evermap.io.bag_messages import FRAMES, KINDS
from evermap.io.rosbag import ros2_types

OURS = "/evermap/"
"""Prefix of the engine's own topics, which are not subscribed."""
LATCHED = "/tf_static"
"""Topics that are latched for late subscribers."""
MOST_WAITING = 20_000
"""Maximum queued messages; beyond it the oldest are dropped and counted."""
HINT = "pip install 'evermap[live]'"


class Message(NamedTuple):
    """A received message.

    Attributes:
        topic: name.
        kind: type, such as 'nav_msgs/msg/Odometry'.
        raw: CDR.
        received_s: when it came, since 1970.
        source: who sent it: another one after a restart.
    """

    topic: str
    kind: str
    raw: bytes
    received_s: float
    source: object


class Mailbox:
    """Messages of all wires, in the order in which they came.

    Args:
        ours: those of an engine, to look on; else those of a robot.
    """

    def __init__(self, *, ours: bool = False) -> None:
        self.ours = ours
        self._waiting: deque[Message] = deque(maxlen=MOST_WAITING)
        self._came = threading.Event()
        self.n_lost = 0
        """Messages that were lost or dropped."""

    def put(self, topic: str, kind: str, raw: bytes, source: object) -> None:
        """Take a message, from any thread."""
        if topic.startswith(OURS) != self.ours:
            return
        self.n_lost += len(self._waiting) == MOST_WAITING
        self._waiting.append(Message(topic, kind, raw, time.time(), source))
        self._came.set()

    def take(self) -> Message | None:
        """Return the oldest waiting message, None if there is none."""
        try:
            return self._waiting.popleft()
        except IndexError:
            return None

    def __len__(self) -> int:
        return len(self._waiting)

    def wait(self, timeout_s: float) -> None:
        """Wait for a message, or for so long."""
        self._came.wait(timeout_s)
        self._came.clear()


class Wire(Protocol):
    """A connection to others.

    Attributes:
        about: where it is, for the terminal; may be empty.
    """

    about: str

    def announce(self, topic: str, kind: str) -> None:
        """Let others know of a topic before anything is sent on it."""

    def send(self, topic: str, kind: str, raw: bytes, stamp_ns: int) -> None:
        """Send a message, without waiting for anybody."""

    def close(self) -> None:
        """End the connection."""


class Zenoh:
    """A session of Zenoh in which topics are those of ROS 2.

    Args:
        where: endpoint of a router, as 'tcp/localhost:7447', to which it connects as soon as it is there, and again
            when it was away; with 'listen=' before it, be that router; or a file with the configuration of a session.
        mailbox: gets what comes; None to send only.

    Raises:
        MissingExtraError: `eclipse-zenoh` is not installed.
        ConfigError: an endpoint or a file that is none, or a port that is taken.
    """

    def __init__(self, where: str, mailbox: Mailbox | None) -> None:
        try:
            import zenoh
            from zenoh import ext
        except ImportError:
            raise MissingExtraError("Zenoh needs the package eclipse-zenoh", field="zenoh", hint=HINT) from None
        self._ext, self._zenoh, self._types = ext, zenoh, ros2_types()
        self.about = ""
        self._domain = os.environ.get("ROS_DOMAIN_ID", "0")
        self._publishers: dict[str, Any] = {}
        self._numbers: dict[str, int] = {}
        self._heard: dict[bytes, int] = {}
        self._mailbox = mailbox
        try:
            self._session: Any = zenoh.open(_zenoh_config(zenoh, where))
        except zenoh.ZError as error:
            hint = "tcp/localhost:7447, listen=tcp/0.0.0.0:7447, or the file of a session's configuration"
            raise ConfigError(f"{where}: {_first_line(error)}", field="zenoh", hint=hint) from None
        self._id = bytes.fromhex(str(self._session.zid()).rjust(32, "0"))[:16]
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=100)
        kinds = () if mailbox is None else ("*",) if mailbox.ours else KINDS
        self._subscribers = [
            ext.declare_advanced_subscriber(
                self._session,
                f"{self._domain}{OURS}**" if kind == "*" else f"{self._domain}/**/$*::msg::dds_::{kind}_/*",
                zenoh.handlers.Callback(self._receive, indirect=False),  # in the order of arrival, whatever the topic
                allowed_origin=zenoh.Locality.REMOTE,
                history=history if kind in FRAMES else None,
            )
            for kind in kinds
        ]

    def announce(self, topic: str, kind: str) -> None:
        package, _, name = kind.split("/")
        key = f"{self._domain}{topic}/{package}::msg::dds_::{name}_/{self._types.hash_rihs01(kind)}"
        how: dict[str, Any] = {"congestion_control": self._zenoh.CongestionControl.DROP}
        declare = self._session.declare_publisher
        if topic == LATCHED:
            how |= {"cache": self._ext.CacheConfig(max_samples=1), "publisher_detection": True}
            declare = partial(self._ext.declare_advanced_publisher, self._session)
        self._publishers[topic] = declare(key, **how)

    def send(self, topic: str, kind: str, raw: bytes, stamp_ns: int) -> None:  # noqa: ARG002 (the protocol's)
        if topic not in self._publishers:
            self.announce(topic, kind)
        number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
        attached = struct.pack("<qqB16s", number, time.time_ns(), 16, self._id)
        self._publishers[topic].put(raw, attachment=attached)

    def close(self) -> None:
        with suppress(self._zenoh.ZError):
            self._session.close()

    def _receive(self, sample: Any) -> None:
        parts = str(sample.key_expr).split("/")
        topic, (package, *_, name) = "/" + "/".join(parts[1:-2]), parts[-2].split("::")
        attached = bytes(sample.attachment) if sample.attachment is not None else b""
        source = attached[-16:] + topic.encode()
        if self._mailbox is None:
            return
        if len(attached) == struct.calcsize("<qqB16s"):
            number = int(struct.unpack_from("<q", attached)[0])
            before = self._heard.get(source, number - 1)
            if number <= before:  # came by another way, too
                return
            self._heard[source] = number
            self._mailbox.n_lost += number - before - 1
        self._mailbox.put(topic, f"{package}/msg/{name.removesuffix('_')}", bytes(sample.payload), source)


class Foxglove:
    """A server to which Foxglove and other clients connect; what clients publish is taken as messages of a robot.

    Args:
        where: port, or HOST:PORT; only this machine is let in unless the host says otherwise.
        mailbox: gets what clients publish; None to send only.

    Raises:
        MissingExtraError: `foxglove-sdk` is not installed.
        ConfigError: no port, or one that is taken.
    """

    def __init__(self, where: str, mailbox: Mailbox | None) -> None:
        try:
            import foxglove
        except ImportError:
            problem = "Foxglove's WebSocket needs the package foxglove-sdk"
            raise MissingExtraError(problem, field="foxglove", hint=HINT) from None
        from foxglove.websocket import Capability

        self._foxglove, self._types = foxglove, ros2_types()
        self._context, self._channels = foxglove.Context(), dict[str, Any]()
        host, _, port = where.rpartition(":")
        listener = None if mailbox is None else _Clients(mailbox)
        try:
            self._server = foxglove.start_server(
                name="evermap",
                host=host or "127.0.0.1",
                port=int(port),
                capabilities=[] if mailbox is None else [Capability.ClientPublish],
                supported_encodings=["cdr"],
                server_listener=listener,
                context=self._context,
            )
        except (ValueError, OverflowError, OSError, RuntimeError) as error:
            raise ConfigError(f"no server at {where}: {_first_line(error)}", field="foxglove", hint="8765") from None

        self.port = int(self._server.port)
        self.about = f"Foxglove: open ws://{host or 'localhost'}:{self.port}, or {self._server.app_url()}"

    def announce(self, topic: str, kind: str) -> None:
        text = self._types.generate_msgdef(kind, ros_version=2)[0].encode()
        schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=text)
        how: dict[str, Any] = {"schema": schema, "message_encoding": "cdr", "context": self._context}
        self._channels[topic] = self._foxglove.Channel(topic, **how)

    def send(self, topic: str, kind: str, raw: bytes, stamp_ns: int) -> None:
        if topic not in self._channels:
            self.announce(topic, kind)
        self._channels[topic].log(raw, log_time=stamp_ns)

    def close(self) -> None:
        self._server.stop()


class _Clients:
    """Callbacks of Foxglove's server, called by the library from a separate thread."""

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox
        self._channels: dict[tuple[int, int], tuple[str, str]] = {}

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        if channel.encoding == "cdr":
            package, *_, name = channel.schema_name.split("/")
            self._channels[client.id, channel.id] = channel.topic, f"{package}/msg/{name}"

    def on_message_data(self, client: Any, channel_id: int, data: bytes) -> None:
        if (known := self._channels.get((client.id, channel_id))) is not None:
            self._mailbox.put(*known, data, (client.id, channel_id))

    def __getattr__(self, name: str) -> Any:
        """Ignore all else that clients do."""
        if not name.startswith("on_"):
            raise AttributeError(name)
        return lambda *_: None


def _zenoh_config(zenoh: Any, where: str) -> Any:
    """Of a session, by the defaults of rmw_zenoh: no multicast, peers find each other by the router."""
    values: dict[str, Any] = {"timestamping/enabled": True}  # needed to keep messages for those who come later
    if Path(where).suffix in (".json", ".json5", ".yaml", ".yml"):
        config = zenoh.Config.from_file(where)
    else:
        config, listens, endpoint = zenoh.Config(), where.startswith("listen="), where.removeprefix("listen=")
        if re.match(r"(tcp|udp|tls|quic|ws)/", endpoint) and not re.search(r":\d+($|[?#])", endpoint):
            hint = where + ":7447, the port of a router by default"
            raise ConfigError(f"'{where}' names no port", field="zenoh", hint=hint)
        values |= {
            "mode": "router" if listens else "peer",
            "listen/endpoints": [endpoint if listens else "tcp/localhost:0"],
            "scouting/multicast/enabled": False,
        }
        if not listens:
            values |= {"connect/endpoints": [where], "connect/timeout_ms": -1, "connect/exit_on_failure": False}
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _first_line(error: Exception) -> str:
    """Return the first line of an error, without positions in the library's source."""
    first, *others = str(error).split(" at /")[0].strip().splitlines() or [type(error).__name__]
    return printable(": ".join([first.strip(" ->"), *(one.strip(" =") for one in others[-1:])]), 200)


def wires_of(zenoh: str | None, foxglove: str | None, mailbox: Mailbox | None) -> list[Wire]:
    """Return the requested connections.

    Raises:
        InputError: a package is missing, or a connection cannot be.
    """
    found: list[Wire] = []
    try:
        if zenoh is not None:
            found.append(Zenoh(zenoh, mailbox))
        if foxglove is not None:
            found.append(Foxglove(foxglove, mailbox))
    except (MissingExtraError, ConfigError, InputError):
        for wire in found:
            wire.close()
        raise
    return found
