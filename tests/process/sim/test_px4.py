"""The simulated vehicle as the real MAVSDK sees it."""

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, contextmanager
from typing import TypeVar

import numpy as np
import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.action import ActionAsync, ActionError, ActionResult
from mavsdk.asyncio.plugins.geofence import (
    FenceType,
    GeofenceAsync,
    GeofenceData,
    Point,
    Polygon,
)
from mavsdk.asyncio.plugins.offboard import (
    OffboardAsync,
    OffboardError,
    OffboardResult,
    PositionNedYaw,
    VelocityNedYaw,
)
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import FlightMode, LandedState, TelemetryAsync

from lpac.sim.ports import free_ports
from lpac.sim.px4.link import Px4Link
from lpac.sim.px4.modes import MavResult, Px4Mode
from lpac.sim.px4.server import Instance, Px4Server
from lpac.sim.px4.vehicle import Px4Vehicle

T = TypeVar("T")


@contextmanager
def served(vehicle: Px4Vehicle, system_id: int) -> Iterator[tuple[Px4Server, str]]:
    """The vehicle on a port of its own, and the address for MAVSDK."""
    (port,) = free_ports(1)
    link = Px4Link(vehicle, system_id=system_id)
    with Px4Server([Instance(link, 0, port)]) as server:
        yield server, f"udpin://127.0.0.1:{port}"


def client() -> Mavsdk:
    companion = ComponentType.COMPANION_COMPUTER
    return Mavsdk(Configuration.create_with_component_type(companion))


async def connected(mavsdk: Mavsdk, address: str) -> System:
    await mavsdk.add_any_connection(address)
    system = await mavsdk.first_autopilot(60.0)
    assert system is not None
    return system


async def until(
    stream: AsyncGenerator[T, None], condition: Callable[[T], bool], timeout_s: float = 60.0
) -> T:
    async with asyncio.timeout(timeout_s), aclosing(stream):
        async for value in stream:
            if condition(value):
                return value
    raise AssertionError("the stream ended")


def test_mavsdk_prepares_a_vehicle() -> None:
    vehicle = Px4Vehicle(seed=5, ready_after_s=0.0)
    vehicle.gps_lost = True

    async def refused(system: System) -> None:
        with pytest.raises(ActionError) as denied:
            await ActionAsync(system).arm()
        assert denied.value.result is ActionResult.COMMAND_DENIED
        with pytest.raises(OffboardError) as empty:
            await OffboardAsync(system).start()
        assert empty.value.result is OffboardResult.NO_SETPOINT_SET

    async def set_parameters(system: System) -> None:
        parameters = ParamAsync(system)
        assert await parameters.get_param_int("COM_OBL_RC_ACT") == 0
        await parameters.set_param_int("COM_OBL_RC_ACT", -4)
        assert await parameters.get_param_int("COM_OBL_RC_ACT") == -4
        await parameters.set_param_float("COM_OF_LOSS_T", 0.75)
        assert vehicle.parameters["COM_OF_LOSS_T"] == 0.75
        everything = await parameters.get_all_params()
        listed = {p.name: p.value for p in (*everything.int_params, *everything.float_params)}
        assert listed == pytest.approx(vehicle.parameters)

    async def upload_fence(system: System) -> None:
        latitude, longitude, altitude = vehicle.global_origin
        origin = await TelemetryAsync(system).get_gps_global_origin()
        assert origin.latitude_deg == pytest.approx(latitude, abs=1e-7)
        assert origin.longitude_deg == pytest.approx(longitude, abs=1e-7)
        assert origin.altitude_m == pytest.approx(altitude, abs=1e-3)
        geofence = GeofenceAsync(system)
        corners = [(-1e-3, -2e-3), (2e-3, -1e-3), (0.0, 1e-3)]
        points = [Point(latitude + n, longitude + e) for n, e in corners]
        await geofence.upload_geofence(GeofenceData([Polygon(points, FenceType.INCLUSION)]))
        (polygon,) = vehicle.fence
        assert polygon.inclusion
        sent_deg = np.array([(p.latitude_deg, p.longitude_deg) for p in points])
        assert np.array(polygon.vertices_deg) == pytest.approx(sent_deg, abs=1e-6)
        (copy,) = (await geofence.download_geofence()).polygons
        copied_deg = np.array([(p.latitude_deg, p.longitude_deg) for p in copy.points])
        assert copied_deg == pytest.approx(sent_deg, abs=1e-6)
        await geofence.clear_geofence()
        assert vehicle.fence == ()

    async def prepare(address: str) -> None:
        async with client() as mavsdk:
            system = await connected(mavsdk, address)
            assert await system.get_system_id() == 42
            await refused(system)
            vehicle.gps_lost = False
            await until(TelemetryAsync(system).subscribe_health_all_ok(), bool)
            await set_parameters(system)
            await upload_fence(system)

    with served(vehicle, 42) as (_, address):
        asyncio.run(prepare(address))


def test_mavsdk_flies_from_take_off_to_landing() -> None:
    vehicle = Px4Vehicle(seed=5, ready_after_s=0.0)

    async def in_mode(telemetry: TelemetryAsync, mode: FlightMode) -> None:
        await until(telemetry.subscribe_flight_mode(), lambda m: m is mode)

    async def take_off(action: ActionAsync, telemetry: TelemetryAsync) -> None:
        await until(telemetry.subscribe_health_all_ok(), bool)
        await action.set_takeoff_altitude(3.0)
        await action.arm()
        # It is over soon: listened for beforehand.
        await asyncio.gather(
            until(telemetry.subscribe_landed_state(), lambda s: s is LandedState.TAKING_OFF),
            action.takeoff(),
        )
        await in_mode(telemetry, FlightMode.HOLD)
        with pytest.raises(ActionError):
            await action.disarm()

    async def fly(offboard: OffboardAsync, telemetry: TelemetryAsync) -> None:
        await offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 90.0))
        await offboard.start()
        await in_mode(telemetry, FlightMode.OFFBOARD)
        await until(telemetry.subscribe_velocity_ned(), lambda v: v.north_m_s > 1.5)
        await until(telemetry.subscribe_heading(), lambda h: abs(h.heading_deg - 90.0) < 5.0)
        here = await until(telemetry.subscribe_position_velocity_ned(), lambda _: True)
        goal_m = here.position.north_m + 3.0
        await offboard.set_position_ned(
            PositionNedYaw(goal_m, here.position.east_m, here.position.down_m, 90.0)
        )
        await until(
            telemetry.subscribe_position_velocity_ned(),
            lambda p: abs(p.position.north_m - goal_m) < 0.5,
        )
        await offboard.stop()
        await in_mode(telemetry, FlightMode.HOLD)

    async def mission(address: str) -> None:
        async with client() as mavsdk:
            system = await connected(mavsdk, address)
            telemetry, action = TelemetryAsync(system), ActionAsync(system)
            await take_off(action, telemetry)
            await fly(OffboardAsync(system), telemetry)
            await asyncio.gather(
                until(telemetry.subscribe_landed_state(), lambda s: s is LandedState.LANDING),
                action.land(),
            )
            await until(telemetry.subscribe_armed(), lambda armed: not armed)
            assert vehicle.landed

    with served(vehicle, 1) as (_, address):
        asyncio.run(mission(address))


async def take_off_in_offboard(system: System) -> None:
    telemetry, action, offboard = TelemetryAsync(system), ActionAsync(system), OffboardAsync(system)
    await until(telemetry.subscribe_health_all_ok(), bool)
    await offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, -1.5, 0.0))
    await action.arm()
    await offboard.start()
    await until(telemetry.subscribe_in_air(), bool)
    await until(telemetry.subscribe_velocity_ned(), lambda v: v.down_m_s < -1.0)


def test_a_client_that_goes_away_leaves_the_vehicle_to_its_failsafe() -> None:
    vehicle = Px4Vehicle(seed=6, ready_after_s=0.0)
    vehicle.parameters |= {"COM_OBL_RC_ACT": 4, "COM_FAIL_ACT_T": 0.0}

    async def fly_and_leave(address: str) -> None:
        async with client() as mavsdk:
            await take_off_in_offboard(await connected(mavsdk, address))

    with served(vehicle, 1) as (server, address):
        asyncio.run(fly_and_leave(address))
        assert server.wait_for(lambda: not vehicle.armed and vehicle.landed, 60.0)
    silent_s = vehicle._setpoint_at_s
    landing = next(truth for truth in vehicle.truth if truth.mode is Px4Mode.LAND)
    assert silent_s < landing.time_s < silent_s + 1.5


def test_mavsdk_sees_a_pilot_take_over_and_kills() -> None:
    vehicle = Px4Vehicle(seed=7, ready_after_s=0.0)

    async def fly(server: Px4Server, address: str) -> None:
        async with client() as mavsdk:
            system = await connected(mavsdk, address)
            telemetry, action = TelemetryAsync(system), ActionAsync(system)
            await take_off_in_offboard(system)
            with server.stepped:
                assert vehicle.pilot(Px4Mode.POSCTL) is MavResult.ACCEPTED
            await until(telemetry.subscribe_flight_mode(), lambda m: m is FlightMode.POSCTL)
            await until(telemetry.subscribe_rc_status(), lambda rc: bool(rc.is_available))
            await action.kill()
            await until(telemetry.subscribe_armed(), lambda armed: not armed)
            await until(telemetry.subscribe_in_air(), lambda in_air: not in_air)

    with served(vehicle, 1) as (server, address):
        asyncio.run(fly(server, address))
