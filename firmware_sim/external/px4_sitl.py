"""PX4's simulator interface (SITL): lockstep over TCP, with PX4 as the client.

Source: PX4, src/modules/simulation/simulator_mavlink; the message order was measured.
"""

from __future__ import annotations

import errno
import math
import select
import socket
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from airl_mav.core import constants, errors
from airl_mav.core.clock import Patience, WallClock
from firmware_sim import interfaces
from firmware_sim.external import flight_stack, parameters, programs
from firmware_sim.external import hil_messages as hil
from firmware_sim.external.launcher import (
    SHUT_DOWN,
    Launcher,
    RunningProgram,
    WorkingFolders,
    no_process,
    program_at,
)
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.mavlink.codec import Decoder, Encoder, Values, WireLayout, WireMessage, dialect
from firmware_sim.mavlink.streams.status import hil_state_quaternion

WATCH_S = 0.1
"""Maximum wait between checks that the other program is alive [wall s]."""

_READ, _WRITE = select.POLLIN, select.POLLOUT


class TcpPort:
    """TCP server on the loopback address that accepts only one connection."""

    def __init__(self, port: int) -> None:
        """Listen on a TCP port, 0 = any free port. Raises UsageError if the port is unusable."""
        self.refused = 0
        """Number of additional connections refused."""
        self._clock = WallClock()
        self._connection: socket.socket | None = None
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.setblocking(False)
        try:
            self._listener.bind((constants.LOOPBACK, port))
            self._listener.listen()
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise errors.UsageError(_listen_problem(port, error)) from error
        self.port: int = self._listener.getsockname()[1]
        self._poll = select.poll()
        self._poll.register(self._listener, _READ)

    def accept(self, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Wait for the connection [wall s]; return True if connected; `alive` may raise."""
        deadline_us = self._deadline_us(timeout_s)
        while self._connection is None:
            alive()
            left_s = self._left_s(deadline_us)
            if left_s <= 0.0:
                return False
            if self._poll.poll(min(left_s, WATCH_S) * constants.MS_PER_S):
                self._connection = self._newcomer()
        self._connection.setblocking(False)
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._poll.register(self._connection, _READ)
        return True

    @property
    def peer(self) -> tuple[str, int]:
        """Address of the client: host and port."""
        host, port = self._connected().getpeername()
        return host, port

    def send(self, data: bytes, timeout_s: float, alive: Callable[[], None]) -> bool:
        """Send all data; return False if the connection ended or did not accept it in time."""
        connection, left = self._connected(), data
        sent = _send(connection, left)
        if sent == len(left):
            return True  # the usual case, without reading the clock
        deadline_us = self._deadline_us(timeout_s)
        while sent is not None:
            left = left[sent:]
            left_s = self._left_s(deadline_us)
            if not left or left_s <= 0.0:
                return not left
            alive()
            writable = select.poll()
            writable.register(connection, _WRITE)
            writable.poll(min(left_s, WATCH_S) * constants.MS_PER_S)
            sent = _send(connection, left)
        return False

    def receive(self, timeout_s: float) -> bytes | None:
        """Return received data, b"" after a timeout [wall s] or earlier, None at the end."""
        connection = self._connected()
        for number, _ in self._poll.poll(timeout_s * constants.MS_PER_S):
            if number == connection.fileno():
                try:
                    return connection.recv(65_536) or None
                except BlockingIOError:
                    return b""
                except OSError:
                    return None
            newcomer = self._newcomer()
            if newcomer is not None:
                newcomer.close()
                self.refused += 1
        return b""

    def close(self) -> None:
        """Close all sockets. Idempotent."""
        if self._connection is not None:
            self._connection.close()
        self._listener.close()

    def _connected(self) -> socket.socket:
        if self._connection is None:
            raise RuntimeError("there is no connection yet")
        return self._connection

    def _newcomer(self) -> socket.socket | None:
        """Return the new connection; None if it was already closed."""
        try:
            return self._listener.accept()[0]
        except OSError:
            return None

    def _deadline_us(self, timeout_s: float) -> int:
        return self._clock.time_us() + int(timeout_s * constants.US_PER_S)

    def _left_s(self, deadline_us: int) -> float:
        return (deadline_us - self._clock.time_us()) / constants.US_PER_S


def _send(connection: socket.socket, data: bytes) -> int | None:
    """Return the number of bytes sent; None if the connection has ended."""
    try:
        return connection.send(data)
    except BlockingIOError:
        return 0
    except OSError:
        return None


def _listen_problem(port: int, error: OSError | OverflowError) -> str:
    where = f"TCP port {port} on {constants.LOOPBACK}"
    if isinstance(error, OverflowError):
        return f"--instance: {where}: must be in 0..65535"
    if error.errno == errno.EADDRINUSE:
        return f"{where} is taken (another simulator?): choose another with --instance"
    return f"{where} cannot be used ({error.strerror}): choose another with --instance"


ANSWER_S = 5.0
"""Timeout of a reply [wall s]."""

STOPPED_S = 1.0
"""Wait for a reply after which a stopped PX4 is detected [wall s]; shorter than the heartbeat
timeout of its clients."""

REST_S = 0.1
"""Maximum wait for one reply of a disarmed PX4 before the next sample is sent [wall s]. In Offboard
on the ground without a setpoint, PX4 replies only occasionally, by its own clock, which does not
advance during the wait."""

AT_ONCE_S = 0.01
"""Maximum wait for a reply before the clock is read [wall s]."""

START_S = 60.0
"""Timeout from the first sample to the first reply [wall s], while PX4's start script runs."""

EPOCH_US = constants.US_PER_S
"""PX4's time of the first sample [µs]; PX4 reads 0 as never."""

STATE_US = 200_000
"""Default interval of the true state [µs], unless PX4 requests another."""

NEVER_US = sys.maxsize

GPS_TICKS = 4
"""Latency of a GPS fix [ticks]. PX4 assumes 10 ms in its simulators (EKF2_GPS_DELAY), and stamps a
fix with the time of the previous sample (4 ms)."""

MAX_GARBAGE = 16
"""Maximum number of tolerated garbage runs; TCP should deliver none."""

MAX_GARBAGE_BYTES = 4096
"""Maximum length of a garbage run [bytes]."""

_BESIDE_THE_SAMPLE: tuple[tuple[str, WireLayout, Callable[[Any, int], Values]], ...] = (
    ("gps", hil.GPS, hil.gps),
    ("odometry", hil.ODOMETRY, hil.odometry),
    ("distance", hil.DISTANCE, hil.distance),
    ("flow", hil.FLOW, hil.flow),
)
"""Messages of a sample's slower sensors, in the order of sending."""

_ANSWER = dialect.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS
_COMMAND = dialect.MAVLINK_MSG_ID_COMMAND_LONG


class Px4Bridge:
    """Bridge to PX4 SITL, which answers each HIL_SENSOR with one HIL_ACTUATOR_CONTROLS.

    Implements `Bridge`. PX4's clock is HIL_SENSOR's time. Before the first reply, samples are sent
    at their nominal rate and motors are stopped. A disarmed PX4 may skip replies for a while.
    Silence, a closed connection, clock jumps, garbage or invalid motor commands end the flight
    (`FirmwareLostError`). Duplicate replies are dropped, additional connections refused.
    """

    rate_hz = constants.TICK_HZ

    def __init__(
        self,
        port: int,
        *,
        answer_s: float = ANSWER_S,
        start_s: float = START_S,
        least_state_us: int = 1,
    ) -> None:
        """Listen for PX4 on TCP port 4560 + instance, 0 = any free port, or raise UsageError.

        `answer_s` is the timeout of a reply, `start_s` of the first reply [wall s];
        `least_state_us` is the minimum interval of the true state [µs].
        """
        self._least_state_us = least_state_us
        self.armed = False
        self.time_us = 0
        self.unanswered = 0
        self.duplicates = 0
        self._tcp = TcpPort(port)
        self.port = self._tcp.port
        self._answer_s, self._start_s = answer_s, start_s
        self._clock = WallClock()
        self._alive: Callable[[], None] = no_process
        self._decoder = Decoder(datagrams=False)
        self._encoder = Encoder()
        self._truth: Callable[[], interfaces.TrueState] | None = None
        self._state_us, self._state_due_us = STATE_US, 0
        self._first_us: int | None = None
        """Simulated time of the first sample [µs]."""
        self._began_us = 0
        """Wall time of the first sample [µs]."""
        self._sent_us = 0
        """PX4's time of the newest sample [µs]."""
        self._pace_us = 0
        """Wall time of the next sample, until the first reply [µs]."""
        self._answer: hil.Controls | None = None
        """Newest reply."""
        self._waiting: Patience | None = None
        """Timer since a reply is due; None = no reply is due."""
        self._program: RunningProgram | None = None
        """PX4's process; None = not found."""
        self._garbage_bytes = 0
        """Number of bytes since the last message."""
        self._fixes: list[interfaces.GpsFix | None] = [None] * GPS_TICKS
        """GPS fixes of the newest samples, not yet sent."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until PX4 has connected; see `Bridge`."""
        self._alive = alive
        if not self._tcp.accept(timeout_s, alive):
            raise interfaces.FirmwareMissingError(
                f"PX4 did not connect to TCP port {self.port} within {timeout_s:g} s: is it "
                f"running, with PX4_SIM_MODEL={programs.MODEL} and "
                f"-i {self.port - programs.SIMULATOR_PORT}?"
            )
        pid = program_at(*self._tcp.peer, self.port)
        if pid is not None:
            self._program = RunningProgram(pid, programs.UNAWAITED_THREADS)

    def settle(self) -> None:
        """Wait until PX4 has done all work due by its clock, as far as observable.

        Controllers and estimator have finished when PX4 answers a sample. Other threads may lag on
        a busy host.
        """
        if self._program is not None and self._answer is not None:
            self._program.settle()

    def alive(self) -> None:
        """Raise FirmwareLostError if PX4 has ended or was stopped."""
        self._alive()
        if self._program is not None and self._program.stopped:
            raise self._lost(
                f"is stopped (process {self._program.pid}, SIGSTOP): SIGCONT resumes it"
            )

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Set the source of the true state."""
        self._truth = truth

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Advance PX4 to the sample's time; see `Bridge`. Motors are stopped until it replies."""
        if self._first_us is None:
            self._first_us = sample.time_us
            self._began_us = self._clock.time_us()
        now_us = sample.time_us - self._first_us + EPOCH_US
        if self._answer is None:
            self._pace()
        self._send(sample, now_us)
        if self._answer is None:
            self._receive(0.0)
            if self._answer is None:
                return interfaces.ActuatorControls(sample.time_us, hil.STILL, armed=False)
        try:
            return hil.controls(self._answered(), sample.time_us)
        except hil.ControlsError as error:
            raise self._lost(f"sent {error}") from error

    def close(self) -> None:
        """Close the port and the connection."""
        self._tcp.close()
        if self._program is not None:
            self._program.close()

    # --- sending

    def _pace(self) -> None:
        """Wait for the next sample's wall time or PX4's first reply, to keep queues short."""
        while (wait_us := self._pace_us - self._clock.time_us()) > 0 and self._answer is None:
            self._receive(min(wait_us / constants.US_PER_S, WATCH_S))
        now_us = self._clock.time_us()
        self._pace_us = now_us + constants.TICK_US
        self._alive()
        if now_us - self._began_us > self._start_s * constants.US_PER_S:
            raise self._lost(
                f"connected, but answered none of {self.unanswered} samples in {self._start_s:g} s"
            )

    def _send(self, sample: interfaces.SensorSample, now_us: int) -> None:
        encoder = self._encoder
        self._fixes.append(sample.gps)
        if (fix := self._fixes.pop(0)) is not sample.gps:
            sample = sample._replace(gps=fix)
        # HIL_SENSOR goes last: it advances PX4's clock and triggers the reply.
        data = b""
        for name, kind, fields in _BESIDE_THE_SAMPLE:
            measured = getattr(sample, name)
            if measured is not None:
                data += encoder.frame(kind, kind.payload(fields(measured, now_us)))
        if now_us >= self._state_due_us and self._truth is not None:
            # Keep the phase and skip missed messages.
            late_us = now_us - self._state_due_us
            self._state_due_us = now_us + self._state_us - late_us % self._state_us
            state = hil_state_quaternion(self._truth(), now_us)
            data += encoder.frame(hil.STATE, hil.STATE.payload(state))
        data += encoder.frame(hil.SENSOR, hil.SENSOR.payload(hil.sensor(sample, now_us)))
        self._sent_us = now_us
        if not self._tcp.send(data, self._answer_s, self._alive):
            raise self._lost("closed its connection, or reads no more")
        if self._answer is None:
            self.unanswered += 1

    # --- receiving

    def _answered(self) -> hil.Controls:
        """Wait for the reply to the newest sample, and return the newest reply."""
        if self._waiting is None and self._due is None:
            self._receive(AT_ONCE_S)
        if (answer := self._due) is not None:
            self._waiting = None
            return answer
        waiting = self._waiting = self._waiting or Patience()
        asked_s = waited_s = waiting.so_far_s()
        while (answer := self._due) is None:
            left_s = self._answer_s - waited_s
            if left_s <= 0.0:
                raise self._lost(f"did not answer within {self._answer_s:g} s")
            if self._answer is not None and not self.armed:
                rest_s = REST_S - (waited_s - asked_s)
                if rest_s <= 0.0:
                    return self._answer
                left_s = min(left_s, rest_s)
            if not self._receive(min(left_s, WATCH_S)):
                self._alive()
                if waited_s > STOPPED_S:
                    self.alive()
            waited_s = waiting.so_far_s()
        self._waiting = None
        return answer

    @property
    def _due(self) -> hil.Controls | None:
        """Reply to the newest sample; None = not received yet."""
        return self._answer if self.time_us == self._sent_us else None

    def _receive(self, timeout_s: float) -> bool:
        """Handle data that arrive in time; return True if any did."""
        data = self._tcp.receive(timeout_s)
        if data is None:
            self._alive()
            raise self._lost("closed its connection: it ended, or restarted")
        if not data:
            return False
        if self._decoder.between_frames and (answer := hil.answer(data)) is not None:
            self._garbage_bytes = 0
            self._take_answer(answer)
            return True
        messages = self._decoder.feed(data)
        self._garbage_bytes = 0 if messages else self._garbage_bytes + len(data)
        for message in messages:
            if message.get_msgId() == _COMMAND:
                self._command(message)
            elif message.get_msgId() == _ANSWER:
                self._take_answer(message)
        if self._garbage_bytes > MAX_GARBAGE_BYTES or self._decoder.malformed > MAX_GARBAGE:
            raise self._lost("sends bytes that are not MAVLink")
        return True

    def _take_answer(self, message: hil.Controls) -> None:
        time_us: int = message.time_usec
        if not hil.lockstep(message):
            raise interfaces.FirmwareMissingError(
                f"PX4 on TCP port {self.port} does not wait for the simulator: it must be built "
                "with lockstep (make px4_sitl_default)"
            )
        if time_us > self._sent_us:
            raise self._lost(f"answered a sample that it was not sent yet: {_seconds(time_us)}")
        if self._answer is not None and time_us <= self.time_us:
            if time_us < self.time_us:
                was, now = _seconds(self.time_us), _seconds(time_us)
                raise self._lost(f"went back in time from {was} to {now}: it restarted?")
            self.duplicates += 1
            return
        self._answer = message
        self.time_us = time_us
        self.armed = hil.armed(message)

    def _command(self, message: WireMessage) -> None:
        """Apply SET_MESSAGE_INTERVAL for the true state; PX4 expects no acknowledgement."""
        if (
            message.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL
            or message.param1 != dialect.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
            or not math.isfinite(message.param2)
        ):
            return
        asked = message.param2
        wanted_us = int(asked) if asked >= 1.0 else STATE_US
        self._state_us = max(wanted_us, self._least_state_us)
        self._state_due_us = NEVER_US if asked < 0.0 else self._sent_us

    def _lost(self, what: str) -> interfaces.FirmwareLostError:
        notes = [f"{self._decoder.malformed} runs of garbage"] if self._decoder.malformed else []
        if self._tcp.refused:
            notes.append(f"{self._tcp.refused} other connections refused")
        more = f" ({', '.join(notes)})" if notes else ""
        return interfaces.FirmwareLostError(
            f"PX4 on TCP port {self.port} {what}, at {_seconds(self._sent_us)} of its clock{more}"
        )


def _seconds(time_us: int) -> str:
    return f"{time_us / constants.US_PER_S:.3f} s"


def px4_parts(
    request: flight_stack.FirmwareRequest,
    instance: int | None = None,
    bridge: Callable[[int], Px4Bridge] = Px4Bridge,
) -> tuple[Launcher, FirmwareObserver]:
    """Bind PX4's payload link. Return PX4's launcher and the observer on this link.

    `instance` shifts the ports; None = the requested instance, whose ports must be free. `bridge`
    opens the simulator interface on a port.
    """
    options = request.aircraft.real
    if instance is None:
        instance = options.instance
        if options.px4_dir is not None:
            # With a taken port, PX4 would start without its links, or not at all, in every flight.
            programs.check_free(instance)
    airframe = parameters.px4_airframe(request.vehicle, parameters.SITL_OUTPUT)
    program = None if options.px4_dir is None else programs.find_px4(options.px4_dir)
    endpoint = flight_stack.instance_endpoint(
        programs.PAYLOAD_PORT + instance, programs.PAYLOAD_LOCAL_PORT + instance
    )
    launcher = Launcher(
        airframe,
        partial(bridge, programs.SIMULATOR_PORT + instance),
        options.firmware_timeout,
        farewell=SHUT_DOWN,
        program=None if program is None else partial(program.start, instance, airframe.autostart),
        folders=WorkingFolders("px4", options.firmware_dir, request.log),
    )
    return launcher, flight_stack.observed(request, endpoint)
