"""Vehicle, flight controller, MAVSDK and companion, connected on one simulated clock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import TracebackType

from airl_mav.core.clock import SimClock
from airl_mav.core.errors import UsageError
from airl_mav.faults.fault import Fault
from airl_mav.faults.kinds import LINKS
from airl_mav.lockstep.conductor import Conductor
from airl_mav.lockstep.digest import FlightDigest
from airl_mav.lockstep.lockstep_camera import MemoryCamera
from airl_mav.lockstep.lockstep_link import BOOT_UNIX_US, ConductedVehicle, builtin_vehicle
from airl_mav.lockstep.threaded import PATIENCE_S, ThreadPartner
from airl_mav.lockstep.turns import COMPANION_STARTS_US, LockstepError
from companion.conducted import ConductedClock
from companion.link_interface import LinkError
from companion.mavsdk_connection import RAW_TIMEOUT_S, RAW_URL
from companion.mavsdk_link import MavsdkLink
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.fault_timeline import FaultTimeline
from firmware_sim.firmware import Firmware
from firmware_sim.simulation import EpisodeSetup, Simulation

HEARD_TIMEOUT_S = 10.0
"""Companion's timeout for the first heartbeat, which has been fed already [wall s]."""

CUT_TIMEOUT_S = 0.5
"""MAVSDK's timeout for a command before it retries [wall s]."""

STOPPED = "stopped"


class LockstepStage:
    """One flight with any companion program. Use as a context manager."""

    def __init__(
        self,
        *,
        transport_us: int = 0,
        digest: FlightDigest | None = None,
        speed: float | None = None,
        faults: Sequence[Fault] = (),
        vehicle: ConductedVehicle | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """Connect all parts; nothing is started.

        Args:
            transport_us: Time from a frame's exposure to the decoded frame in the companion [µs].
            digest: Digest of all traffic on the link; None = not needed.
            speed: Maximum simulated seconds per wall second; None = unlimited.
            faults: Faults of the episode's aircraft; only link faults are used here.
            vehicle: Vehicle, closed with the stage; None = the built-in autopilot.
            patience_s: Maximum duration of the companion's turn [s of wall time].
        """
        # The order of creation follows the dependencies: clock, vehicle, partner, conductor.
        clock = SimClock()
        self._vehicle = vehicle = vehicle or builtin_vehicle(clock, faults)
        self._partner = ThreadPartner(patience_s)
        self.abandon = threading.Event()
        """Event that aborts all waits of the link."""
        self.conductor = Conductor(vehicle.end, self._partner, digest, speed, clock)
        self.clock = ConductedClock(self.conductor.clock, self._partner.sleep)
        """Clock of the companion, also the guard of its watchdog."""
        self.camera = MemoryCamera(transport_us)
        """Frame source of the companion."""
        self.camera.clock = self.clock
        self.firmware = Firmware(
            vehicle.stack, self.camera, self.conductor, failing=vehicle.failing
        )
        self.unheard = ""
        """Reason if a fault kept the companion from receiving the vehicle; otherwise empty."""
        self.out = ""
        """Fault that ended the companion for good, such as `companion killed`; otherwise empty."""
        self._open = ExitStack()

    def __enter__(self) -> LockstepStage:
        """Create the link."""
        # Reverse order of closing: the companion's thread ends before its link.
        self._open.enter_context(closing(self.firmware))
        self.link = MavsdkLink(
            *(RAW_URL, self.clock, self.abandon),
            # Silence in wall time means nothing in lockstep.
            heard=lambda: self.conductor.heard,
            poll=self.clock.poll,
        )
        """Link of the companion, connected by `run`."""
        self._open.enter_context(closing(self.link))
        self._open.enter_context(closing(self._partner))
        self._partner.attach(self.link)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the companion and release all resources."""
        self._open.close()

    def run(
        self,
        setup: EpisodeSetup,
        program: Callable[[], None],
        *,
        tlog: Path | None = None,
        begun: Callable[[int], None] = lambda _started_us: None,
        stop: threading.Event | None = None,
        judged: Callable[[], bool] = lambda: False,
    ) -> Simulation:
        """Fly until the companion's program ends.

        A program that a fault has killed or stopped for good never ends. The flight then ends at
        its verdict, or when the motors stop.

        Args:
            setup: Episode to fly.
            program: The companion's program. It runs on a separate thread with `link` connected.
                Simulated time advances only while the program sleeps on `clock`.
            tlog: Path of the MAVLink log; None = no log.
            begun: Called with the simulated time of the reset [µs].
            stop: Event that ends the program early; None = not supported.
            judged: Polled after the companion has stopped for good; True = there is a verdict.

        Returns:
            The simulation in its final state; closed with the stage.

        Raises:
            UsageError: The program rejects its input.
            LockstepError: The companion hangs or raised an error.
        """
        firmware, conductor = self.firmware, self.conductor
        started_us = firmware.load(setup, tlog, BOOT_UNIX_US).time_us
        begun(started_us)
        simulation = firmware.simulation
        if simulation is not None and simulation.faults is not None:
            # Registered before the first tick, so that a fault at time 0 acts.
            self._give_up_when_cut(simulation.faults)
            self._let_companion_fail(simulation.faults)

        def connected() -> None:
            try:
                self.link.connect(HEARD_TIMEOUT_S)
            # Without faults, a vehicle that cannot be heard is an error of the setup.
            except LinkError as error:
                if not setup.aircraft.faults:
                    raise
                self.unheard = str(error)
                return
            program()

        self._partner.start(connected)
        conductor.begin(started_us + self._vehicle.heard_after_us + COMPANION_STARTS_US)
        # A companion that is out for good ends the flight at the verdict or when disarmed.
        while not conductor.ended and not (self.out and (judged() or self._down())):
            firmware.step()
        if self.out.endswith(STOPPED):
            # The companion reports its results without flying.
            self.abandon.set()
            if stop is not None:
                stop.set()
            conductor.resume()
            while not conductor.ended:
                firmware.step()
        # Errors of the companion's thread are raised here, on the caller's thread.
        self._raise_what_broke()
        assert firmware.simulation is not None  # noqa: S101 (loaded above)
        return firmware.simulation

    def _give_up_when_cut(self, faults: FaultTimeline) -> None:
        """Use MAVSDK's short command timeout while the link is cut, as outside of lockstep.

        On an intact link an answer is certain, and MAVSDK waits for it even on a slow host.
        """

        def changed() -> None:
            cut = any(each.fault.kind == "cut" for each in faults.acting(*LINKS))
            self.link.set_timeout(CUT_TIMEOUT_S if cut else RAW_TIMEOUT_S)

        faults.on_change(changed)

    def _let_companion_fail(self, faults: FaultTimeline) -> None:
        """Suspend the companion's turns during its faults, and for good after it is killed."""

        def changed() -> None:
            # Several faults may overlap; a permanent fault wins.
            acting = [each.fault for each in faults.acting("companion")]
            for_good = next((fault for fault in acting if fault.for_good), None)
            if for_good is not None:
                self.out = self.out or f"{for_good.part} {for_good.kind}"
            if acting:
                self.conductor.suspend()
            elif not self.out:
                self.conductor.resume()

        # Called once for faults that act from the start.
        changed()
        faults.on_change(changed)

    def _down(self) -> bool:
        """Return True if the motors are stopped."""
        simulation = self.firmware.simulation
        return simulation is None or simulation.autopilot.flight.phase < FlightPhase.GROUND

    def _raise_what_broke(self) -> None:
        error = self._partner.error
        if isinstance(error, UsageError):
            raise error
        if error is not None:
            raise LockstepError(f"the companion broke: {type(error).__name__}: {error}") from error
