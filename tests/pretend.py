"""Pretended robots, for tests of the ground alone: they say what robots say, and fly nothing.

They take up the ground's state, obey orders, and move in circles while they fly their mission.
`python -m tests.pretend FOLDER -n 30` writes FOLDER/fleet.toml and runs them until Ctrl-C.
"""

import argparse
import json
import math
import secrets
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core.fence import Fence
from edge.core.perception import EXPLORED_CELLS
from edge.core.vehicle import Vector
from edge.core.world import format_world, random_features
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.codec import decode, encode
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import (
    ON_GROUND,
    FlightState,
    GroundState,
    LoopStatus,
    Order,
    OrderResult,
    Origin,
    RobotStatus,
    explored_to_bytes,
    world_id,
)
from edge.messages.topics import EXPLORED, ORDER, STATE, STATUS, WORLD
from edge.policy.bundle import load_bundle
from lpac.sim.ports import free_ports
from tests.conftest import SHIPPED
from tests.said import checks, reason, reasons, refusal

PERIOD_S = 0.25
WORLD_M = 32.0
BASE_HEIGHT_M = 4.0
SLOT_SPACING_M = 2.0
MAX_SPEED_M_S = 1.25
ORIGIN = Origin(47.397742, 8.545594, 30.0)
FENCE = Fence(((-2.0, -2.0), (34.0, -2.0), (34.0, 34.0), (-2.0, 34.0)), 1.5, 2.0, 100.0)
_GROUND_TIMEOUT_S = 3.0

_S = FlightState


@dataclass
class PretendedRobot:
    """One of them. What is set from outside counts from the next status on.

    `refuses` is a reason not to take off, `silent` keeps it from saying anything, `deaf` from
    hearing anything.
    """

    robot_id: int
    slot: int
    pad_m: tuple[float, float]
    landing_point_m: tuple[float, ...]
    fleet_size: int
    bundle_id: str
    world_id: str
    refuses: str = ""
    silent: bool = False
    deaf: bool = False
    takeoff_s: float = 1.0
    speed_m_s: float = 1.0
    battery: float = 0.9
    alarms: tuple[str, ...] = ()
    now_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.boot_nonce = secrets.randbits(48)
        self.began_s = self.now_s
        self.sequence = 0
        self.state = _S.INIT
        self.reason = "program started"
        self.since_s = self.began_s
        self.position_m: Vector = (*self.pad_m, 0.0)
        self.velocity_m_s: Vector = (0.0, 0.0, 0.0)
        self.ground: GroundState | None = None
        self.ground_at_s = -math.inf
        self.origin: Origin | None = None
        self.fence = FENCE
        self.trial = ""
        self.not_taken: tuple[FailedCheck, ...] = ()
        self.answers: list[OrderResult] = []
        self.ordered: Order | None = None
        self.explored = np.zeros((EXPLORED_CELLS, EXPLORED_CELLS), np.bool_)
        self.phase_rad = 2.0 * math.pi * self.slot / max(self.fleet_size, 1)

    @property
    def slot_height_m(self) -> float:
        return BASE_HEIGHT_M + self.slot * SLOT_SPACING_M

    @property
    def armed(self) -> bool:
        return self.state not in ON_GROUND and self.state is not _S.FAULT

    def restart(self) -> None:
        """Its program starts again, on the ground."""
        self.__post_init__()

    @property
    def hears_ground(self) -> bool:
        return self.now_s - self.ground_at_s <= _GROUND_TIMEOUT_S

    # What it hears

    def hear_state(self, state: GroundState) -> None:
        if self.deaf:
            return
        before = self.ground
        ranks = [(s.sequence, s.operator) for s in (state, before) if s is not None]
        if len(ranks) == 2 and ranks[0] < ranks[1] and self.hears_ground:
            return
        self.ground, self.ground_at_s = state, self.now_s

    def hear_order(self, order: Order) -> None:
        if self.deaf or order.robot_id != self.robot_id:
            return
        if any(answer.order_id == order.order_id for answer in self.answers):
            return
        problem = self._problem(order)
        self.answers = [*self.answers, OrderResult(order.order_id, refusal(problem))][-8:]
        if problem:
            return
        if order.kind == "takeoff":
            self.enter(_S.ARMING, "takeoff ordered")
        elif order.kind == "start":
            if order.trial != self.trial:
                self.explored[:] = False
            self.trial = order.trial
            self.enter(_S.MISSION, "mission started")
        elif order.kind == "pilot":
            self.enter(_S.PILOT, "given to the pilot by the operator")
        elif order.kind == "rejoin":
            self.enter(_S.HOLD, "taken back by the operator")
        elif order.kind == "reset":
            self.explored[:] = False
            self.trial = ""
        elif order.kind == "kill":
            self.enter(_S.FAULT, "killed by the operator")

    def _problem(self, order: Order) -> str:
        ground = self.ground
        if order.boot_nonce != self.boot_nonce:
            return "meant for another start of this robot's program"
        if order.kind == "kill":
            return ""
        if ground is None or ground.operator != order.operator:
            return f"{'' if ground is None else ground.operator} commands this robot"
        sources = {
            "takeoff": (_S.PREFLIGHT,), "start": (_S.HOLD,), "rejoin": (_S.PILOT,),
            "pilot": (_S.HOLD, _S.MISSION), "disarm": ON_GROUND,
            "reset": tuple(s for s in _S if s is not _S.MISSION),
        }[order.kind]  # fmt: skip
        if self.state not in sources:
            return f"{order.kind} is not taken in {self.state}"
        if order.kind in ("takeoff", "start") and self._safety_action() != "none":
            return f"the ground commands {self._safety_action()}"
        if order.kind == "takeoff" and self.refuses:
            return f"not ready: {self.refuses}"
        return ""

    def _safety_action(self) -> str:
        if self.ground is None:
            return "none"
        asked = self.ground.safety_action_for(self.robot_id)
        return "hold" if asked == "none" and not self._enabled() else asked

    def _enabled(self) -> bool:
        return self.ground is not None and self.ground.enabled_for(self.robot_id)

    def hear_world(self, text: str) -> None:
        wanted = None if self.ground is None else self.ground.world_id
        if not self.deaf and self.state in ON_GROUND and world_id(text) == wanted:
            self.world_id = wanted

    # What it does

    def enter(self, state: FlightState, reason: str) -> None:
        self.state, self.reason, self.since_s = state, reason, self.now_s

    def step(self, now_s: float, passed_s: float) -> None:  # noqa: PLR0912
        """Some time has passed."""
        self.now_s = now_s
        self._take_up()
        age_s = now_s - self.since_s
        heard = self.hears_ground
        safety_action = self._safety_action() if heard else "none"
        state = self.state
        steered = (_S.TAKEOFF, _S.HOLD, _S.MISSION, _S.RETURN)
        may_fly = heard and self._enabled() and self.origin is not None
        if state is _S.INIT:
            self.enter(_S.IDLE, "autopilot and position found")
        elif state is _S.IDLE and may_fly and age_s > 0.5:
            self.enter(_S.PREFLIGHT, "enabled")
        elif state is _S.PREFLIGHT and not may_fly:
            self.enter(_S.IDLE, "not enabled" if heard else "ground lost")
        elif state is _S.LANDED and may_fly and safety_action == "none":
            self.enter(_S.PREFLIGHT, "enabled")
        elif state is _S.ARMING and (safety_action != "none" or not heard):
            self.enter(_S.IDLE, f"ground commands {safety_action} while arming")
        elif state is _S.ARMING and age_s > 0.2:
            self.enter(_S.TAKEOFF, "armed")
        elif state in steered and safety_action == "land":
            self.enter(_S.LAND, "ground commands land")
        elif state is _S.TAKEOFF and safety_action == "return":
            self.enter(_S.LAND, "ground commands return during takeoff")
        elif state in (_S.TAKEOFF, _S.MISSION, _S.RETURN, _S.LAND) and safety_action == "hold":
            self.enter(_S.HOLD, "ground commands hold")
        elif state in (_S.HOLD, _S.MISSION) and safety_action == "return":
            self.enter(_S.RETURN, "ground commands return")
        elif state in (_S.MISSION, _S.RETURN) and not heard:
            self.enter(_S.HOLD, "ground lost")
        elif state is _S.TAKEOFF and self.position_m[2] > self.slot_height_m - 0.1:
            self.enter(_S.HOLD, f"at its height, {self.slot_height_m:g} m")
        elif state is _S.RETURN and self._away_m(self.landing_point_m) < 0.5:
            self.enter(_S.LAND, "at the landing point")
        elif state is _S.LAND and self.position_m[2] <= 0.0:
            self.enter(_S.LANDED, "disarmed")
        self._move(passed_s)

    def _take_up(self) -> None:
        ground = self.ground
        if ground is None:
            return
        place = ground.places.get(str(self.robot_id))
        wanted = {
            "origin": (ground.origin, self.origin),
            "fence": (ground.fence or FENCE, self.fence),
            "world": (ground.world_id or self.world_id, self.world_id),
        }
        if self.state in ON_GROUND:
            self.origin, self.fence = ground.origin, ground.fence or FENCE
            if place is not None:
                self.slot, self.landing_point_m = place.slot, place.landing_point_m
            text = "world: its text has not come yet"
            waits = FailedCheck(CheckCode.WORLD_NOT_ARRIVED, text, settles_by_itself=True)
            self.not_taken = (waits,) if wanted["world"][0] != wanted["world"][1] else ()
        else:
            self.not_taken = tuple(
                FailedCheck(CheckCode(f"keeps_{name}"), f"{name}: not in flight")
                for name, (asked, has) in wanted.items()
                if asked != has
            )

    def _away_m(self, place_m: Sequence[float]) -> float:
        return math.dist(self.position_m[:2], place_m)

    def _move(self, passed_s: float) -> None:
        x_m, y_m, z_m = self.position_m
        climb_m_s = self.slot_height_m / self.takeoff_s
        if self.state is _S.TAKEOFF:
            after = x_m, y_m, min(self.slot_height_m, z_m + climb_m_s * passed_s)
        elif self.state in (_S.LAND, _S.FAULT):
            after = x_m, y_m, max(0.0, z_m - climb_m_s * passed_s)
        elif self.state is _S.MISSION:
            radius_m = 0.35 * WORLD_M
            self.phase_rad += self.speed_m_s / radius_m * passed_s
            goal_m = (
                WORLD_M / 2.0 + radius_m * math.cos(self.phase_rad),
                WORLD_M / 2.0 + radius_m * math.sin(self.phase_rad),
            )
            after = (*self._towards_m(goal_m, passed_s), z_m)
        elif self.state is _S.RETURN:
            after = (*self._towards_m(self.landing_point_m, passed_s), z_m)
        else:
            # Tests may place it meanwhile.
            self.velocity_m_s = (0.0, 0.0, 0.0)
            return
        vx, vy, vz = (
            (b - a) / passed_s if passed_s > 0.0 else 0.0
            for a, b in zip(self.position_m, after, strict=True)
        )
        self.position_m, self.velocity_m_s = after, (vx, vy, vz)
        if self.armed:
            i, j = (int(c / WORLD_M * EXPLORED_CELLS) for c in after[:2])
            self.explored[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = True

    def _towards_m(self, goal_m: Sequence[float], passed_s: float) -> tuple[float, float]:
        away_m = self._away_m(goal_m)
        share = min(1.0, 2.0 * self.speed_m_s * passed_s / away_m) if away_m > 0.0 else 1.0
        x_m, y_m, _ = self.position_m
        return x_m + share * (goal_m[0] - x_m), y_m + share * (goal_m[1] - y_m)

    # What it says

    def status(self, now_s: float) -> RobotStatus:
        self.now_s = now_s
        heard = self.hears_ground
        self.sequence += 1
        ready = self.state is _S.PREFLIGHT and not self.refuses
        failed: tuple[str, ...] = (self.refuses,) if self.refuses else ()
        if not heard:
            failed += ("the ground's state is not heard",)
        neighbours = [r for r in range(self.fleet_size) if r != self.robot_id][:8]
        uptime_s = now_s - self.began_s
        loop = LoopStatus(int(10 * uptime_s), 0, 0, 0.2, 1.1, 3.0)
        gps = ORIGIN.latitude_deg, ORIGIN.longitude_deg
        vx, vy, _ = self.velocity_m_s
        return RobotStatus(
            robot_id=self.robot_id,
            boot_nonce=self.boot_nonce,
            sequence=self.sequence,
            uptime_s=uptime_s,
            unix_time_s=time.time(),
            state=self.state,
            reason=reason(self.reason),
            ready=ready,
            failed_checks=checks(*failed),
            alarms=reasons(*(() if heard or not self.armed else ("ground lost",)), *self.alarms),
            obeyed_sequence=0 if self.ground is None else self.ground.sequence,
            operator="" if self.ground is None else self.ground.operator,
            orders=tuple(self.answers),
            bundle_id=self.bundle_id,
            world_id=self.world_id,
            trial=self.trial,
            origin=self.origin,
            system_id=self.robot_id + 1,
            slot_height_m=self.slot_height_m,
            landing_point_m=self.landing_point_m,
            position_m=None if self.origin is None else self.position_m,
            velocity_m_s=self.velocity_m_s,
            heading_rad=math.atan2(vx, vy) % (2.0 * math.pi),
            mode="offboard" if self.armed and self.state is not _S.PILOT else "hold",
            armed=self.armed,
            battery=self.battery,
            satellites=14,
            message_counts={"accepted": int(20 * uptime_s)},
            neighbour_ages_s={str(r): 0.1 + 0.05 * i for i, r in enumerate(neighbours)},
            loops={"control": loop, "perception": loop, "policy": loop},
            fence=self.fence,
            not_taken=self.not_taken,
            in_air=self.armed,
            global_deg=gps,
            hdop=0.8,
            policy_velocity_m_s=(0.5, -0.2),
            feature_age_s=0.1,
            neighbour_messages={str(r): int(2.5 * uptime_s) for r in neighbours},
            ground_age_s=None if self.ground is None else now_s - self.ground_at_s,
        )


class PretendedFleet:
    """`n` pretended robots, one zenoh session each, and their fleet.toml in `folder`; a context.

    `robots` may be changed while they run; `duplicate` starts a second program of one of them.
    """

    def __init__(
        self,
        folder: Path,
        n: int,
        *,
        spares: int = 0,
        name: str = "",
        speed_m_s: float = 1.0,
        absent: Collection[int] = (),
    ) -> None:
        """Those that are `absent` come with `join`."""
        self.folder = folder
        self.fleet_toml = folder / "fleet.toml"
        self.name = name or f"pretend-{secrets.token_hex(3)}"
        self._world = format_world(random_features(np.random.default_rng(0), 10, 512))
        bundle_id = load_bundle(SHIPPED).id
        self.robots = [
            PretendedRobot(
                robot_id=i,
                slot=i,
                pad_m=_pad_m(i),
                landing_point_m=_pad_m(i),
                fleet_size=n,
                bundle_id=bundle_id,
                world_id=world_id(self._world),
                speed_m_s=speed_m_s,
            )
            for i in range(n + spares)
        ]
        self._n = n
        self._absent = frozenset(absent)
        self._lock = threading.Lock()
        self._ends = threading.Event()
        self._links: list[tuple[PretendedRobot, ZenohLink]] = []
        self._thread = threading.Thread(target=self._run, name="pretend", daemon=True)
        self._stack = ExitStack()

    def __enter__(self) -> "PretendedFleet":
        self.ports = free_ports(len(self.robots))
        self._write()
        for robot in self.robots:
            if robot.robot_id not in self._absent:
                self.join(robot.robot_id)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        self._thread.join()
        self._stack.close()

    @property
    def endpoints(self) -> tuple[str, ...]:
        return tuple(f"tcp/127.0.0.1:{port}" for port in self.ports)

    def join(self, robot_id: int) -> None:
        """Start the program of a robot that was absent."""
        self._open(self.robots[robot_id], [self.endpoints[robot_id]])

    def duplicate(self, robot_id: int) -> PretendedRobot:
        """A second program that says that it is this robot."""
        original = self.robots[robot_id]
        second = replace(original)
        self._open(second, [], [f"tcp/127.0.0.1:{self.ports[robot_id]}", *self.endpoints])
        return second

    def _open(
        self, robot: PretendedRobot, listen: Sequence[str], connect: Sequence[str] = ()
    ) -> None:
        def guarded(act: Callable[[bytes], None]) -> Callable[[str, bytes], None]:
            def receive(_: str, data: bytes) -> None:
                with self._lock:
                    robot.now_s = time.monotonic()
                    act(data)

            return receive

        link = ZenohLink(
            fleet=self.name,
            robot_id=robot.robot_id,
            listen=listen or ("tcp/127.0.0.1:0",),
            connect=connect,
            subscriptions={
                STATE: guarded(lambda data: robot.hear_state(decode(GroundState, data))),
                ORDER: guarded(lambda data: robot.hear_order(decode(Order, data))),
                WORLD: guarded(lambda data: robot.hear_world(data.decode())),
            },
        )
        self._stack.callback(link.close)
        with self._lock:
            self._links.append((robot, link))

    def _run(self) -> None:
        last_s = time.monotonic()
        tick = 0
        while not self._ends.wait(PERIOD_S):
            now_s = time.monotonic()
            with self._lock:
                said = []
                for i, (robot, link) in enumerate(self._links):
                    robot.step(now_s, now_s - last_s)
                    if robot.silent:
                        continue
                    said.append((link, STATUS, encode(robot.status(now_s))))
                    if (tick + i) % 4 == 0:
                        said.append((link, EXPLORED, explored_to_bytes(robot.explored)))
            last_s = now_s
            tick += 1
            for link, topic, data in said:
                link.publish(topic, data)

    def _write(self) -> None:
        (self.folder / "world.env").write_text(self._world)
        robot: dict[str, dict[str, Any]] = {
            "autopilot": {"url": "udpin://127.0.0.1:14551"},
            "flight": {"base_height_m": BASE_HEIGHT_M, "slot_spacing_m": SLOT_SPACING_M},
            "fence": {
                "vertices_m": [list(vertex) for vertex in FENCE.vertices_m],
                "buffer_m": FENCE.buffer_m, "floor_m": FENCE.floor_m, "ceiling_m": FENCE.ceiling_m,
            },
            "limits": {
                "max_speed_m_s": MAX_SPEED_M_S, "max_climb_m_s": 2.0,
                "max_acceleration_m_s2": 2.0, "lag_s": 1.3,
            },
            "failsafe": {"rc": "none"},
            # Thirty of them stand on one field: with corrections, on flat ground.
            "errors": {"gps_m": 0.25, "height_apart_m": 0.2, "takeoffs_height_m": 0.1,
                       "pads_height_m": 0.2},
        }  # fmt: skip
        lines = [
            f'fleet = "{self.name}"', 'image = "image"', f'bundle = "{SHIPPED}"',
            'world = "world.env"',
        ]  # fmt: skip
        for table, keys in robot.items():
            lines += [f"[robot.{table}]", *(f"{k} = {json.dumps(v)}" for k, v in keys.items())]
        for i, port in enumerate(self.ports):
            lines += [
                f"[robots.r{i}]", f'host = "127.0.1.{i + 1}"', f"robot_id = {i}",
                'address = "127.0.0.1"', f"zenoh_port = {port}", f"system_id = {i + 1}",
            ]  # fmt: skip
        for i in range(self._n):
            place = json.dumps(list(_pad_m(i)))
            lines += [
                "[[slots]]", f'robot = "r{i}"', f"pad_m = {place}", f"landing_point_m = {place}",
            ]  # fmt: skip
        self.fleet_toml.write_text("\n".join(lines) + "\n")


def _pad_m(i: int) -> tuple[float, float]:
    """Along the lower edge of the field, and then in further rows."""
    return 2.0 + 2.5 * (i % 12), 2.0 + 2.5 * (i // 12)


@contextmanager
def pretended(folder: Path, n: int, **options: Any) -> Iterator[PretendedFleet]:
    """A fleet that runs."""
    with PretendedFleet(folder, n, **options) as fleet:
        yield fleet


def main() -> None:
    parser = argparse.ArgumentParser(description="Run pretended robots until Ctrl-C.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("-n", type=int, default=3)
    parser.add_argument("--spares", type=int, default=0)
    parser.add_argument("--name", default="")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    ends = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ends.set())
    with PretendedFleet(
        arguments.folder, arguments.n, spares=arguments.spares, name=arguments.name
    ) as fleet:
        print(
            f"{arguments.n} pretended robots of fleet {fleet.name}: {fleet.fleet_toml}", flush=True
        )
        ends.wait()


if __name__ == "__main__":
    main()
