"""The real airl-firmware process, flown by the real MAVSDK as any client would fly it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action, OrbitYawBehavior
from mavsdk.plugins.follow_me import FollowMe, TargetLocation
from mavsdk.plugins.manual_control import ManualControl
from mavsdk.plugins.offboard import (
    AccelerationNed,
    Attitude,
    AttitudeRate,
    Offboard,
    PositionGlobalYaw,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, LandedState, Telemetry
from pymavlink.dialects.v20 import common as dialect

from tests.support.mavlink_clients import Companion
from tests.support.ports import LOOPBACK, TestPorts, choose_ports
from tests.support.processes import HOLD, Running, ground_station, running, wait_until, write_arena

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]

SPEED = 3.0
EARTH_RADIUS_M = 6_371_000.0


class Client:
    """MAVSDK connected to a firmware process."""

    def __init__(self, companion: Companion, firmware: Running) -> None:
        self.companion = companion
        self.firmware = firmware
        self.telemetry: Telemetry = companion.plugin(Telemetry)
        self.action: Action = companion.plugin(Action)
        self.offboard: Offboard = companion.plugin(Offboard)
        self.plugin = companion.plugin
        self.param: Param = companion.plugin(Param)

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait for a condition while the firmware lives."""

        def check() -> Any:
            assert self.firmware.process.poll() is None, self.firmware.text()
            return condition()

        return wait_until(check, what, 60.0)

    def ready(self) -> None:
        """Wait until the vehicle can be armed."""
        self.until(self.telemetry.health_all_ok, "good health")
        self.until(lambda: self.telemetry.health().is_armable, "armable")

    def position(self) -> tuple[float, float, float]:
        """North, east, down [m], as estimated."""
        p = self.telemetry.position_velocity_ned().position
        return p.north_m, p.east_m, p.down_m

    def velocity(self) -> tuple[float, float, float]:
        """North, east, down [m/s], as estimated."""
        v = self.telemetry.position_velocity_ned().velocity
        return v.north_m_s, v.east_m_s, v.down_m_s

    def gps(self) -> tuple[float, float]:
        """North and east of home [m] by the GPS receiver: no estimator in between."""
        here, home = self.telemetry.raw_gps(), self.telemetry.home()
        north = math.radians(here.latitude_deg - home.latitude_deg) * EARTH_RADIUS_M
        shrink = math.cos(math.radians(home.latitude_deg))
        east = math.radians(here.longitude_deg - home.longitude_deg) * EARTH_RADIUS_M * shrink
        return north, east

    def yaw(self) -> float:
        """Heading [deg]."""
        return float(self.telemetry.attitude_euler().yaw_deg)

    def take_off(self, altitude_m: float) -> None:
        """Arm and climb."""
        self.ready()
        self.action.set_takeoff_altitude(altitude_m)
        self.action.arm()
        self.until(self.telemetry.armed, "armed")
        self.action.takeoff()
        self.until(lambda: self.telemetry.flight_mode() == FlightMode.TAKEOFF, "take-off")
        self.until(lambda: self.telemetry.flight_mode() == FlightMode.HOLD, "hold after take-off")
        assert self.telemetry.in_air()
        # Hold climbs the last decimetres, as PX4's does.
        assert -self.position()[2] > altitude_m - 1.0
        self.until(lambda: abs(-self.position()[2] - altitude_m) < 0.3, "the altitude")

    def wait_landed(self) -> None:
        """Wait for the ground and for the automatic disarming."""
        self.until(lambda: self.telemetry.landed_state() == LandedState.ON_GROUND, "the ground")
        self.until(lambda: not self.telemetry.armed(), "disarmed by landing")
        assert not self.telemetry.in_air()
        self.firmware.wait_for_text("Disarmed by landing")


@contextmanager
def client(
    folder: Path, *options: str, speed: float = SPEED, ports: TestPorts | None = None
) -> Iterator[Client]:
    """A firmware process with MAVSDK waiting for its first word."""
    ports = ports or choose_ports()
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    assert mavsdk.add_any_connection(f"udpin://{LOOPBACK}:{ports.api}") == 0
    words = [
        *("-m", "airl_mav.cli.firmware_command", "--arena", str(write_arena(folder, 40.0))),
        *("--speed", str(speed), *ports.options(), *options),
    ]
    companion: Companion | None = None
    with running(words, folder) as process:
        try:
            process.wait_for_text("Ctrl-C ends it")
            companion = Companion(mavsdk)
            yield Client(companion, process)
        finally:
            if companion is None:
                mavsdk.destroy()
            else:
                companion.destroy()
        process.process.terminate()
        assert process.wait() == 0, process.text()
        match = process.wait_for_text(r"onboard +received (\d+), malformed (\d+)")
        assert (int(match[1]) > 0, int(match[2])) == (True, 0)


def failure(call: Callable[[], Any]) -> str:
    """Return the name of the result that a MAVSDK call failed with."""
    with pytest.raises(MavsdkError) as caught:
        call()
    return str(caught.value).split(";")[0]


def test_offboard_flight(tmp_path: Path) -> None:
    with client(tmp_path) as c:
        telemetry, offboard = c.telemetry, c.offboard
        telemetry.set_rate_position_velocity_ned(50.0)
        telemetry.set_rate_attitude_euler(50.0)
        telemetry.set_rate_raw_gps(10.0)
        assert failure(offboard.start) == "NO_SETPOINT_SET"
        c.take_off(3.0)
        assert failure(c.action.disarm) == "COMMAND_DENIED"
        assert telemetry.armed()

        offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
        offboard.start()
        c.until(lambda: telemetry.flight_mode() == FlightMode.OFFBOARD, "offboard")
        c.until(lambda: abs(c.velocity()[0] - 2.0) < 0.25, "2 m/s north")
        c.until(lambda: c.position()[0] > 6.0, "6 m north")
        assert abs(c.position()[1]) < 1.0
        assert -c.position()[2] == pytest.approx(3.0, abs=0.7)

        offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 90.0))
        c.until(lambda: abs(c.yaw() - 90.0) < 5.0, "looking east")
        # Forward is east now, right is south.
        offboard.set_velocity_body(VelocityBodyYawspeed(1.5, 0.0, 0.0, 0.0))
        c.until(lambda: abs(c.velocity()[1] - 1.5) < 0.25, "1.5 m/s east")
        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, -1.5, 0.0, 0.0))
        c.until(lambda: abs(c.velocity()[0] - 1.5) < 0.25, "1.5 m/s north, sideways")
        offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, -60.0))
        c.until(lambda: abs(c.yaw()) < 10.0, "turning left to the north")

        offboard.set_position_ned(PositionNedYaw(10.0, -3.0, -4.0, 0.0))

        def there() -> bool:
            return math.dist(c.position(), (10.0, -3.0, -4.0)) < 0.3 and (
                math.hypot(*c.velocity()) < 0.2
            )

        c.until(there, "the place asked for")
        assert math.dist(c.gps(), (10.0, -3.0)) < 1.5

        offboard.stop()
        c.until(lambda: telemetry.flight_mode() == FlightMode.HOLD, "hold")
        c.action.land()
        c.until(lambda: telemetry.flight_mode() == FlightMode.LAND, "landing")
        c.wait_landed()
        assert math.dist(c.gps(), (10.0, -3.0)) < 1.5


@contextmanager
def pilot(sticks: ManualControl) -> Iterator[Callable[[float], None]]:
    """Hold the sticks, and yield what moves the pitch stick; a pilot who lets go is a lost link."""
    pitch, over = [0.0], threading.Event()

    def hold() -> None:
        while not over.wait(0.02):
            sticks.set_manual_control_input(pitch[0], 0.0, 0.5, 0.0)

    sticks.set_manual_control_input(0.0, 0.0, 0.5, 0.0)
    holder = threading.Thread(target=hold)
    holder.start()
    try:
        yield lambda value: pitch.__setitem__(0, value)
    finally:
        over.set()
        holder.join()


@pytest.mark.nightly  # The same calls in simulated time: test_px4_walk.py.
def test_going_places_with_every_plugin(tmp_path: Path) -> None:
    """The part of the long walk over a real PX4 that goes places: same calls, same outcomes."""
    with client(tmp_path) as c:
        telemetry, action, offboard = c.telemetry, c.action, c.offboard
        telemetry.set_rate_position_velocity_ned(30.0)
        c.take_off(6.0)
        home = telemetry.home()
        north = 180.0 / math.pi / EARTH_RADIUS_M
        east = north / math.cos(math.radians(home.latitude_deg))

        def at(n: float, e: float) -> tuple[float, float]:
            return home.latitude_deg + n * north, home.longitude_deg + e * east

        def mode(wanted: FlightMode) -> None:
            c.until(lambda: telemetry.flight_mode() == wanted, str(wanted))

        def near(n: float, e: float, d: float) -> None:
            c.until(lambda: math.dist(c.position(), (n, e, d)) < 0.8, f"{n} {e} {d}")

        altitude = home.absolute_altitude_m + 8.0
        action.goto_location(*at(8.0, 4.0), altitude, 90.0)
        near(8.0, 4.0, -8.0)
        c.until(lambda: abs(c.yaw() - 90.0) < 5.0, "the heading")
        action.set_current_speed(2.0)
        action.do_orbit(
            6.0, 2.0, OrbitYawBehavior.HOLD_FRONT_TO_CIRCLE_CENTER, *at(8.0, 4.0), altitude
        )
        c.until(lambda: abs(math.hypot(*c.velocity()[:2]) - 2.0) < 0.4, "going round")
        assert math.dist(c.position()[:2], (8.0, 4.0)) < 7.5
        action.hold()
        mode(FlightMode.HOLD)

        offboard.set_position_global(
            PositionGlobalYaw(*at(0.0, 0.0), 7.0, 0.0, PositionGlobalYaw.AltitudeType.REL_HOME)
        )
        offboard.start()
        near(0.0, 0.0, -7.0)
        offboard.set_acceleration_ned(AccelerationNed(1.0, 0.0, 0.0))
        c.until(lambda: c.velocity()[0] > 0.7, "moving by its acceleration")
        offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        c.until(lambda: math.hypot(*c.velocity()) < 0.3, "a stand")
        offboard.set_attitude(Attitude(0.0, -10.0, 0.0, 0.5))
        c.until(lambda: telemetry.attitude_euler().pitch_deg < -7.0, "nose down")
        offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 40.0, 0.5))
        c.until(lambda: c.yaw() > 15.0, "turning")
        assert telemetry.flight_mode() == FlightMode.OFFBOARD
        offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
        c.until(lambda: math.hypot(*c.velocity()) < 0.3, "a stand")
        offboard.stop()

        follow: FollowMe = c.plugin(FollowMe)
        target = TargetLocation(*at(14.0, 0.0), home.absolute_altitude_m, 0.0, 0.0, 0.0)
        assert failure(lambda: follow.set_target_location(target)) == "NOT_ACTIVE"
        follow.start()
        mode(FlightMode.FOLLOW_ME)
        follow.stop()
        mode(FlightMode.HOLD)

        sticks: ManualControl = c.plugin(ManualControl)
        with pilot(sticks) as pull:
            sticks.start_position_control()
            mode(FlightMode.POSCTL)
            pull(-0.6)
            c.until(lambda: c.velocity()[0] < -0.5, "backwards")
            action.return_to_launch()
            mode(FlightMode.RETURN_TO_LAUNCH)


@pytest.mark.nightly
def test_refusals_in_the_air_and_hold(tmp_path: Path) -> None:
    with ground_station() as ground:
        ports = choose_ports(ground.port)
        with client(tmp_path, ports=ports) as c:
            c.take_off(2.0)
            # MAVSDK rejects the call locally; the ground station sends the request to the vehicle.
            assert failure(c.offboard.start) == "NO_SETPOINT_SET"
            offboard = (dialect.MAV_CMD_DO_SET_MODE, 0, 129.0, 6.0, 0.0, *[math.nan] * 4)
            ground.send(dialect.MAVLink_command_long_message(1, 1, *offboard), ports.gcs_local)
            ack = c.until(lambda: ground.latest.get("COMMAND_ACK"), "an answer")
            assert ack.command == dialect.MAV_CMD_DO_SET_MODE
            assert ack.result == dialect.MAV_RESULT_TEMPORARILY_REJECTED
            c.until(lambda: ground.heard("Switching to Offboard is currently not available"), "why")
            assert ground.mode == HOLD
            assert failure(c.action.disarm) == "COMMAND_DENIED"
            c.until(lambda: ground.heard("Disarming denied: not landed"), "why")

            c.offboard.set_velocity_ned(VelocityNedYaw(3.0, 0.0, 0.0, 0.0))
            c.offboard.start()
            c.until(lambda: c.velocity()[0] > 2.0, "2 m/s")
            c.action.hold()
            c.until(lambda: math.hypot(*c.velocity()) < 0.1, "standing still")
            start, since_ms = c.position(), ground.track[-1][0]
            c.until(lambda: ground.track[-1][0] > since_ms + 2000, "two seconds")
            assert math.dist(c.position(), start) < 0.5
            c.action.land()
            c.wait_landed()


@pytest.mark.nightly
def test_return_to_launch(tmp_path: Path) -> None:
    with client(tmp_path) as c:
        c.param.set_param_float("RTL_RETURN_ALT", 4.0)
        assert c.action.get_return_to_launch_altitude() == 4.0
        c.take_off(2.0)
        c.offboard.set_velocity_ned(VelocityNedYaw(3.0, 1.0, 0.0, 0.0))
        c.offboard.start()
        c.until(lambda: c.position()[0] > 8.0, "8 m north")
        c.action.return_to_launch()
        c.until(lambda: c.telemetry.flight_mode() == FlightMode.RETURN_TO_LAUNCH, "return")
        c.until(lambda: -c.position()[2] > 3.6, "the return altitude")
        assert c.position()[0] > 4.0, "it climbs first"
        c.wait_landed()
        assert math.hypot(*c.position()[:2]) < 1.0
        assert math.hypot(*c.gps()) < 1.5


@pytest.mark.nightly  # The same calls in simulated time: test_px4_walk.py.
def test_arming_before_it_is_ready_is_refused(tmp_path: Path) -> None:
    # Slow, to allow an arming request before the estimator has converged.
    with client(tmp_path, speed=0.25) as c:
        assert not c.telemetry.health_all_ok()
        assert failure(c.action.arm) == "COMMAND_DENIED"
        c.firmware.wait_for_text("Arming denied: Resolve system health failures first")


@pytest.mark.nightly  # The same calls in simulated time: test_px4_walk.py.
def test_parameters_and_rates(tmp_path: Path) -> None:
    with client(tmp_path) as c:
        assert c.param.get_param_int("COM_OBL_RC_ACT") == 0
        c.param.set_param_int("COM_OBL_RC_ACT", 4)
        assert c.param.get_param_int("COM_OBL_RC_ACT") == 4
        c.param.set_param_float("MPC_XY_VEL_MAX", 7.25)
        assert c.param.get_param_float("MPC_XY_VEL_MAX") == 7.25
        assert failure(lambda: c.param.get_param_float("NO_SUCH_NAME")) == "DOES_NOT_EXIST"
        assert failure(lambda: c.param.get_param_int("MPC_XY_VEL_MAX")) == "WRONG_TYPE"
        every = c.param.get_all_params()
        ints = {p.name: p.value for p in every.int_params}
        floats = {p.name: p.value for p in every.float_params}
        assert ints["COM_OBL_RC_ACT"] == 4
        assert floats["MPC_XY_VEL_MAX"] == 7.25
        assert len(ints) > 10
        assert len(floats) > 40
        # Shipped with the vehicle.
        assert floats["MPC_THR_HOVER"] == pytest.approx(0.52)

        for name in ("position", "velocity_ned", "imu", "battery", "home", "gps_info", "odometry"):
            getattr(c.telemetry, f"set_rate_{name}")(5.0)
        c.until(lambda: not math.isnan(c.telemetry.battery().voltage_v), "a battery report")
        assert 13.0 < c.telemetry.battery().voltage_v < 17.0
        down = c.telemetry.imu().acceleration_frd.down_m_s2
        assert down == pytest.approx(-9.81, abs=0.5)
