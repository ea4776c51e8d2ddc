"""Layout of a simulated fleet: its world, field and fence, and the robots' pads."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge.core import F64
from edge.core.frames import LocalTransform
from edge.flight.margins import places_apart
from edge.messages.mission import Origin
from edge.policy.bundle import load_bundle, make_bundle, write_bundle
from lpac.analysis.truth import TrueTrack
from lpac.analysis.worlds import format_world
from lpac.fleet.settings import RobotPaths
from lpac.fleet.writer import assign, write_fleet, write_robot
from lpac.sim.description import FIELD_SCALE, fence_around, robot_table
from lpac.sim.px4.errors import Errors
from lpac.sim.px4.vector import ZERO
from lpac.sim.px4.vehicle import GPS_ACCURACY_M, Px4Vehicle
from lpac.sim.px4.world import WorldOrigin
from lpac.sim.scenario import Scenario

MAX_ROBOTS = 30

# Further keys of robot.toml, by table.
Settings = Mapping[str, Mapping[str, object]]

# The field is the policy's world; its y axis does not point north, so that frame errors show.
WORLD = WorldOrigin()
ORIGIN = Origin(WORLD.latitude_deg, WORLD.longitude_deg, heading_deg=30.0)

# As far inside the field as there is room, since position estimates drift.
_PADS_INSIDE_FIELD_M = (2.0, 1.0, 0.0)
# Number of draws, and of pushes apart after each, before giving up.
_PAD_DRAWS = 30
_PAD_PUSHES = 300
# Tolerance for rounding and the last push.
_PAD_SLACK = 1e-3


def settings_of(scenario: Scenario) -> Settings:
    """Tables of robot.toml that a scenario sets."""
    clocks = scenario.clocks
    return {
        "rates": {
            "perception_hz": 1.0 / clocks.perception_s,
            "policy_hz": 1.0 / clocks.policy_s,
            "control_hz": 1.0 / clocks.control_s,
        },
        "policy": {
            "max_message_age_s": scenario.max_message_age_s,
            "max_input_age_s": scenario.input_age_s,
        },
        # PX4 obeys the remote control only with this setting.
        "failsafe": {"rc": "pilot"} if scenario.failures else {},
    }


def require_whole_robots(scenario: Scenario) -> None:
    """Raise ValueError that names a field whole robots do not support."""
    scenario.require_default(
        "whole robots", "controller", "scale", "max_speed_m_s", "position_bias",
        "position_error_m", "lag_s", "payload", "radio",
    )  # fmt: skip
    if scenario.robots > MAX_ROBOTS:
        raise ValueError(f"robots = {scenario.robots}: must be from 1 to {MAX_ROBOTS}")
    if scenario.clocks.synchronous:
        raise ValueError("synchronous = True: must be False for whole robots")
    if scenario.wind_m_s is not None and not scenario.errors:
        raise ValueError(f"wind_m_s = {scenario.wind_m_s}: must be left out without errors")
    for failure in scenario.failures:
        if not math.isfinite(failure.until_s):
            raise ValueError(
                f"failures: robot {failure.robot} has no until_s: whole robots must come back"
            )


class Layout:
    """A fleet's world, field, fence and pads, all derived from its scenario.

    `pads_m` (N, 2) are the true pads, `landing_points_m` (N, 2) the points to which robots return,
    both in the mission frame. `vehicles` are simulated ones on those pads; `without_vehicles`
    leaves them out, for real PX4s without position errors.
    """

    def __init__(
        self, scenario: Scenario, bundle_path: Path, *, without_vehicles: bool = False
    ) -> None:
        """Raise ValueError if there is too little room for the robots; BundleError for a bundle
        that cannot be loaded, or has no perception."""
        require_whole_robots(scenario)
        self.bundle, self.bundle_path = load_bundle(bundle_path), bundle_path.resolve()
        manifest, perception = self.bundle.manifest, scenario.perception_of(self.bundle)
        self._has_own_sizes = perception != manifest.perception
        if self._has_own_sizes:
            files = {name: self.bundle.files[name] for name in manifest.files}
            self.bundle = make_bundle(replace(manifest, perception=perception), files)
        training = manifest.training
        self.scenario = scenario
        self.field_m = perception.world_size / FIELD_SCALE.env_scale
        for i, place_m in enumerate(scenario.starts_m or ()):
            if not all(0.0 <= metres <= self.field_m for metres in place_m):
                raise ValueError(
                    f"starts_m[{i}] = {list(place_m)}: must be in the world, from 0 to "
                    f"{self.field_m:g} m"
                )
        self.max_speed_m_s = training.max_speed * FIELD_SCALE.velocity_scale
        self.to_mission: LocalTransform = ORIGIN.frame().relative_to(
            WORLD.latitude_deg, WORLD.longitude_deg
        )
        self.fence = fence_around(self.field_m, scenario.robots, scenario.budget)
        position_m = scenario.budget.position_m
        self.apart_m = places_apart(position_m, position_m).least_m
        self.features = scenario.draw_features(perception.world_size)
        self.vehicles: tuple[Px4Vehicle, ...] = ()
        if without_vehicles:
            exact_m = np.zeros((1, scenario.robots, 2))
            self.pads_m = self.landing_points_m = self._draw_pads(exact_m)
        else:
            self.pads_m, self.landing_points_m, self.vehicles = self._draw_vehicles()

    def mission_track(self, track: TrueTrack) -> TrueTrack:
        """Convert a track from the world frame to the mission frame."""
        rotation, origin_m = self.to_mission.rotation, self.to_mission.local_origin_m
        position_m = track.position_m @ rotation.T + origin_m
        # The ground is at down = 0 at any height of the frame's origin; subtract to avoid -0.0.
        position_m[:, 2] = 0.0 - track.position_m[:, 2]
        velocity_m_s = track.velocity_m_s @ rotation.T
        return replace(track, position_m=position_m, velocity_m_s=velocity_m_s)

    def to_world_m(self, place_m: F64) -> tuple[float, float]:
        """North and east, m, of a position (2,) in the mission frame."""
        north_m, east_m, _ = self.to_mission.mission_to_local(np.array([*place_m, 0.0])).tolist()
        return north_m, east_m

    def way_out(self, position_ned_m: F64) -> tuple[F64, float]:
        """Direction (2,), north and east, to the fence's nearest line, and the distance inside
        it, m."""
        place_m = self.to_mission.local_to_mission(position_ned_m)[:2]
        edges = self.fence.edges()
        out = -edges.inward[int(np.argmin(edges.distances_m(place_m)))]
        turned: F64 = (self.to_mission.rotation @ np.array([*out, 0.0]))[:2]
        return turned, float(self.fence.distance_m(*place_m))

    def write(
        self,
        folder: Path,
        fleet: str,
        robots: Mapping[str, Mapping[str, object]],
        *,
        settings: Mapping[str, Mapping[str, object]] | None = None,
        spares: int = 0,
        keys: bool = False,
        radio: Mapping[str, str] | None = None,
    ) -> None:
        """fleet.toml, world.env, and robots/<i>/robot.toml in `folder`.

        If the scenario's world size or range differs from the bundle's, a bundle with these sizes
        is written to `folder` for the robots.

        `robots` has each robot's further entries in fleet.toml, by name and in order.
        `settings` are further keys of robot.toml's tables, for all robots. The last `spares` have
        no slot in fleet.toml, but a robot.toml. `keys`: keys of a secure fleet are in `folder`, as
        written by `write_keys`. `radio` is fleet.toml's table of that name.
        """
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "world.env").write_text(format_world(self.features))
        robot = robot_table(self.fence, self.max_speed_m_s, self.scenario.budget)
        robot["sensor"] = {"type": self.scenario.sensor}
        for further in (settings_of(self.scenario), settings or {}):
            for table, values in further.items():
                robot[table] = {**robot.get(table, {}), **values}
        if self._has_own_sizes:
            self.bundle_path = folder / "bundle"
            write_bundle(self.bundle, self.bundle_path)
        config = write_fleet(
            folder / "fleet.toml",
            "Made by `lpac sim`: the robots are programs of this machine, without image or SSH.",
            {
                "fleet": fleet,
                **({"keys": "keys"} if self.scenario.secure and keys else {}),
                **({"radio": radio} if radio else {}),
                "image": "none",
                "bundle": str(self.bundle_path),
                "world": "world.env",
                "robot": robot,
                # A host name that never resolves keeps deployments off this machine.
                "robots": {
                    name: {
                        "host": f"{name}.invalid",
                        "address": "127.0.0.1",
                        "robot_id": robot_id,
                        **entries,
                    }
                    for robot_id, (name, entries) in enumerate(robots.items())
                },
                "slots": [
                    {
                        "robot": name,
                        "height": robot_id,
                        "pad_m": self._pad_seen_m(robot_id),
                        "landing_point_m": self._pad_seen_m(robot_id),
                    }
                    for robot_id, name in enumerate(robots)
                ],
            },
        )
        paths = RobotPaths(
            str(self.bundle_path), "../../world.env", "identity", "logs", "127.0.0.1"
        )
        for robot_id, name in enumerate(robots):
            write_robot(folder / "robots" / str(robot_id) / "robot.toml", config, name, paths)
        for slot in range(len(robots) - spares, len(robots)):
            assign(folder / "fleet.toml", slot, None)

    def _pad_seen_m(self, robot: int) -> list[float]:
        """A robot's pad by its own estimate: mission frame, m."""
        return [round(c, 3) for c in self.landing_points_m[robot].tolist()]

    def _draw_vehicles(self) -> tuple[F64, F64, tuple[Px4Vehicle, ...]]:
        """Pads, landing points and vehicles. A robot lands at its own estimate of its pad."""
        robots = self.scenario.robots
        seeds = np.random.SeedSequence([self.scenario.seed, robots]).generate_state(robots).tolist()
        # A vehicle's bias is needed before its pad, so it is drawn twice from the same seed.
        biases_m = np.zeros((robots, 2))
        if self.scenario.errors:
            drawn_m = [np.array(Px4Vehicle(seed=seed).gps_bias_m) for seed in seeds]
            biases_m = np.array([self._horizontal(bias_m) for bias_m in drawn_m])
        pads_m = self._draw_pads(biases_m[None])
        headings_rad = np.random.default_rng(seeds).uniform(0.0, math.tau, robots).tolist()
        vehicles = []
        for seed, pad_m, heading_rad in zip(seeds, pads_m, headings_rad, strict=True):
            north_m, east_m = self.to_world_m(pad_m)
            vehicle = Px4Vehicle(
                seed=seed, start_m=(north_m, east_m), heading_rad=heading_rad, origin=WORLD,
                errors=self._errors(seed),
            )  # fmt: skip
            if not self.scenario.errors:
                vehicle.gps_bias_m = ZERO
                # At most half of the position error, as a receiver with corrections reports.
                accuracy_m = min(GPS_ACCURACY_M[0], self.scenario.budget.gps_m / 2.0)
                vehicle.gps_accuracy_override_m = accuracy_m
            vehicles.append(vehicle)
        return pads_m, pads_m + biases_m, tuple(vehicles)

    def _errors(self, seed: int) -> Errors | None:
        scenario = self.scenario
        return Errors(seed, scenario.seed, scenario.wind_m_s) if scenario.errors else None

    def _draw_pads(self, biases_m: F64) -> F64:
        """Pads (N, 2) apart from each other, in truth and with each of the biases (N, 2) added."""
        if self.scenario.starts_m is not None:
            return np.array(self.scenario.starts_m)
        rng = np.random.default_rng([self.scenario.seed, 1])
        robots, field_m = biases_m.shape[1], self.field_m
        pads_m = _pads_within(biases_m, field_m, self.apart_m, rng)
        if pads_m is not None:
            return pads_m
        fit = next(
            fewer
            for fewer in range(robots - 1, 0, -1)
            if _pads_apart(biases_m[:, :fewer], 0.0, field_m, self.apart_m, rng) is not None
        )
        raise ValueError(
            f"robots = {robots}: {fit} fit on {field_m:g} x {field_m:g} m, with pads "
            f"{self.apart_m:g} m apart, which is twice the position error"
        )

    def _horizontal(self, vector_m: F64) -> F64:
        """Horizontal part (2,) in mission axes of a world vector (3,)."""
        turned: F64 = self.to_mission.velocity_to_mission(vector_m)[:2]
        return turned


def pads_for_all(scenarios: Sequence[Scenario], bundle: Path, spare_m: float = 0.0) -> F64:
    """Pads (N, 2) that suit all scenarios, with a tolerance of `spare_m`.

    They are apart in truth, and by the receivers of each scenario; all scenarios have the same
    number of robots and the same budget. Raises ValueError if there is no room, BundleError.
    """
    nowhere_m = tuple((0.0, 0.0) for _ in range(scenarios[0].robots))
    layouts = [Layout(replace(scenario, starts_m=nowhere_m), bundle) for scenario in scenarios]
    apart_m, field_m = layouts[0].apart_m, layouts[0].field_m
    pads_m = _pads_within(
        np.stack([layout.landing_points_m for layout in layouts]),
        field_m,
        apart_m + 2.0 * spare_m,
        np.random.default_rng([scenarios[0].seed, 1]),
    )
    if pads_m is None:
        raise ValueError(
            f"no pads on {field_m:g} x {field_m:g} m are {apart_m:g} m apart for the receiver "
            f"errors of all {len(scenarios)} trials: fly fewer"
        )
    return pads_m


def _pads_within(
    biases_m: F64, field_m: float, apart_m: float, rng: np.random.Generator
) -> F64 | None:
    """Pads as far inside the field as there is room; see `_pads_apart`."""
    for inside_m in _PADS_INSIDE_FIELD_M:
        pads_m = _pads_apart(biases_m, inside_m, field_m - inside_m, apart_m, rng)
        if pads_m is not None:
            return pads_m
    return None


def _pads_apart(
    biases_m: F64, low_m: float, high_m: float, apart_m: float, rng: np.random.Generator
) -> F64 | None:
    """Pads (N, 2) within a square, `apart_m` from each other, also with each of `biases_m`
    (B, N, 2) added.

    Drawn in the cells of a grid, then pushed apart; None if they find no room.
    """
    robots = biases_m.shape[1]
    side = math.ceil(math.sqrt(robots))
    truth_and_seen_m = np.concatenate([np.zeros((1, robots, 2)), biases_m])
    lowest_m = (low_m - truth_and_seen_m).max(axis=0)
    highest_m = (high_m - truth_and_seen_m).min(axis=0)
    wanted_m = apart_m * (1.0 + _PAD_SLACK)
    itself = np.arange(robots)
    for _ in range(_PAD_DRAWS):
        cells = np.stack(np.divmod(rng.permutation(side * side)[:robots], side), axis=1)
        jittered = cells + rng.uniform(0.0, 1.0, (robots, 2))
        places_m = low_m + jittered * ((high_m - low_m) / side)
        for _ in range(_PAD_PUSHES):
            places_m = np.clip(places_m, lowest_m, highest_m)
            all_m = truth_and_seen_m + places_m
            offsets_m = all_m[:, :, None] - all_m[:, None]
            # Several times as fast as np.linalg.norm on an axis of length 2.
            distances_m = np.sqrt(offsets_m[..., 0] ** 2 + offsets_m[..., 1] ** 2)
            distances_m[:, itself, itself] = math.inf
            if distances_m.min() >= apart_m * (1.0 + _PAD_SLACK / 2.0):
                return places_m
            shares = np.maximum(wanted_m - distances_m, 0.0) / np.maximum(distances_m, 1e-9)
            # A bit less than half of the missing distance for each of two, so that crowds converge.
            places_m = places_m + 0.35 * (offsets_m * shares[..., None]).sum(axis=(0, 2))
    return None
