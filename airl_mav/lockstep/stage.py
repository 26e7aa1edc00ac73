"""Vehicle, flight controller, MAVSDK and a companion on one simulated clock, put together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import TracebackType

from airl_mav.core.clock import SimClock
from airl_mav.core.errors import UsageError
from airl_mav.faults.kinds import LINKS
from airl_mav.faults.model import Fault
from airl_mav.lockstep.camera import MemoryCamera
from airl_mav.lockstep.conductor import Conductor
from airl_mav.lockstep.digest import FlightDigest
from airl_mav.lockstep.link import BOOT_UNIX_US, ConductedVehicle, builtin_vehicle
from airl_mav.lockstep.threaded import PATIENCE_S, ThreadPartner
from airl_mav.lockstep.turns import COMPANION_STARTS_US, LockstepError
from companion.conducted import ConductedClock
from companion.interfaces import LinkError
from companion.mavsdk_connection import RAW_TIMEOUT_S, RAW_URL
from companion.mavsdk_link import MavsdkLink
from firmware_sim.autopilot.commander import Phase
from firmware_sim.faults.timeline import FaultTimeline
from firmware_sim.firmware import Firmware
from firmware_sim.simulation import EpisodeSetup, Simulation

HEARD_TIMEOUT_S = 10.0
"""Longest wait of the companion for the heartbeat that it has been fed [wall s]."""

CUT_TIMEOUT_S = 0.5
"""MAVSDK's own time-out of a command, before it asks again [wall s]."""

STOPPED = "stopped"


class Stage:
    """One flight of any companion program. Use as a context manager."""

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
        """Put everything together; nothing moves yet.

        Args:
            transport_us: From a frame's exposure until it lies decoded in the companion [µs].
            digest: Takes the fingerprint of what crosses the link; None: nobody wants it.
            speed: Greatest number of simulated seconds per wall second; None: as fast as it goes.
            faults: What the episode's aircraft has of them; only those of the link matter here.
            vehicle: What flies, released with the stage; None: the built-in autopilot.
            patience_s: Longest turn of the companion [s of wall time].
        """
        clock = SimClock()
        self._vehicle = vehicle = vehicle or builtin_vehicle(clock, faults)
        self._partner = ThreadPartner(patience_s)
        self.abandon = threading.Event()
        """Makes the link break off whatever it waits for."""
        self.conductor = Conductor(vehicle.end, self._partner, digest, speed, clock)
        self.clock = ConductedClock(self.conductor.clock, self._partner.sleep)
        """The companion's clock, and its watchdog's guard."""
        self.camera = MemoryCamera(transport_us)
        """The companion's source of frames."""
        self.camera.clock = self.clock
        self.firmware = Firmware(
            vehicle.stack, self.camera, self.conductor, failing=vehicle.failing
        )
        self.unheard = ""
        """Why the companion never began: a fault has kept it from hearing the vehicle."""
        self.out = ""
        """The fault after which the companion flies no more, as `companion killed`."""
        self._open = ExitStack()

    def __enter__(self) -> Stage:
        """Make the link."""
        # In the order of need: the companion's thread ends before its link does.
        self._open.enter_context(closing(self.firmware))
        self.link = MavsdkLink(
            *(RAW_URL, self.clock, self.abandon),
            heard=lambda: self.conductor.heard,
            poll=self.clock.poll,
        )
        """The companion's link; `run` connects it."""
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
        """End the companion and release everything."""
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
        """Fly until the companion's program has ended.

        One that a fault has killed, or stopped for good, never ends: without it the flight is over
        when it is judged, or the motors stop.

        Args:
            setup: The episode.
            program: What the companion does, on a thread of its own, with `link` connected;
                simulated time moves only while it sleeps by `clock`.
            tlog: Where the MAVLink log goes; None: no log.
            begun: Called with the simulated time of the reset [µs].
            stop: What ends the program early when it is set; None: it is not to be ended so.
            judged: Asked whether the flight is judged, when nobody flies any more.

        Returns:
            The simulation as it stands at the end; closed with the stage.

        Raises:
            UsageError: The program found that it cannot be flown.
            LockstepError: The companion hangs, or broke.
        """
        firmware, conductor = self.firmware, self.conductor
        started_us = firmware.load(setup, tlog, BOOT_UNIX_US).time_us
        begun(started_us)
        simulation = firmware.simulation
        if simulation is not None and simulation.faults is not None:
            self._give_up_when_cut(simulation.faults)
            self._let_companion_fail(simulation.faults)

        def connected() -> None:
            try:
                self.link.connect(HEARD_TIMEOUT_S)
            except LinkError as error:
                if not setup.aircraft.faults:
                    raise
                self.unheard = str(error)
                return
            program()

        self._partner.start(connected)
        conductor.begin(started_us + self._vehicle.heard_after_us + COMPANION_STARTS_US)
        while not conductor.ended and not (self.out and (judged() or self._down())):
            firmware.step()
        if self.out.endswith(STOPPED):
            # It says what it knows, and flies no more.
            self.abandon.set()
            if stop is not None:
                stop.set()
            conductor.resume()
            while not conductor.ended:
                firmware.step()
        self._raise_what_broke()
        assert firmware.simulation is not None  # noqa: S101 (loaded above)
        return firmware.simulation

    def _give_up_when_cut(self, faults: FaultTimeline) -> None:
        """Let MAVSDK give up a command on a link that is cut, as it does by itself elsewhere.

        On a healthy link the answer is certain, and MAVSDK waits for it however slow the host is.
        """

        def changed() -> None:
            cut = any(each.fault.kind == "cut" for each in faults.acting(*LINKS))
            self.link.set_timeout(CUT_TIMEOUT_S if cut else RAW_TIMEOUT_S)

        faults.on_change(changed)

    def _let_companion_fail(self, faults: FaultTimeline) -> None:
        """Withhold the companion's turns while it is suspended, and from when it is killed."""

        def changed() -> None:
            acting = [each.fault for each in faults.acting("companion")]
            for_good = next((fault for fault in acting if fault.for_good), None)
            if for_good is not None:
                self.out = self.out or f"{for_good.part} {for_good.kind}"
            if acting:
                self.conductor.suspend()
            elif not self.out:
                self.conductor.resume()

        changed()
        faults.on_change(changed)

    def _down(self) -> bool:
        """Return whether the motors stand."""
        simulation = self.firmware.simulation
        return simulation is None or simulation.autopilot.flight.phase < Phase.GROUND

    def _raise_what_broke(self) -> None:
        error = self._partner.error
        if isinstance(error, UsageError):
            raise error
        if error is not None:
            raise LockstepError(f"the companion broke: {type(error).__name__}: {error}") from error
