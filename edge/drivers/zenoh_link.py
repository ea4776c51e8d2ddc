"""Radio link of robots and ground stations over zenoh.

`edge.messages.topics` lists the topics, which are below the key `lpac/<fleet>/`. Presence is
reported by liveliness tokens `robot/<id>/alive/<session>`, which vanish with their session: at once
if the program ends, 1.5 s after it stops answering.

In peer mode, gossip makes a mesh from one known peer. A connection made only by gossip is not made
again after it is lost; scouting makes it again within about 8 s. For flight, therefore, every
robot's `connect` must name all robots with smaller ids, and the ground's all robots: configured
connections are retried for ever. Two sides must not name each other: if both connect at once after
a cut, they may end up connected without receiving each other's messages.

With TLS both sides present a certificate of the fleet's authority, and access rules apply to its
common name: `robot-<id>` may publish below its own key, `operator` below the ground's, `observer`
only a hold there. Host names are not verified, since robots have none.
"""

import atexit
import json
import os
import re
import secrets
import socket
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from threading import Event, Lock, Thread
from typing import Self

import zenoh

from edge.core.address import is_loopback, is_loopback_endpoint, require_endpoint
from edge.core.logger import log
from edge.core.wire import MAX_ROBOT_ID
from edge.drivers.door import Door, DoorStatus, listening_sockets
from edge.messages.admission import Admission
from edge.messages.topics import (
    HOLD,
    TOPICS,
    Knocking,
    ReceiveCallback,
    SenderKind,
    TlsFiles,
    Topic,
)

# Batches of 64 kB for topics of low priority. A world larger than the queue is dropped.
_BACKGROUND_BATCHES = 8
_TOKEN = re.compile(r"robot/(\d{1,5})/alive/(\w{1,32})")
# The largest topic's limit, and zenoh's own overhead.
_MOST_BYTES = max(topic.limit_bytes for topic in TOPICS) + 2**12
_MOST_TOKENS = 1000
# PX4's largest system id: every vehicle has its own.
MAX_CERTIFIED_ID = 255
_CLOSE_TIMEOUT_S = 1.0
_KNOCK_PERIOD_S = 0.5
_CLOSE_AT_EXIT_S = 1.5

# zenoh closes TCP sockets with a linger time of 10 s, which blocks the closing thread that long if
# the other end is out of reach. With zenoh's few default threads, two lost neighbours would stop a
# robot's reception from all others. With these settings, each neighbour lost within 10 s blocks at
# most one of 16 receiving threads, and no sending thread.
_RUNTIME = "(net: (handover: rx), rx: (worker_threads: 16))"

_ADVICE = {
    "Address already in use": "another program has this port; is this robot's already running?",
    "Cannot assign requested address": "this machine has no such address",
}


class LinkError(OSError):
    """The link cannot be opened; the text names the endpoint or setting and the remedy."""


class ZenohLink:
    """A zenoh session of a robot, or with `robot_id` None of the ground.

    Thread-safe. Close it, or use it as a context manager: the interpreter does not exit while it is
    open.
    """

    def __init__(
        self,
        *,
        fleet: str,
        robot_id: int | None = None,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        scouting: bool = False,
        autoconnect: bool = True,
        subscriptions: Mapping[Topic, ReceiveCallback] | None = None,
        tls: TlsFiles | None = None,
        members: Knocking | None = None,
    ) -> None:
        """Open the session.

        `listen` and `connect` are endpoints, `tcp/<host>:<port>`, or with `tls` all
        `tls/<host>:<port>`; without `listen` the session takes a free port. It opens even if no
        peer answers, and connects later. `scouting` finds peers by multicast, gossip by those
        already connected; without `autoconnect` the session waits for those peers to connect. With
        `members` it knocks at others' ports and protects its own (`edge.drivers.door`); with
        `scouting`, which finds peers that cannot knock, its own port stays open.

        `subscriptions` maps topics to callbacks. zenoh's threads call them, also concurrently, with
        the key below `lpac/<fleet>/` and the data. They get neither this session's own messages
        nor any larger than the topic's limit. A callback must only store: a slow one holds up the
        link.

        Raises LinkError if a setting is wrong or a port is taken.
        """
        _check(fleet, robot_id, listen, connect, tls)
        own: SenderKind = "ground" if robot_id is None else "robot"
        self._prefix = f"lpac/{fleet}/"
        self._own_prefix = self._prefix + (f"{own}/" if robot_id is None else f"{own}/{robot_id}/")
        self._robot_id = robot_id
        self._lock = Lock()
        self._tokens: set[tuple[int, str]] = set()
        self._failures: Counter[str] = Counter()
        self._admission = Admission()
        self._session_id = _session_id(robot_id)
        self._own_topics = [topic for topic in TOPICS if topic.sender == own]
        self._closed = Event()
        config = _config(
            self._prefix, self._session_id, listen, connect, scouting, autoconnect, tls
        )
        opened: list[zenoh.Session] = []
        if members is not None:
            # Start before the first connection attempt, which only known addresses can make.
            Thread(
                target=self._knock, name="knock", args=(members, connect, opened), daemon=True
            ).start()
        try:
            self._session, self._doors = _open_with_doors(config, None if scouting else members)
        except BaseException:
            self._closed.set()
            raise
        opened.append(self._session)
        try:
            self._publishers = self._declare(self._session, subscriptions or {})
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: Topic, data: bytes) -> None:
        """Publish on a topic of this session's side, robot or ground.

        The message is dropped if the link is congested or closed. Raises KeyError for a topic of
        the other side.
        """
        publisher = self._publishers[topic]
        try:
            publisher.put(data)
        except zenoh.ZError as error:
            self.report_failure(f"publish {topic.name}", error)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another session uses that robot id.

        Within 1.5 s of a restart this may be the program's own former session.
        """
        with self._lock:
            return any(
                id_ == robot_id and session != self._session_id for id_, session in self._tokens
            )

    def peers(self) -> int:
        """Number of connected zenoh sessions."""
        try:
            return len(self._session.info.peers_zid())
        except zenoh.ZError:  # closed
            return 0

    def refused(self) -> int:
        """Number of messages dropped unread: above the rate, or too large."""
        return self._admission.refused

    def doors(self) -> list[DoorStatus]:
        """State of each port that other computers reach."""
        return [door.status for door in self._doors]

    def close(self) -> None:
        """Close the session, within about a second. May be repeated."""
        self._closed.set()
        for door in self._doors:
            door.close()
        # Closing may block on a connection whose other end is out of reach.
        closing = Thread(target=self._close_session, daemon=True)
        closing.start()
        closing.join(_CLOSE_TIMEOUT_S)
        if closing.is_alive():
            # A callback from zenoh into an interpreter that is exiting aborts the program.
            atexit.register(closing.join, _CLOSE_AT_EXIT_S)

    def _close_session(self) -> None:
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            self.report_failure("close", error)

    def _knock(
        self, members: Knocking, connect: Sequence[str], opened: Sequence[zenoh.Session]
    ) -> None:
        """Knock at each configured port that is not connected, until the link is closed."""
        places = [endpoint.partition("/")[2] for endpoint in connect]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.setblocking(False)
            while True:
                connected = [place for session in opened for place in _peer_places(session)]
                for place in places:
                    host, _, port = place.rpartition(":")
                    if place not in connected and not is_loopback(host):
                        with suppress(OSError):  # no network yet, or no such host
                            address = socket.gethostbyname(host)
                            udp.sendto(members.knock(f"{address}:{port}"), (address, int(port)))
                if self._closed.wait(_KNOCK_PERIOD_S):
                    return

    def _declare(
        self, session: zenoh.Session, subscriptions: Mapping[Topic, ReceiveCallback]
    ) -> dict[Topic, zenoh.Publisher]:
        for topic, callback in subscriptions.items():
            session.declare_subscriber(
                self._prefix + topic.pattern,
                zenoh.handlers.Callback(self._guarded(topic, callback), indirect=False),
                allowed_origin=zenoh.Locality.REMOTE,
            )
        liveliness = session.liveliness()
        liveliness.declare_subscriber(
            self._prefix + "robot/*/alive/*",
            zenoh.handlers.Callback(self._on_token, indirect=False),
            history=True,
        )
        if self._robot_id is not None:
            # Stored, since a token without references is withdrawn.
            self._token = liveliness.declare_token(f"{self._own_prefix}alive/{self._session_id}")
        return {
            topic: session.declare_publisher(
                self._own_prefix + topic.name,
                # Only the newest message matters: drop rather than queue.
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
                priority=(
                    zenoh.Priority.REAL_TIME
                    if topic.priority == "now"
                    else zenoh.Priority.BACKGROUND
                ),
                reliability=zenoh.Reliability.RELIABLE,
            )
            for topic in self._own_topics
        }

    def _guarded(self, topic: Topic, callback: ReceiveCallback) -> Callable[[zenoh.Sample], None]:
        def receive(sample: zenoh.Sample) -> None:
            try:
                key = str(sample.key_expr).removeprefix(self._prefix)
                size, now_s = len(sample.payload), time.monotonic()
                with self._lock:
                    admitted = self._admission.admits(topic, key, size, now_s)
                if admitted:
                    callback(key, sample.payload.to_bytes())
            except Exception as error:
                self.report_failure(f"callback {topic.pattern}", error)

        return receive

    def report_failure(self, what: str, error: Exception) -> None:
        """Log the first failure of each kind."""
        with self._lock:
            self._failures[what] += 1
            first = self._failures[what] == 1
        if first:
            log.error("link failure", exc_info=error, what=what)

    def _on_token(self, sample: zenoh.Sample) -> None:
        match = _TOKEN.fullmatch(str(sample.key_expr).removeprefix(self._prefix))
        if match is None:
            return
        token = int(match[1]), match[2]
        with self._lock:
            if sample.kind != zenoh.SampleKind.PUT:
                self._tokens.discard(token)
            elif len(self._tokens) < _MOST_TOKENS:
                self._tokens.add(token)


def _config(
    prefix: str,
    session_id: str,
    listen: Sequence[str],
    connect: Sequence[str],
    scouting: bool,
    autoconnect: bool,
    tls: TlsFiles | None,
) -> zenoh.Config:
    # If two sessions find each other by scouting or gossip, the one with the greater id connects,
    # as in configured endpoints.
    found = {
        "autoconnect": {"peer": ["peer"] if autoconnect else []},
        "autoconnect_strategy": {"peer": {"to_peer": "greater-zid"}},
    }
    # The kernel repeats an attempt to an unreachable peer after 1 s; the attempt ends after 2 s. A
    # peer that is back soon is connected within 1.1 s. A peer whose program is down refuses at
    # once, so the period grows to 0.5 s.
    retry = {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5}
    # A session that connects only to this computer accepts connections only from it.
    host = "127.0.0.1" if connect and all(map(is_loopback_endpoint, connect)) else "0.0.0.0"
    listen = listen or (f"{'tcp' if tls is None else 'tls'}/{host}:0",)
    config = zenoh.Config()
    for key, value in {
        **({} if tls is None else _tls(prefix, tls)),
        "id": session_id,
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": retry,
        "scouting/delay": 0,
        "scouting/multicast": {"enabled": scouting, **found},
        "scouting/gossip": found,
        # A lost neighbour is noticed after 1500 ms, three keep-alive messages. None are sent while
        # other messages are, as in flight. With one every 250 ms, those of ten robots took a
        # quarter of a channel's airtime.
        "transport/link/tx/lease": 1500,
        "transport/link/tx/keep_alive": 3,
        "transport/link/tx/queue/size/background": _BACKGROUND_BATCHES,
        # An attempt that is held up by a lost packet ends soon and is repeated.
        "transport/unicast/open_timeout": 2000,
        "transport/unicast/accept_timeout": 2000,
        # Larger messages are never held in memory; those above their topic's limit are dropped.
        "transport/link/rx/max_message_size": _MOST_BYTES,
        "low_pass_filter": [
            {
                "flows": ["ingress"],
                "messages": ["put"],
                "key_exprs": [prefix + topic.pattern],
                "size_limit": topic.limit_bytes,
            }
            for topic in TOPICS
        ],
        # Applies to each connection separately, before anything reaches Python.
        "downsampling": [
            {
                "flows": ["ingress"],
                "messages": ["put"],
                "rules": [
                    {"key_expr": prefix + topic.pattern, "freq": topic.most_of_one_hz}
                    for topic in TOPICS
                    if topic.most_of_one_hz is not None
                ],
            }
        ],
        # It would take 200 MB for ten robots, without gain.
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls(prefix: str, tls: TlsFiles) -> dict[str, object]:
    """TLS with certificates on both sides, and access rules by their names."""
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": tls.authority,
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "listen_private_key": tls.key,
            "listen_certificate": tls.certificate,
            "connect_private_key": tls.key,
            "connect_certificate": tls.certificate,
        },
        "access_control": _access_control(prefix),
    }


def _access_control(prefix: str) -> dict[str, object]:
    """Access rules: each certificate's name may publish below its keys; all may subscribe."""
    publishers = {
        "operator": [f"{prefix}ground/**"],
        "observer": [f"{prefix}ground/{HOLD.name}"],
        **{f"robot-{id_}": [f"{prefix}robot/{id_}/**"] for id_ in range(MAX_CERTIFIED_ID + 1)},
    }
    subscribe = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    publish = ["put", "liveliness_token", "reply"]
    everything = {"permission": "allow", "key_exprs": [f"{prefix}**"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": "to all", "flows": ["egress"], "messages": subscribe + publish, **everything},
            {"id": "subscribe", "flows": ["ingress"], "messages": subscribe, **everything},
            *(
                {
                    "id": name,
                    "permission": "allow",
                    "flows": ["ingress"],
                    "messages": publish,
                    "key_exprs": keys,
                }
                for name, keys in publishers.items()
            ),
        ],
        "subjects": [
            {"id": "all"},
            *({"id": name, "cert_common_names": [name]} for name in publishers),
        ],
        "policies": [
            {"rules": ["to all", "subscribe"], "subjects": ["all"]},
            *({"rules": [name], "subjects": [name]} for name in publishers),
        ],
    }


def _check(
    fleet: str,
    robot_id: int | None,
    listen: Sequence[str],
    connect: Sequence[str],
    tls: TlsFiles | None,
) -> None:
    if not re.fullmatch(r"[\w-]+", fleet):
        raise LinkError(f"fleet = {fleet!r}: must be letters, digits, '-' and '_'")
    if robot_id is not None and not 0 <= robot_id <= MAX_ROBOT_ID:
        raise LinkError(f"robot_id = {robot_id}: must be from 0 to {MAX_ROBOT_ID}")
    # zenoh itself would wait for ever for an invalid endpoint.
    try:
        for name, endpoints in (("listen", listen), ("connect", connect)):
            for endpoint in endpoints:
                require_endpoint(name, endpoint, "tcp" if tls is None else "tls")
    except ValueError as error:
        raise LinkError(str(error)) from None
    if tls is not None and robot_id is not None and robot_id > MAX_CERTIFIED_ID:
        raise LinkError(f"robot_id = {robot_id}: must be from 0 to {MAX_CERTIFIED_ID} with TLS")


def _session_id(robot_id: int | None) -> str:
    """Unique id, ordered by robot id, with the ground after all robots.

    zenoh compares ids from the last byte.
    """
    rank = MAX_ROBOT_ID + 1 if robot_id is None else robot_id
    return f"1{secrets.token_hex(12)}{rank.to_bytes(3, 'little').hex()}"


def _open_with_doors(
    config: zenoh.Config, members: Knocking | None
) -> tuple[zenoh.Session, list[Door]]:
    """Open a session, and a door for each of its ports that other computers reach."""
    if members is None:
        return _open(config), []
    with ExitStack() as others:
        before = {
            inode: others.enter_context(found) for inode, found in listening_sockets().items()
        }
        session = _open(config)
    doors = []
    for inode, found in listening_sockets().items():
        if inode in before or is_loopback(found.getsockname()[0]):
            found.close()
        else:
            try:
                doors.append(Door(found, members, partial(_peer_addresses, session)))
            except OSError as error:
                log.error("the radio's port is open to strangers", why=str(error))
    return session, doors


def _peer_places(session: zenoh.Session) -> list[str]:
    """IPv4 address:port of each connected peer."""
    try:
        links = session.info.links()
    except zenoh.ZError:  # closed
        return []
    places = (re.fullmatch(r"\w+/([0-9.]+:[0-9]+)", str(link.dst)) for link in links)
    return [place[1] for place in places if place is not None]


def _peer_addresses(session: zenoh.Session) -> list[str]:
    return [place.partition(":")[0] for place in _peer_places(session)]


def _open(config: zenoh.Config) -> zenoh.Session:
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = re.sub(r" at /\S+:\d+\.", "", str(error)).strip(" .!")
        advice = next((text for part, text in _ADVICE.items() if part in reason), "check it")
        raise LinkError(f"zenoh: {reason}: {advice}") from None
