"""ArduPilot SITL with the built-in plant: JSON simulator interface over UDP, in lockstep.

ArduPilot sends a servo packet, waits for one state line, advances to the line's time and sends the
next packet. It repeats a packet after a second without a reply. The interface lacks the armed
state: `armed` means that a motor turns, which includes armed on the ground (MOT_SPIN_ARM).
Source: ArduPilot libraries/SITL/SIM_JSON.h and .cpp, checked against a running ArduCopter 4.7.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from airl_mav.core import clock, constants, errors
from firmware_sim import interfaces
from firmware_sim.addons.ardupilot.program import (
    OBSERVER_PORT,
    PORTS_PER_INSTANCE,
    SIMULATOR_PORT,
    Links,
    ardupilot_airframe,
    find_arducopter,
    start,
)
from firmware_sim.external import flight_stack, parameters
from firmware_sim.external.launcher import Launcher, WorkingFolders, no_process
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.mavlink.endpoint import Address

MAGIC_16, MAGIC_32 = 18_458, 29_569
"""First word of a packet with 16 servo channels and with 32 (SERVO_32_ENABLE = 1)."""

_PACKETS = {40: (MAGIC_16, struct.Struct("<HHI16H")), 72: (MAGIC_32, struct.Struct("<HHI32H"))}
"""Magic and layout of a packet, by its length [bytes]."""


class ServoPacketError(ValueError):
    """A datagram is not a servo packet. The message contains the reason."""


class ServoPacket(NamedTuple):
    """Packet sent by ArduPilot for each frame."""

    frame_rate_hz: int
    """Requested frames per second of simulated time [Hz] (SIM_RATE_HZ)."""
    frame_count: int
    """State lines received since ArduPilot started."""
    pwm_us: tuple[int, ...]
    """Servo outputs 1..16 or 1..32 [µs]; 0 = no output."""


def parse_servos(datagram: bytes) -> ServoPacket:
    """Parse a servo packet. Raises ServoPacketError if the datagram is not one."""
    packet = _PACKETS.get(len(datagram))
    if packet is None:
        lengths = " or ".join(str(length) for length in _PACKETS)
        raise ServoPacketError(f"{len(datagram)} bytes: a servo packet has {lengths}")
    magic, layout = packet
    found, rate, count, *pwm = layout.unpack(datagram)
    if found != magic:
        raise ServoPacketError(f"magic {found}: a packet of {len(datagram)} bytes has {magic}")
    return ServoPacket(rate, count, tuple(pwm))


AWAY_FROM_ZERO = 1.0 + 1e-8
"""Factor on time stamps: ArduPilot truncates the difference of two times to whole microseconds, so
832.9999 instead of 833 would lose a thousandth of its time."""


def state_line(time_us: int, sample: interfaces.SensorSample, truth: interfaces.TrueState) -> bytes:
    """Return the reply to a servo packet: one line, with a line feed before and after.

    ArduPilot finds keys by substring and then reads with sscanf. A key's colon and bracket must be
    adjacent, and no key may contain the name of a later key. Numbers have the shortest form that
    reads back as the same double. ArduPilot simulates GPS, barometer and compass from `truth`.
    """
    return (
        f'\n{{"timestamp":{time_us * AWAY_FROM_ZERO / constants.US_PER_S!r},'
        f'"imu":{{"gyro":{sample.gyro.tolist()},"accel_body":{sample.accel.tolist()}}},'
        f'"position":{truth.position.tolist()},'
        f'"quaternion":{truth.quaternion.tolist()},'
        f'"velocity":{truth.velocity.tolist()},'
        # Without it ArduPilot would pace by the wall clock; here the plant sets the pace.
        f'"no_time_sync":1}}\n'
    ).encode("ascii")


SILENCE_S = 5.0
"""Timeout of a packet [wall s]."""

NEWCOMER_S = 0.5
"""Silence after which ArduPilot is lost once another ArduPilot has started [wall s]."""

MAX_GARBAGE = 100
"""Number of consecutive invalid datagrams after which a connected ArduPilot is lost."""

RATES_HZ = range(50, 10_001)
"""Accepted frame rates [Hz]: lines less than 0.1 s apart, and a clock of whole microseconds."""

_SLICE_S = 0.1
"""Maximum single wait between checks of `alive` [wall s]."""

_MAX_DATAGRAM = 4096

PWM_MIN_US, PWM_MAX_US = 1000, 2000
"""Pulses of a stopped motor (MOT_PWM_MIN) and of full thrust (MOT_PWM_MAX) [µs]."""

MOTORS = 4
"""Number of motors, on servo outputs 1 to 4. The airframe assigns their corners."""


class ArdupilotBridge:
    """Bridge to one ArduPilot for one episode. Implements `Bridge`."""

    def __init__(self, port: int, *, silence_s: float = SILENCE_S) -> None:
        """Open a loopback UDP port, or raise UsageError; packets may take `silence_s` [wall s]."""
        self.rate_hz = 0
        """Rate requested by ArduPilot [Hz], which arms only at 1.8 times its loop rate or more
        (SCHED_LOOP_RATE, 400 Hz)."""
        self.armed = False
        self.time_us = 0
        self.port = port
        self.garbage = 0
        """Number of datagrams that were not servo packets."""
        self._run = 0
        """Number of consecutive invalid datagrams."""
        self._silence_us = int(silence_s * constants.US_PER_S)
        self._alive: Callable[[], None] = no_process
        self._truth: Callable[[], interfaces.TrueState] | None = None
        self._address: Address | None = None
        self._packet: ServoPacket | None = None
        """Newest packet, answered by the next line."""
        self._newcomer = False
        """True if another sender has sent a first packet."""
        self._veteran = False
        """True if another sender has sent a later packet: its time cannot restart at 0."""
        self._base_us: int | None = None
        """Simulated time at ArduPilot's time 0 [µs]."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_SLICE_S)
        try:
            self._socket.bind((constants.LOOPBACK, port))
        except OSError as error:
            self._socket.close()
            raise errors.UsageError(
                f"--instance: UDP port {port} of {constants.LOOPBACK} cannot be bound "
                f"({error.strerror}): another simulator? Choose another instance (its port is "
                f"{SIMULATOR_PORT} + {PORTS_PER_INSTANCE} x instance)"
            ) from error

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait for the first servo packet, see `Bridge`; FirmwareMissingError for a bad rate."""
        self._alive = alive
        stopwatch = clock.WallClock()
        while self._packet is None:
            alive()
            if stopwatch.time_us() > timeout_s * constants.US_PER_S:
                raise interfaces.FirmwareMissingError(self._not_connected(timeout_s))
            self._packet = self._receive()
        self.rate_hz = self._packet.frame_rate_hz
        if self.rate_hz not in RATES_HZ:
            raise interfaces.FirmwareMissingError(
                f"ArduPilot asks for {self.rate_hz} Hz (SIM_RATE_HZ): must be in "
                f"{RATES_HZ.start}..{RATES_HZ.stop - 1}"
            )

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Set the source of the true state, from which ArduPilot simulates its other sensors."""
        self._truth = truth

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Answer the pending packet and return the next packet's motor commands; see `Bridge`.

        Outputs 1 to 4 of ArduCopter's quad X (FRAME_TYPE 1) are PX4's motors: front right, rear
        left, front left, rear right.
        """
        answered, truth, address = self._packet, self._truth, self._address
        if answered is None or truth is None or address is None:
            raise RuntimeError("step() before wait_connected() and use_truth()")
        if self._base_us is None:
            # ArduPilot's time starts at 0 and must also advance with the first line.
            self._base_us = sample.time_us - constants.US_PER_S // self.rate_hz
        self.time_us = sample.time_us - self._base_us
        answered = self._newest(answered)
        line = state_line(self.time_us, sample, truth())
        self._socket.sendto(line, address)
        self._packet = packet = self._next(answered, line)
        motors = _motors(packet.pwm_us)
        self.armed = any(motors)
        return interfaces.ActuatorControls(sample.time_us, motors, self.armed)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()

    def _newest(self, packet: ServoPacket) -> ServoPacket:
        """Return the newest packet since the last step: extra replies would put ArduPilot ahead."""
        self._socket.settimeout(0.0)
        try:
            while True:
                newer = self._receive()
                if newer is None:
                    return packet
                packet = _follows(packet, newer)
        finally:
            self._socket.settimeout(_SLICE_S)

    def _next(self, answered: ServoPacket, line: bytes) -> ServoPacket:
        stopwatch = clock.WallClock()
        repeated = False
        while True:
            packet = self._receive()
            if packet is not None:
                if _follows(answered, packet).frame_count > answered.frame_count:
                    return packet
                repeated = True
                continue
            silent_us = stopwatch.time_us()
            self._alive()
            if self._newcomer and silent_us >= NEWCOMER_S * constants.US_PER_S:
                raise interfaces.FirmwareLostError(_RESTARTED)
            if silent_us >= self._silence_us:
                raise interfaces.FirmwareLostError(
                    "ArduPilot has sent no servo packet for "
                    f"{self._silence_us / constants.US_PER_S:g} s"
                )
            if repeated and self._address is not None:
                # A repeated packet without a newer one means that the line was lost.
                repeated = False
                self._socket.sendto(line, self._address)

    def _receive(self) -> ServoPacket | None:
        """Return the next servo packet; None = timeout. FirmwareLostError after only garbage."""
        for _ in range(MAX_GARBAGE):
            try:
                datagram, address = self._socket.recvfrom(_MAX_DATAGRAM)
            except (BlockingIOError, TimeoutError):
                return None
            try:
                packet = parse_servos(datagram)
            except ServoPacketError as error:
                self._reject(error)
                continue
            self._run = 0
            if self._address is None and packet.frame_count == 0:
                self._address = address
            if address == self._address:
                return packet
            self._newcomer = self._newcomer or packet.frame_count == 0
            self._veteran = self._veteran or packet.frame_count > 0
        return None

    def _reject(self, error: ServoPacketError) -> None:
        self.garbage += 1
        self._run += 1
        if self._run >= MAX_GARBAGE and self._address is not None:
            raise interfaces.FirmwareLostError(
                f"{self._run} consecutive datagrams are not servo packets: {error}"
            )

    def _not_connected(self, timeout_s: float) -> str:
        heard = f", only {self.garbage} other datagrams" if self.garbage else ""
        if self._veteran:
            heard = ", only one that has flown before: restart it for each flight"
        return (
            f"no ArduPilot on UDP port {self.port} of {constants.LOOPBACK} in {timeout_s:g} s"
            f"{heard}: start it with --model JSON:{constants.LOOPBACK} --sim-port-out {self.port}"
        )


_RESTARTED = "ArduPilot restarted during an episode"


def _follows(before: ServoPacket, after: ServoPacket) -> ServoPacket:
    """Return `after`. Raises FirmwareLostError if its frame count went back."""
    if after.frame_count < before.frame_count:
        raise interfaces.FirmwareLostError(_RESTARTED)
    return after


def _motors(pwm_us: tuple[int, ...]) -> tuple[float, float, float, float]:
    span_us = PWM_MAX_US - PWM_MIN_US
    a, b, c, d = (min(max((pwm - PWM_MIN_US) / span_us, 0.0), 1.0) for pwm in pwm_us[:MOTORS])
    return a, b, c, d


def ardupilot_parts(request: flight_stack.FirmwareRequest) -> tuple[Launcher, FirmwareObserver]:
    """Bind the observer's port. Return ArduPilot's launcher and the observer."""
    options, ports, vehicle = request.aircraft.real, request.aircraft.ports, request.vehicle
    instance, folder = options.instance, options.ardupilot_dir
    airframe = ardupilot_airframe(vehicle)
    parameters.refuse_untold(vehicle, "ardupilot")
    program = None if folder is None else find_arducopter(folder)
    # A program started here accepts any port.
    endpoint = flight_stack.instance_endpoint(OBSERVER_PORT + instance if program is None else 0)
    links = Links(ports.api_port, ports.gcs_port, endpoint.local[1])
    launcher = Launcher(
        airframe,
        partial(ArdupilotBridge, SIMULATOR_PORT + PORTS_PER_INSTANCE * instance),
        options.firmware_timeout,
        program=None
        if program is None
        else partial(start, program, instance, links, airframe.settings),
        folders=WorkingFolders("ardupilot", options.firmware_dir, request.log),
    )
    return launcher, flight_stack.observed(request, endpoint)
