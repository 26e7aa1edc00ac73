"""External firmware as a flight stack: start, frame check, parameters, ready to arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.addons import load
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.profiles.px4_release import stored_release
from airl_mav.profiles.vehicle import CORNERS, VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim import interfaces, simulation
from firmware_sim.autopilot import autopilot_state, commander
from firmware_sim.external.launcher import Launcher
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.external.parameters import GROUND_LOSS, differences
from firmware_sim.external.programs import firmware_kind
from firmware_sim.mavlink import link, px4_links, traffic
from firmware_sim.mavlink.endpoint import Endpoint, UdpEndpoint

ASK_EVERY_S = 0.25
"""Interval of repeated requests for missing parameters [wall s]."""

FAREWELL_S = 1.5
"""Simulated time after the shutdown command [simulated s]; PX4 needs 0.4 s."""

SHOWN = 4
"""Maximum number of parameters named in a message."""

LEAST_WAIT_S = 2.0
"""Minimum wait for a reply before the wall-clock timeout applies [simulated s]."""

READY_LIMIT_S = 120.0
"""Maximum wait of a boot step [simulated s]; ArduPilot's EKF is ready to arm after 40 s."""


@dataclass(frozen=True)
class FirmwareRequest:
    """Request for real firmware."""

    aircraft: Aircraft
    vehicle: VehicleProfile
    log: Path | None
    """Log file for the firmware's output; None = a file in its folder."""
    bind_ends: Callable[[], px4_links.UdpLinks]
    """Bind the vehicle's ends of the links, if not bound by the firmware."""


def real_firmware(request: FirmwareRequest) -> ExternalFlightStack:
    """Bind the ports of real firmware and return it, not yet started. Raises UsageError."""
    launcher, observer = load(firmware_kind(request.aircraft.firmware).parts)(request)
    return ExternalFlightStack(launcher, observer, request.aircraft.real.firmware_timeout)


def instance_endpoint(local_port: int, remote_port: int | None = None) -> UdpEndpoint:
    """Bind a loopback port that depends on `--instance`. Raises UsageError if it is taken."""
    remote = None if remote_port is None else (LOOPBACK, remote_port)
    option = "--instance"
    return UdpEndpoint((LOOPBACK, local_port), remote, local_option=option, remote_option=option)


def observed(request: FirmwareRequest, endpoint: Endpoint) -> FirmwareObserver:
    """Return the observer of a vehicle's firmware on a link."""
    return FirmwareObserver(endpoint, "observer", request.vehicle.told_origin)


class ExternalFlightController:
    """External firmware behind a bridge. Implements `FlightController`."""

    internals = None

    def __init__(self, launcher: Launcher, observer: FirmwareObserver) -> None:
        """Start or await the firmware, see `Launcher.launch`; `observer` watches its MAVLink."""
        self._bridge = bridge = launcher.launch()
        self._observer = observer
        self._launcher = launcher
        self._output = tuple(launcher.airframe.motors.index(corner) for corner in CORNERS)
        self._sample: interfaces.SensorSample | None = None
        self.rate_hz = bridge.rate_hz
        self.use_truth = bridge.use_truth
        self.body_by = launcher.body_by

    @property
    def on_message(self) -> Callable[[autopilot_state.OperatorText], None] | None:
        """Callback for every operator text; None = no callback."""
        return self._observer.on_message

    @on_message.setter
    def on_message(self, call: Callable[[autopilot_state.OperatorText], None] | None) -> None:
        self._observer.on_message = call

    @property
    def flight(self) -> commander.CommanderState:
        """Phase and mode from the heartbeat, with the armed state from the faster bridge."""
        return self._observer.flight(armed=self._bridge.armed)

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Advance the firmware to the sample's time. Raises FirmwareLostError."""
        self._sample = sample
        controls = self._bridge.step(sample)
        m = controls.motors
        a, b, c, d = self._output
        return interfaces.ActuatorControls(
            controls.time_us, (m[a], m[b], m[c], m[d]), armed=controls.armed
        )

    def close(self) -> None:
        """Stop firmware started here; otherwise command its end, if it has to end."""
        farewell = self._launcher.farewell
        if farewell is not None and not self._launcher.may_set:
            self._send_shutdown(farewell)
        self._launcher.stop()

    def _send_shutdown(self, farewell: int) -> None:
        """Send the command and continue to simulate until it has taken effect."""
        sample, self._sample = self._sample, None
        if sample is None:
            return
        self._observer.end(farewell)
        period_us = US_PER_S // self.rate_hz
        with suppress(interfaces.FirmwareLostError):
            for _ in range(round(FAREWELL_S * self.rate_hz)):
                sample = sample._replace(time_us=sample.time_us + period_us)
                self._bridge.step(sample)


class ExternalFlightStack:
    """External firmware and its observer. Implements `firmware_sim.firmware.FlightStack`."""

    def __init__(
        self,
        launcher: Launcher,
        observer: FirmwareObserver,
        timeout_s: float,
        *,
        on_close: Callable[[], None] = lambda: None,
        look_every_us: int = 0,
    ) -> None:
        """Compose the stack without starting it.

        `timeout_s` is the timeout of each boot step [wall s]. `look_every_us` is the minimum
        interval at which the observer's link is read [simulated µs].
        """
        self._on_close = on_close
        self._launcher = launcher
        self._observer = observer
        self._timeout_s = timeout_s
        self._missing: list[str] = []
        """Names of parameters still missing."""
        self.version = launcher.airframe.firmware
        self.filenos = observer.filenos
        self._look_every_us, self._look_us = look_every_us, 0
        self.send = observer.send
        self.local, self.title = launcher.local, launcher.title
        self.counters: Callable[[], dict[str, link.LinkCounters]] = observer.counters

    def next_send_us(self) -> float:
        """Return 0: `send` is called after every tick."""
        return 0.0

    def receive(self, now_us: int) -> int:
        """Handle messages received by simulated `now_us` [µs]; return the number accepted."""
        if now_us < self._look_us:
            return 0
        self._look_us = now_us + self._look_every_us
        return self._observer.receive(now_us)

    def log_to(self, tlog: traffic.TlogWriter | None) -> None:
        """Log the observer's link to a tlog. The firmware's flight log is copied beside it."""
        self._observer.log_to(tlog)
        if tlog is not None:
            self._launcher.flight_log = tlog.path.with_suffix(interfaces.ULOG_SUFFIX)

    def effects(self) -> tuple[()]:
        """Return an empty tuple: traffic on the firmware's links is not inspected."""
        return ()

    def boot(self, setup: simulation.EpisodeSetup) -> ExternalFlightController:
        """Start the firmware of an episode, or wait for it; see `Launcher.launch`."""
        del setup  # Each start is a power-up without state of an earlier flight.
        self._observer.restart()
        return ExternalFlightController(self._launcher, self._observer)

    def connect(self, tick: Callable[[], int], truth: Callable[[], interfaces.TrueState]) -> None:
        """Run the boot sequence on the ground until the frame is checked and arming is possible.

        `tick` flies a tick and returns its simulated time [µs].

        Raises:
            FirmwareMissingError: The firmware is silent, has another frame, or cannot be armed.
            FirmwareLostError: The firmware died.
        """
        del truth
        airframe, observer = self._launcher.airframe, self._observer
        parameters = observer.parameters
        self._until(tick, lambda: observer.heard, "a MAVLink heartbeat")
        names = airframe.names()
        self._until(tick, self._asking(lambda: parameters.ask(names)), "the parameters")
        # If the loss of a ground station triggers an action, it must do so in a rehearsal too.
        observer.acts_as_ground_station = not parameters.values.get(GROUND_LOSS, 0)
        if observer.version is not None:
            self.version = stored_release(airframe.firmware, observer.version)[1]
        if source := self.title():
            self.version += f"; {source}"
        if lacking := sorted(parameters.absent.difference(airframe.also_read)):
            raise interfaces.FirmwareMissingError(
                f"{self.version} lacks {_some(lacking)}: accepted: a vehicle profile without it"
            )
        problem = airframe.problem(parameters.values)
        if problem is not None:
            raise interfaces.FirmwareMissingError(problem)
        if self._launcher.may_set:
            wanted = airframe.settings
            self._until(tick, self._asking(lambda: parameters.set(wanted)), "set parameters")
        elif different := differences(parameters.values, airframe.settings):
            self._say(
                autopilot_state.Severity.WARNING,
                f"{airframe.firmware} is not configured as the vehicle: {_some(different)}",
            )
        self._until(tick, lambda: observer.ready, "its report that it may be armed")
        self._say(autopilot_state.Severity.INFO, self.version)

    def close(self) -> None:
        """Stop the firmware if it was started here, and close the observer."""
        self._launcher.close()
        self._observer.close()
        self._on_close()

    def _asking(self, ask: Callable[[], Iterable[str]]) -> Callable[[], bool]:
        """Return a function that repeats a request at intervals; True once nothing is missing."""
        clock, due_us = WallClock(), 0

        def asked() -> bool:
            nonlocal due_us
            if clock.time_us() < due_us:
                return False
            due_us = clock.time_us() + int(ASK_EVERY_S * US_PER_S)
            self._missing = list(ask())
            return not self._missing

        return asked

    def _until(self, tick: Callable[[], int], met: Callable[[], bool], what: str) -> None:
        observer, clock = self._observer, WallClock()
        start_us: int | None = None
        self._missing = []
        while not met():
            now_us = tick()
            observer.receive(now_us)
            observer.send(now_us)
            start_us = now_us if start_us is None else start_us
            simulated_us = now_us - start_us
            late = simulated_us > READY_LIMIT_S * US_PER_S
            # A busy host simulates little time within the wall-clock timeout.
            silent = simulated_us > LEAST_WAIT_S * US_PER_S
            if late or (silent and clock.time_us() > self._timeout_s * US_PER_S):
                left = f" ({_some(self._missing)})" if self._missing else ""
                spent_s = simulated_us / US_PER_S
                raise interfaces.FirmwareMissingError(
                    f"{self._launcher.airframe.firmware} runs, but {what}{left} did not arrive in "
                    f"{clock.time_us() / US_PER_S:.0f} s ({spent_s:.0f} s simulated); it said: "
                    f"{observer.last_text or 'nothing'}"
                )

    def _say(self, severity: autopilot_state.Severity, text: str) -> None:
        if self._observer.on_message is not None:
            self._observer.on_message(autopilot_state.OperatorText(severity, text))


def _some(items: Sequence[str]) -> str:
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + more
