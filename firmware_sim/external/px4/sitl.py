"""PX4's simulator interface (SITL): lockstep over TCP, PX4 being the client.

Source: PX4, src/modules/simulation/simulator_mavlink; the order of messages as measured.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

from airl_mav.core.clock import Patience, WallClock
from airl_mav.core.constants import TICK_HZ, TICK_US, US_PER_S
from firmware_sim.external.launcher import no_process
from firmware_sim.external.process import RunningProgram, program_at
from firmware_sim.external.px4 import hil_messages as hil
from firmware_sim.external.px4.program import MODEL, SIMULATOR_PORT, UNAWAITED_THREADS
from firmware_sim.external.transport.tcp_port import WATCH_S, TcpPort
from firmware_sim.flight_controller import FirmwareLostError, FirmwareMissingError
from firmware_sim.interfaces import ActuatorControls, SensorSample, Truth
from firmware_sim.mavlink.codec import Decoder, Encoder, WireMessage, dialect
from firmware_sim.mavlink.streams.pose import hil_state_quaternion

ANSWER_S = 5.0
"""Longest wait for an answer [wall s]."""

STOPPED_S = 1.0
"""A PX4 that has not answered for so long is looked at: is it stopped? [wall s] Sooner than its
clients miss its heartbeats."""

REST_S = 0.1
"""Longest wait for one answer of a PX4 that is disarmed [wall s]. Then the next sample is sent. In
Offboard on the ground, without a setpoint, it answers only now and then, by its own clock, which
does not advance while it is waited for."""

AT_ONCE_S = 0.01
"""An answer that comes sooner is nothing to look at the clock for [wall s]."""

START_S = 60.0
"""Longest time from the first sample to the first answer [wall s]: PX4's start script runs."""

EPOCH_US = US_PER_S
"""PX4's time of the first sample [µs]: it reads 0 as never."""

STATE_US = 200_000
"""How often the true state is sent [µs], unless PX4 asks."""

NEVER_US = sys.maxsize

MAX_GARBAGE = 16
"""Most runs of garbage that are tolerated; TCP should deliver none."""

MAX_GARBAGE_BYTES = 4096
"""Longest run of it."""

_ANSWER = dialect.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS
_COMMAND = dialect.MAVLINK_MSG_ID_COMMAND_LONG


class Px4Bridge:
    """Flies PX4 SITL: it gets HIL_SENSOR and answers each with one HIL_ACTUATOR_CONTROLS.

    Implements `Bridge`. PX4's clock is HIL_SENSOR's time. Before its first answer samples are sent
    at their nominal rate and motors are stopped. Disarmed it may skip answers for a while. Silence,
    a closed connection, clock jumps, garbage or invalid motor commands end the flight
    (`FirmwareLostError`). Second answers are dropped, second connections refused.
    """

    rate_hz = TICK_HZ

    def __init__(
        self,
        port: int,
        *,
        answer_s: float = ANSWER_S,
        start_s: float = START_S,
        least_state_us: int = 1,
    ) -> None:
        """Listen for PX4 on TCP port 4560 + instance, 0 = any free one, or raise UsageError.

        `answer_s` and `start_s` are the timeouts of an answer and of the first one [wall s],
        `least_state_us` the minimum interval of the true state.
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
        self._truth: Callable[[], Truth] | None = None
        self._state_us, self._state_due_us = STATE_US, 0
        self._first_us: int | None = None
        """Simulated time of the first sample [µs]."""
        self._began_us = 0
        """Wall time of the first sample [µs]."""
        self._sent_us = 0
        """PX4's time of the newest sample [µs]."""
        self._pace_us = 0
        """Wall time before which no sample is sent, until the first answer [µs]."""
        self._answer: hil.Controls | None = None
        """The newest one."""
        self._waiting: Patience | None = None
        """Since when an answer is due; None: no answer is due."""
        self._program: RunningProgram | None = None
        """PX4's process, where it can be found."""
        self._garbage_bytes = 0
        """Bytes since the last message."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until PX4 has connected; see `Bridge`."""
        self._alive = alive
        if not self._tcp.accept(timeout_s, alive):
            raise FirmwareMissingError(
                f"PX4 did not connect to TCP port {self.port} within {timeout_s:g} s: is it "
                f"running, with PX4_SIM_MODEL={MODEL} and -i {self.port - SIMULATOR_PORT}?"
            )
        pid = program_at(*self._tcp.peer, self.port)
        if pid is not None:
            self._program = RunningProgram(pid, UNAWAITED_THREADS)

    def settle(self) -> None:
        """Return once PX4 has done all that is due by its clock, as far as that can be seen.

        Controllers and estimator are done when it answers a sample. Other threads may lag on a busy
        host.
        """
        if self._program is not None and self._answer is not None:
            self._program.settle()

    def alive(self) -> None:
        """Raise FirmwareLostError when PX4 has ended, or was stopped."""
        self._alive()
        if self._program is not None and self._program.stopped:
            raise self._lost(
                f"is stopped (process {self._program.pid}, SIGSTOP): SIGCONT resumes it"
            )

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Accept a source of the true state."""
        self._truth = truth

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Advance PX4 to the sample's time; see `Bridge`. Motors are stopped until it answers."""
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
                return ActuatorControls(sample.time_us, hil.STILL, armed=False)
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
        """Wait for the next sample's wall time or PX4's first answer, to keep queues short."""
        clock = self._clock
        while (wait_us := self._pace_us - clock.time_us()) > 0 and self._answer is None:
            self._receive(min(wait_us / US_PER_S, WATCH_S))
        now_us = clock.time_us()
        self._pace_us = now_us + TICK_US
        self._alive()
        if now_us - self._began_us > self._start_s * US_PER_S:
            raise self._lost(
                f"connected, but answered none of {self.unanswered} samples in {self._start_s:g} s"
            )

    def _send(self, sample: SensorSample, now_us: int) -> None:
        encoder = self._encoder
        # What comes with a sample goes before it: the sample moves PX4's clock, and is answered.
        data = b""
        if sample.gps is not None:
            data += encoder.frame(hil.GPS, hil.GPS.payload(hil.gps(sample.gps, now_us)))
        if sample.odometry is not None:
            seen = hil.odometry(sample.odometry, now_us)
            data += encoder.frame(hil.ODOMETRY, hil.ODOMETRY.payload(seen))
        if sample.distance is not None:
            told = hil.distance(sample.distance, now_us)
            data += encoder.frame(hil.DISTANCE, hil.DISTANCE.payload(told))
        if sample.flow is not None:
            seen_below = hil.flow(sample.flow, now_us)
            data += encoder.frame(hil.FLOW, hil.FLOW.payload(seen_below))
        if now_us >= self._state_due_us and self._truth is not None:
            # Keeps its phase, skips what it missed.
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
        """Wait for the answer to the newest sample, and return the newest there is."""
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
        """The answer to the newest sample; None: it has not come."""
        return self._answer if self.time_us == self._sent_us else None

    def _receive(self, timeout_s: float) -> bool:
        """Take what arrives in time; return whether anything did."""
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
            self._take(message)
        if self._garbage_bytes > MAX_GARBAGE_BYTES or self._decoder.malformed > MAX_GARBAGE:
            raise self._lost("sends bytes that are not MAVLink")
        return True

    def _take(self, message: WireMessage) -> None:
        number = message.get_msgId()
        if number == _COMMAND:
            self._command(message)
        elif number == _ANSWER:
            self._take_answer(message)

    def _take_answer(self, message: hil.Controls) -> None:
        time_us: int = message.time_usec
        if not hil.lockstep(message):
            raise FirmwareMissingError(
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
        """Carry out SET_MESSAGE_INTERVAL for the true state: PX4 asks for it, awaits no answer."""
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

    def _lost(self, what: str) -> FirmwareLostError:
        notes = [f"{self._decoder.malformed} runs of garbage"] if self._decoder.malformed else []
        if self._tcp.refused:
            notes.append(f"{self._tcp.refused} other connections refused")
        more = f" ({', '.join(notes)})" if notes else ""
        return FirmwareLostError(
            f"PX4 on TCP port {self.port} {what}, at {_seconds(self._sent_us)} of its clock{more}"
        )


def _seconds(time_us: int) -> str:
    return f"{time_us / US_PER_S:.3f} s"
