"""The radio of the robots and the ground, over zenoh.

What travels is in `edge.messages.topics`, below the key `lpac/<fleet>/`. Besides, for presence,
there are the liveliness tokens `robot/<id>/alive/<session>`, which vanish with the session that
declared them: at once if the program ends, 1.5 s after it stops answering.

In peer mode gossip makes a mesh from one known peer, but what only gossip connected is not
connected again when it alone is lost; scouting does it within some 8 s. So for flight let every
robot's `connect` name all robots with smaller ids, and the ground's all robots: the configured side
tries again for ever. Never name each other: two sides that connect at once after a cut may end up
connected and yet deaf to each other.

With TLS both sides show a certificate of the fleet's authority, and what a peer says is taken by
its certificate's common name: `robot-<id>` below its own key, `operator` below the ground's,
`observer` there a hold only. Names of hosts are not looked at, since robots have none.
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
from edge.drivers.door import Door, DoorStatus, listening
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

# Of 64 kB each, for topics that go later: a world that does not fit in there at once is dropped.
_PATIENT_BATCHES = 8
_TOKEN = re.compile(r"robot/(\d{1,5})/alive/(\w{1,32})")
# Of all topics' limits the largest, and what zenoh says besides.
_MOST_BYTES = max(topic.limit_bytes for topic in TOPICS) + 2**12
_MOST_TOKENS = 1000
# As many as PX4's system ids, of which every vehicle has one of its own.
MAX_CERTIFIED_ID = 255
_CLOSE_TIMEOUT_S = 1.0
_KNOCKS_EVERY_S = 0.5
_CLOSE_AT_EXIT_S = 1.5

# zenoh closes TCP sockets with a linger time of 10 s, which holds the closing thread for as long if
# the other end is out of reach. With zenoh's few threads, two lost neighbours would make a robot
# deaf to all others. Here each neighbour lost within 10 s may hold one of those that receive, which
# find others, too; those that send are none of them.
_RUNTIME = "(net: (handover: rx), rx: (worker_threads: 16))"

_ADVICE = {
    "Address already in use": "another program has this port; does this robot's already run?",
    "Cannot assign requested address": "this machine has no such address",
}


class LinkError(OSError):
    """The link cannot be opened; the text says which endpoint or setting, and what to do."""


class ZenohLink:
    """A session on the radio: a robot's, or with `robot_id` None the ground's.

    Every method may be called from any thread. Close it, or use it as a context manager: the
    interpreter does not exit while it is open.
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

        `listen` and `connect` are endpoints, `tcp/<host>:<port>`, or with `tls` all of them
        `tls/<host>:<port>`; without `listen` it takes a free port. It opens even if nobody answers,
        and connects later. `scouting` finds others by multicast, as gossip does by those that are
        connected; without `autoconnect` it calls none of them, and they call it. With `members` it
        keeps strangers from the port that it listens on, unless those that scouting finds call
        there, and knocks at others' (`edge.drivers.door`).

        `subscriptions` maps topics to callbacks. They are called with the key below `lpac/<fleet>/`
        and the data, from zenoh's threads, several at once; what this session publishes is not
        among it, nor what is larger than its topic's limit. A callback must only store: a slow one
        holds up the link.

        Raises LinkError if a setting is wrong, or a port is taken.
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
            # From before the first call on, which strangers make in vain.
            Thread(
                target=self._knock, name="knock", args=(members, connect, opened), daemon=True
            ).start()
        try:
            # Members that found this port by scouting do not know where to knock.
            self._session, self._doors = _open_behind_doors(config, None if scouting else members)
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
        """Send on a topic of robots, or of the ground, as this session is one or the other.

        Dropped when the link is congested or closed. Raises KeyError for a topic of the others.
        """
        publisher = self._publishers[topic]
        try:
            publisher.put(data)
        except zenoh.ZError as error:
            self._failed(f"publish {topic.name}", error)

    def present(self) -> frozenset[int]:
        """The other robots whose programs are connected now."""
        return frozenset(id_ for id_ in self._others() if id_ != self._robot_id)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another session says that it is that robot.

        Up to 1.5 s after a restart that may be the own former session.
        """
        return robot_id in self._others()

    def peers(self) -> int:
        """The number of zenoh sessions connected to this one."""
        try:
            return len(self._session.info.peers_zid())
        except zenoh.ZError:  # closed
            return 0

    def refused(self) -> int:
        """How many messages it did not look at: too many at once, or too large."""
        return self._admission.refused

    def doors(self) -> list[DoorStatus]:
        """How it stands with each port that other computers reach."""
        return [door.status for door in self._doors]

    def failures(self) -> int:
        """How many calls of callbacks and of `publish` failed; each kind's first is logged."""
        with self._lock:
            return self._failures.total()

    def close(self) -> None:
        """Leave the radio, within a second or so; again is no error."""
        self._closed.set()
        for door in self._doors:
            door.close()
        # A connection whose other end is out of reach holds it, too.
        closing = Thread(target=self._close_session, daemon=True)
        closing.start()
        closing.join(_CLOSE_TIMEOUT_S)
        if closing.is_alive():
            # What comes back from zenoh into an interpreter that is ending aborts the program.
            atexit.register(closing.join, _CLOSE_AT_EXIT_S)

    def _close_session(self) -> None:
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            self._failed("close", error)

    def _knock(
        self, members: Knocking, connect: Sequence[str], opened: Sequence[zenoh.Session]
    ) -> None:
        """At each port that it is to be connected to, until it is."""
        places = [endpoint.partition("/")[2] for endpoint in connect]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.setblocking(False)
            while True:
                met = [place for session in opened for place in _met(session)]
                for place in places:
                    host, _, port = place.rpartition(":")
                    if place not in met and not is_loopback(host):
                        with suppress(OSError):  # No network yet, or nobody of that name.
                            address = socket.gethostbyname(host)
                            udp.sendto(members.knock(f"{address}:{port}"), (address, int(port)))
                if self._closed.wait(_KNOCKS_EVERY_S):
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
            # Kept, since a token that nothing refers to is withdrawn.
            self._token = liveliness.declare_token(f"{self._own_prefix}alive/{self._session_id}")
        return {
            topic: session.declare_publisher(
                self._own_prefix + topic.name,
                # The newest counts, at once: nothing queues up.
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
                self._failed(f"callback {topic.pattern}", error)

        return receive

    def _failed(self, what: str, error: Exception) -> None:
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

    def _others(self) -> frozenset[int]:
        """The robot ids that other sessions claim."""
        with self._lock:
            return frozenset(id_ for id_, session in self._tokens if session != self._session_id)


def _config(
    prefix: str,
    session_id: str,
    listen: Sequence[str],
    connect: Sequence[str],
    scouting: bool,
    autoconnect: bool,
    tls: TlsFiles | None,
) -> zenoh.Config:
    # Of two sessions that find each other by scouting or gossip, the one of the greater id
    # connects: the same side as the configured endpoints make it.
    found = {
        "autoconnect": {"peer": ["peer"] if autoconnect else []},
        "autoconnect_strategy": {"peer": {"to_peer": "greater-zid"}},
    }
    # A call to somebody out of reach is repeated by the kernel after 1 s, and given up after 2:
    # whoever is back soon is called again within 1.1 s. One whose program is down refuses each
    # call at once, and soon is called seldom.
    retry = {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5}
    # Who calls nobody elsewhere need not be called from there.
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
        # How soon a lost neighbour is noticed, ms; and how many signs of life that is. Whoever
        # speaks more often, as robots do in flight, sends none besides: with a sign each
        # quarter of a second, ten robots' took a quarter of a channel's time.
        "transport/link/tx/lease": 1500,
        "transport/link/tx/keep_alive": 3,
        "transport/link/tx/queue/size/background": _PATIENT_BATCHES,
        # An attempt that a lost packet holds up is given up soon, and made again.
        "transport/unicast/open_timeout": 2000,
        "transport/unicast/accept_timeout": 2000,
        # What is larger is never held in memory, and what is larger than its topic allows not
        # handed on.
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
        # A state of its own for each connection, and before anything reaches this program.
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
        # 200 MB among ten robots, for no gain.
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls(prefix: str, tls: TlsFiles) -> dict[str, object]:
    """Only members get in, and say only what is theirs."""
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
    """Access rules below the prefix: publishers by their certificates' names; all hear all."""
    may_say = {
        "operator": [f"{prefix}ground/**"],
        "observer": [f"{prefix}ground/{HOLD.name}"],
        **{f"robot-{id_}": [f"{prefix}robot/{id_}/**"] for id_ in range(MAX_CERTIFIED_ID + 1)},
    }
    listening = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    saying = ["put", "liveliness_token", "reply"]
    everything = {"permission": "allow", "key_exprs": [f"{prefix}**"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": "to all", "flows": ["egress"], "messages": listening + saying, **everything},
            {"id": "listening", "flows": ["ingress"], "messages": listening, **everything},
            *(
                {
                    "id": name,
                    "permission": "allow",
                    "flows": ["ingress"],
                    "messages": saying,
                    "key_exprs": keys,
                }
                for name, keys in may_say.items()
            ),
        ],
        "subjects": [
            {"id": "all"},
            *({"id": name, "cert_common_names": [name]} for name in may_say),
        ],
        "policies": [
            {"rules": ["to all", "listening"], "subjects": ["all"]},
            *({"rules": [name], "subjects": [name]} for name in may_say),
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
    # zenoh itself would wait for ever for an endpoint that cannot be.
    try:
        for name, endpoints in (("listen", listen), ("connect", connect)):
            for endpoint in endpoints:
                require_endpoint(name, endpoint, "tcp" if tls is None else "tls")
    except ValueError as error:
        raise LinkError(str(error)) from None
    if tls is not None and robot_id is not None and robot_id > MAX_CERTIFIED_ID:
        raise LinkError(f"robot_id = {robot_id}: must be from 0 to {MAX_CERTIFIED_ID} with TLS")


def _session_id(robot_id: int | None) -> str:
    """Unique, and ordered as robot ids are, the ground after all robots.

    zenoh compares the bytes from the end of the text.
    """
    rank = MAX_ROBOT_ID + 1 if robot_id is None else robot_id
    return f"1{secrets.token_hex(12)}{rank.to_bytes(3, 'little').hex()}"


def _open_behind_doors(
    config: zenoh.Config, members: Knocking | None
) -> tuple[zenoh.Session, list[Door]]:
    """A session, and a door for each port of it that other computers reach."""
    if members is None:
        return _open(config), []
    with ExitStack() as others:
        before = {inode: others.enter_context(found) for inode, found in listening().items()}
        session = _open(config)
    doors = []
    for inode, found in listening().items():
        if inode in before or is_loopback(found.getsockname()[0]):
            found.close()
        else:
            try:
                doors.append(Door(found, members, partial(_met_addresses, session)))
            except OSError as error:
                log.error("the radio's port is open to strangers", why=str(error))
    return session, doors


def _met(session: zenoh.Session) -> list[str]:
    """The IPv4 addresses of all who are connected, each with its port."""
    try:
        links = session.info.links()
    except zenoh.ZError:  # closed
        return []
    places = (re.fullmatch(r"\w+/([0-9.]+:[0-9]+)", str(link.dst)) for link in links)
    return [place[1] for place in places if place is not None]


def _met_addresses(session: zenoh.Session) -> list[str]:
    return [place.partition(":")[0] for place in _met(session)]


def _open(config: zenoh.Config) -> zenoh.Session:
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = re.sub(r" at /\S+:\d+\.", "", str(error)).strip(" .!")
        advice = next((text for part, text in _ADVICE.items() if part in reason), "check it")
        raise LinkError(f"zenoh: {reason}: {advice}") from None
