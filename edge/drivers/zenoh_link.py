"""The radio of the robots and the ground, over zenoh.

What travels is in `edge.messages.topics`, below the key `lpac/<fleet>/`. Besides, for presence,
there are the liveliness tokens `robot/<id>/alive/<session>`, which vanish with the session that
declared them: at once if the program ends, a second after it stops answering.

In peer mode gossip makes a mesh from one known peer, but what only gossip connected is not
connected again when it alone is lost; scouting does it within some 8 s. So for flight let every
robot's `connect` name all robots with smaller ids, and the ground's all robots: the configured side
tries again for ever. Never name each other: two sides that connect at once after a cut may end up
connected and yet deaf to each other.
"""

import json
import os
import re
import secrets
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from threading import Lock, Thread
from typing import Literal, Self

import structlog
import zenoh

from edge.core.wire import MAX_ROBOT_ID
from edge.messages.topics import TOPICS, Sender, Topic

ReceiveCallback = Callable[[str, bytes], None]

# Of 64 kB each, for topics that go later: a world that does not fit in there at once is dropped.
_PATIENT_BATCHES = 8
_ENDPOINT = re.compile(r"tcp/(\[[^\s/\]]+\]|[^\s/:?#\[\]]+):\d{1,5}")
_TOKEN = re.compile(r"robot/(\d+)/alive/(\w+)")
_CLOSE_TIMEOUT_S = 1.0

# zenoh closes TCP sockets with a linger time of 10 s, which holds the closing thread for as long if
# the other end is out of reach. With zenoh's few threads, two lost neighbours would make a robot
# deaf to all others. Here each neighbour lost within 10 s may hold one; an idle one costs 10 kB.
_RUNTIME = "(rx: (worker_threads: 32), net: (worker_threads: 32))"

_ADVICE = {
    "Address already in use": "another program has this port; does this robot's already run?",
    "Cannot assign requested address": "this machine has no such address",
    "Unable to connect": "no router answers there; start it, or set mode = 'peer'",
}

_log = structlog.get_logger(__name__)


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
        mode: Literal["peer", "client"] = "peer",
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        scouting: bool = False,
        subscriptions: Mapping[Topic, ReceiveCallback] | None = None,
    ) -> None:
        """Open the session.

        `listen` and `connect` are endpoints, `tcp/<host>:<port>`; without `listen` a peer takes a
        free port. A peer opens even if nobody answers, and connects later; a client needs its
        router. `scouting` finds others by multicast.

        `subscriptions` maps topics to callbacks. They are called with the key below `lpac/<fleet>/`
        and the data, from zenoh's threads, several at once; what this session publishes is not
        among it, nor what is larger than its topic's limit. A callback must only store: a slow one
        holds up the link.

        Raises LinkError if a setting is wrong, a port is taken or a client finds no router.
        """
        _check(fleet, robot_id, mode, listen, connect, scouting)
        self._prefix = f"lpac/{fleet}/"
        self._own_prefix = self._prefix + ("ground/" if robot_id is None else f"robot/{robot_id}/")
        self._robot_id = robot_id
        self._lock = Lock()
        self._tokens: set[tuple[int, str]] = set()
        self._failures: Counter[str] = Counter()
        self._oversized: Counter[str] = Counter()
        self._session_id = _session_id(robot_id)
        self._session = _open(self._config(mode, listen, connect, scouting))
        try:
            self._publishers = self._declare(subscriptions or {})
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
        try:
            self._publishers[topic].put(data)
        except zenoh.ZError as error:
            self._failed(f"publish {topic.name}", error)

    def present(self) -> frozenset[int]:
        """The other robots whose programs are connected now."""
        return frozenset(id_ for id_ in self._others() if id_ != self._robot_id)

    def is_claimed(self, robot_id: int) -> bool:
        """Whether another session says that it is that robot.

        Up to a second after a restart that may be the own former session.
        """
        return robot_id in self._others()

    def duplicates(self) -> frozenset[int]:
        """The robot ids that more than one session claims, the own among them."""
        with self._lock:
            claims = Counter(id_ for id_, _ in self._tokens)
        return frozenset(id_ for id_, count in claims.items() if count > 1)

    def peers(self) -> int:
        """The number of zenoh peers and routers connected to this session."""
        try:
            return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())
        except zenoh.ZError:  # closed
            return 0

    def failures(self) -> int:
        """How many calls of callbacks and of `publish` failed; each kind's first is logged."""
        with self._lock:
            return self._failures.total()

    def close(self) -> None:
        """Leave the radio, within a second or so; again is no error."""
        # A connection whose other end is out of reach holds it, too; the interpreter can exit
        # though it is not done.
        closing = Thread(target=self._close_session, daemon=True)
        closing.start()
        closing.join(_CLOSE_TIMEOUT_S)

    def _close_session(self) -> None:
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            self._failed("close", error)

    def _config(
        self, mode: str, listen: Sequence[str], connect: Sequence[str], scouting: bool
    ) -> zenoh.Config:
        # Of two robots that find each other by scouting or gossip, the one of the greater id
        # connects: the same side as the configured endpoints make it.
        once = {"autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}}}
        retry = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}
        if mode == "peer":
            listen = listen or ("tcp/0.0.0.0:0",)
        config = zenoh.Config()
        for key, value in {
            "id": self._session_id,
            "mode": mode,
            "listen/endpoints": list(listen),
            "connect/endpoints": list(connect),
            "connect/retry": retry,
            "scouting/delay": 0,
            "scouting/multicast": {"enabled": scouting, **once},
            "scouting/gossip": once,
            # How soon a lost neighbour is noticed.
            "transport/link/tx/lease": 1000,
            "transport/link/tx/queue/size/background": _PATIENT_BATCHES,
            # An attempt that a lost packet holds up is given up soon, and made again.
            "transport/unicast/open_timeout": 2000,
            "transport/unicast/accept_timeout": 2000,
            # 200 MB among ten robots, for no gain.
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        return config

    def _declare(
        self, subscriptions: Mapping[Topic, ReceiveCallback]
    ) -> dict[Topic, zenoh.Publisher]:
        for topic, callback in subscriptions.items():
            self._session.declare_subscriber(
                self._prefix + topic.pattern,
                self._guarded(topic, callback),
                allowed_origin=zenoh.Locality.REMOTE,
            )
        liveliness = self._session.liveliness()
        liveliness.declare_subscriber(
            self._prefix + "robot/*/alive/*", self._on_token, history=True
        )
        if self._robot_id is not None:
            # Kept, since a token that nothing refers to is withdrawn.
            self._token = liveliness.declare_token(f"{self._own_prefix}alive/{self._session_id}")
        own: Sender = "ground" if self._robot_id is None else "robot"
        return {
            topic: self._session.declare_publisher(
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
            for topic in TOPICS
            if topic.sender == own
        }

    def _guarded(self, topic: Topic, callback: ReceiveCallback) -> Callable[[zenoh.Sample], None]:
        def receive(sample: zenoh.Sample) -> None:
            try:
                key = str(sample.key_expr).removeprefix(self._prefix)
                if len(sample.payload) > topic.limit_bytes:
                    self._too_long(key)
                    return
                callback(key, sample.payload.to_bytes())
            except Exception as error:
                self._failed(f"callback {topic.pattern}", error)

        return receive

    def _too_long(self, key: str) -> None:
        with self._lock:
            self._oversized[key] += 1
            first = self._oversized[key] == 1
        if first:
            _log.warning("a message is larger than its topic's limit: not read", key=key)

    def _failed(self, what: str, error: Exception) -> None:
        with self._lock:
            self._failures[what] += 1
            first = self._failures[what] == 1
        if first:
            _log.error("link failure", what=what, exc_info=error)

    def _on_token(self, sample: zenoh.Sample) -> None:
        match = _TOKEN.fullmatch(str(sample.key_expr).removeprefix(self._prefix))
        if match is None:
            return
        token = int(match[1]), match[2]
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._tokens.add(token)
            else:
                self._tokens.discard(token)

    def _others(self) -> frozenset[int]:
        """The robot ids that other sessions claim."""
        with self._lock:
            return frozenset(id_ for id_, session in self._tokens if session != self._session_id)


def _check(
    fleet: str,
    robot_id: int | None,
    mode: str,
    listen: Sequence[str],
    connect: Sequence[str],
    scouting: bool,
) -> None:
    if not re.fullmatch(r"[\w-]+", fleet):
        raise LinkError(f"fleet = {fleet!r}: must be letters, digits, '-' and '_'")
    if robot_id is not None and not 0 <= robot_id <= MAX_ROBOT_ID:
        raise LinkError(f"robot_id = {robot_id}: must be from 0 to {MAX_ROBOT_ID}")
    # zenoh itself would wait for ever for an endpoint that cannot be.
    for name, endpoints in (("listen", listen), ("connect", connect)):
        for endpoint in endpoints:
            if not _ENDPOINT.fullmatch(endpoint):
                raise LinkError(f"{name} = {endpoint!r}: must be 'tcp/<host>:<port>'")
    if mode == "client" and not (connect or scouting):
        raise LinkError("mode = 'client' needs the router's endpoint in connect, or scouting")


def _session_id(robot_id: int | None) -> str:
    """Unique, and ordered as robot ids are, the ground after all robots.

    zenoh compares the bytes from the end of the text.
    """
    rank = MAX_ROBOT_ID + 1 if robot_id is None else robot_id
    return f"1{secrets.token_hex(12)}{rank.to_bytes(3, 'little').hex()}"


def _open(config: zenoh.Config) -> zenoh.Session:
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = re.sub(r" at /\S+:\d+\.", "", str(error)).strip(" .!")
        advice = next((text for part, text in _ADVICE.items() if part in reason), "check it")
        raise LinkError(f"zenoh: {reason}: {advice}") from None
