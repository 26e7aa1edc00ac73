"""Pre-flight check without arming: camera, flight controller and policy for a few seconds."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from typing import NamedTuple

import numpy as np

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.scheduling import held_to
from airl_mav.policy.observation import InFlight, Kinematics, observe, views_of
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.dialects import RATE_HZ
from companion.frame_source import FrameSource, ReceivedFrame
from companion.link_interface import LinkError
from companion.mavsdk_link import MavsdkLink
from companion.offboard_mission import FRAME_TIMEOUT_S, check_camera
from companion.pilot import age_of
from companion.program import MissionSetup, mission_camera
from companion.signing_proxy import signed

LOOK_S = 3.0
"""Duration of the checks of the camera and of the telemetry [wall s]."""

POLL_S = 0.002
"""Interval of telemetry reads [s]."""

DECISIONS = 30
"""Number of timed decisions, without the first one."""

LEAST_SHARE = 0.5
"""Minimum share of the requested telemetry rate."""


class CheckResult(NamedTuple):
    """Result of one check."""

    what: str
    good: bool
    told: str


def check_on_ground(
    asked: StandAloneCompanion, mission: MissionSetup, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check a flight's requirements one by one, skipping absent parts, until `stop` is set."""
    clock = WallClock(asked.speed)
    yield CheckResult("policy", True, f"{asked.policy}, holds an action {mission.pilot.hold_s:g} s")
    # CPU quota as in flight, so that the timed decisions are representative.
    with held_to(asked.cpu_quota):
        try:
            camera = mission_camera(asked, mission, clock)
        except UsageError as error:
            yield CheckResult("camera", False, str(error))
            return
        with closing(camera):
            yield from look_at_camera(mission, camera, clock, stop)
            # The newest frame serves as input for the timed decisions.
            seen = camera.latest()
            try:
                with (
                    signed(asked.connect, asked.signing_key) as url,
                    closing(MavsdkLink(url, clock, stop)) as link,
                ):
                    link.connect(asked.connect_timeout, stop)
                    yield from look_at_vehicle(link, mission, stop)
                    if seen is not None and not stop.is_set():
                        yield time_decisions(mission, seen, link.kinematics())
            except (LinkError, UsageError) as error:
                yield CheckResult("flight controller", False, str(error))


def look_at_camera(
    mission: MissionSetup, camera: FrameSource, clock: Clock, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check rate, age and changes of frames, and if they fit the policy."""
    first = camera.wait(-1, FRAME_TIMEOUT_S)
    if first is None:
        yield CheckResult("camera", False, f"no frame for {FRAME_TIMEOUT_S:g} s")
        return
    try:
        check_camera(mission.policy, camera, stop, mission.compensator)
    except UsageError as error:
        yield CheckResult("camera", False, str(error))
        return
    # Frames are not stored: a driver may send thousands of large frames.
    watch, last, frozen, ages_us = WallClock(), first, True, []
    # The loop counts changes of frames in wall time: rates of real devices.
    while watch.time_us() < LOOK_S * US_PER_S and not stop.is_set():
        newer = camera.wait(last.frame.sequence, 0.5)
        if newer is not None:
            # Equality with the first frame throughout means a frozen image.
            frozen = frozen and np.array_equal(first.frame.image, newer.frame.image)
            last = newer
            ages_us.append(age_of(newer, clock.time_us()))
    lens, rate_hz = first.frame.intrinsics, len(ages_us) / LOOK_S
    if not ages_us:
        yield CheckResult("camera", False, f"one frame in {LOOK_S:g} s")
        return
    kind = "" if lens.kind == "depth" else f"{lens.kind}, "
    told = f"{kind}{lens.width}x{lens.height} px, {rate_hz:.1f} frames/s"
    for name, other in first.frame.lenses.items():
        told += f"; {name}: {other.kind}, {other.width}x{other.height} px"
    if frozen:
        # Not a fault: a simulator's images of a vehicle at rest may be without noise.
        told += "; every image is the same (a real camera has noise)"
    age_us = float(np.median(ages_us))
    yield CheckResult(
        "camera", True, f"{told}; {age_us / US_PER_MS:.0f} ms old where it is decided on"
    )


def look_at_vehicle(
    link: MavsdkLink, mission: MissionSetup, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check the telemetry rate, then the reported state."""
    watch, changes, last = WallClock(), 0, link.kinematics()
    while watch.time_us() < LOOK_S * US_PER_S and not stop.is_set():
        watch.sleep_until(watch.time_us() + int(POLL_S * US_PER_S))
        now = link.kinematics()
        # A changed position is the sign of new telemetry.
        changes += not np.array_equal(now.position, last.position)
        last = now
    rate_hz = changes / LOOK_S
    status = link.status()
    yield CheckResult(
        "flight controller",
        link.connected,
        f"{link.dialect.name}, {'armed' if status.armed else 'disarmed'}, mode {status.mode}",
    )
    asked = f"position {rate_hz:.0f} times a second, {RATE_HZ:.0f} were asked for"
    # At least half of the requested rate must arrive.
    yield CheckResult("telemetry", rate_hz >= LEAST_SHARE * RATE_HZ, asked)
    # With an external origin, GPS health is not required.
    missing = link.missing_health(by_gps=mission.pilot.origin is None)
    charge, least = status.battery, mission.limits.battery
    yield CheckResult(
        "battery",
        least is None or (charge is not None and charge >= least),
        ("not told" if charge is None else f"{100.0 * charge:.0f} %")
        + ("" if least is None else f"; the limit is {100.0 * least:g} %"),
    )
    yield CheckResult(
        "health",
        not missing,
        f"not yet: {', '.join(missing)}"
        if missing
        else "calibrated, knows where it is, may be armed",
    )


def time_decisions(mission: MissionSetup, seen: ReceivedFrame, state: Kinematics) -> CheckResult:
    """Measure the policy's inference time (t2) on a received frame."""
    frame, watch, took_us = seen.frame, WallClock(), []
    # The same observation each time: only the duration matters.
    observation = observe(
        *(frame.image, frame.intrinsics, state, np.asarray(mission.goal, np.float64)),
        InFlight.of_first_decisions(1).rows(0),
        further=views_of(frame),
    )
    try:
        # One extra call: the first is dropped below.
        for _ in range(DECISIONS + 1):
            begun_us = watch.time_us()
            mission.policy.act(observation)
            took_us.append(watch.time_us() - begun_us)
    except Exception as error:
        # A policy may raise any exception.
        what = " ".join(f"{type(error).__name__}: {error}".split())
        return CheckResult("decision", False, f"the policy failed: {what}")
    del took_us[0]
    median_us = float(np.median(took_us))
    longest_s = max(took_us) / US_PER_S
    bound_s = mission.watchdog.timeout_s()
    return CheckResult(
        "decision",
        longest_s < bound_s,
        f"t2 {median_us / US_PER_MS:.2f} ms, the median of {DECISIONS}; longest"
        f" {1e3 * longest_s:.2f} ms, the watchdog's bound is {bound_s:g} s",
    )
