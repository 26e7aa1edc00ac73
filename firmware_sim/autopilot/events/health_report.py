"""Health and arming report: failing checks, and the modes available for arming and flight.

A report has an arming summary, one event per failing check, and a health summary. Source: PX4 1.16,
commander/HealthAndArmingChecks/Common.cpp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.events import definition
from firmware_sim.autopilot.failsafes.failsafe_conditions import lacking
from firmware_sim.autopilot.flight_modes import Mode, Need
from firmware_sim.autopilot.prearm import SUPPLY_CHECK_OFF, PrearmCheck, Readiness, checks

ALL_MODES = 0xFFFFFFFF

EXTERNAL_MODES = 0xFF << 23 & ~sum(mode.spec.state_bits for mode in Mode)
"""PX4's eight external modes, except those of the table."""

REPORT_US = 2 * US_PER_S
"""Minimum time between two reports of changes [µs] (PX4's reporting interval)."""

MAX_CHECKS = 14
"""Maximum number of checks in a report, as in PX4."""


def _summary(name: str, message: str, group: str, listed: str) -> definition.Definition:
    return definition.Definition(
        name,
        message,
        definition.arguments(listed),
        definition.Level.PROTOCOL,
        None,
        "",
        group,
        "summary",
    )


ARMING_SUMMARY = _summary(
    "commander_arming_check_summary",
    "Arming check summary event",
    "arming_check",
    "uint8_t chunk_idx, health_component_t error, health_component_t warning, "
    "navigation_mode_group_t can_arm, navigation_mode_group_t can_run",
)
HEALTH_SUMMARY = _summary(
    "commander_health_summary",
    "Health report summary event",
    "health",
    "uint8_t chunk_idx, health_component_t is_present, health_component_t error, "
    "health_component_t warning",
)


class HealthReport(NamedTuple):
    """Findings of the checks; equal reports are sent once."""

    can_arm: int
    """Bits of the modes that permit arming."""
    can_run: int
    """Bits of the modes available in flight."""
    checks: tuple[definition.MavlinkEvent, ...]
    """Events of the failing checks."""
    arming_error: int = 0
    """Bits of `Component`, like the four fields below."""
    arming_warning: int = 0
    present: int = 0
    health_error: int = 0
    health_warning: int = 0

    def events(self) -> tuple[definition.MavlinkEvent, ...]:
        """Return the events of the report in order."""
        whole = 0
        return (
            ARMING_SUMMARY.event(
                whole, self.arming_error, self.arming_warning, self.can_arm, self.can_run
            ),
            *self.checks[:MAX_CHECKS],
            HEALTH_SUMMARY.event(whole, self.present, self.health_error, self.health_warning),
        )


@lru_cache(maxsize=256)
def health_report(readiness: Readiness) -> HealthReport:
    """Return the findings of the checks for all modes."""
    in_modes = {mode: readiness._replace(mode=mode) for mode in Mode}
    findings: list[definition.MavlinkEvent] = []
    blocked = arming_error = arming_warning = health_error = health_warning = 0
    for check in checks(readiness.release):
        modes = _blocked_modes(check, readiness, in_modes)
        if modes is None:
            continue
        blocked |= modes
        bit = check.component.value
        level = check.event.level if check.level is None else check.level(readiness)
        error, warning = level <= definition.Level.ERROR, level is definition.Level.WARNING
        if check.is_health:
            health_error |= bit * error
            health_warning |= bit * warning
        else:
            arming_error |= bit * error
            arming_warning |= bit * warning
        shown = modes if check.shown is None else modes | _modes_needing(check.shown(readiness))
        values = (shown or ALL_MODES, check.component.bit_length() - 1, *check.values)
        findings.append(check.event.event(*values, level=level))
    return HealthReport(
        ALL_MODES & ~EXTERNAL_MODES & ~blocked,
        ALL_MODES & ~EXTERNAL_MODES & ~_cannot_run(readiness),
        tuple(findings),
        arming_error,
        arming_warning,
        _present(readiness),
        health_error,
        health_warning,
    )


def _blocked_modes(
    check: PrearmCheck, readiness: Readiness, in_modes: dict[Mode, Readiness]
) -> int | None:
    """Return the modes in which a check prevents arming; None = passed."""
    if check.of_present_mode and not check.fails(readiness):
        return None
    failing = [mode for mode, there in in_modes.items() if check.fails(there)]
    if not failing:
        return None
    blocks = check.blocks
    stopped = [mode for mode in failing if blocks is None or blocks(in_modes[mode])]
    if len(stopped) == len(Mode):
        return ALL_MODES
    return _bits(stopped)


def _cannot_run(readiness: Readiness) -> int:
    lacked = (mode for mode in Mode if lacking(mode, readiness.conditions) & ~Need.NOT_ARMING)
    return _bits(lacked)


def _modes_needing(need: Need) -> int:
    modes = [mode for mode in Mode if mode.spec.needs & need]
    return ALL_MODES if len(modes) == len(Mode) else _bits(modes)


def _bits(modes: Iterable[Mode]) -> int:
    bits = 0
    for mode in modes:
        bits |= mode.spec.state_bits
    return bits


def _present(r: Readiness) -> int:
    """Return the components that are present, healthy or not."""
    there = {
        definition.Component.GYRO: True,  # PX4 reports it for the accelerometer, too
        definition.Component.ABSOLUTE_PRESSURE: bool(r.settings.sys_has_baro),
        definition.Component.MAGNETOMETER: bool(r.settings.sys_has_mag),
        definition.Component.GPS: bool(r.settings.sys_has_gps) and r.gps,
        definition.Component.BATTERY: r.settings.cbrk_supply_chk != SUPPLY_CHECK_OFF,
        definition.Component.REMOTE_CONTROL: not r.conditions.manual_control_signal_lost,
        definition.Component.COMMUNICATION_LINKS: not r.conditions.gcs_connection_lost,
        definition.Component.LOCAL_POSITION_ESTIMATE: True,
    }
    return sum(part.value for part, here in there.items() if here)


class HealthReporter:
    """Sender of health reports, on change and on demand."""

    def __init__(self, send: Callable[[definition.MavlinkEvent], None]) -> None:
        """Store the callback that sends an event."""
        self._send = send
        self._readiness: Readiness | None = None
        self._report: HealthReport | None = None
        self._sent: HealthReport | None = None
        self._sent_us = 0

    @property
    def is_sent(self) -> bool:
        """True if the newest report has been sent."""
        return self._report == self._sent

    def update(self, readiness: Readiness, now_us: int, *, force: bool = False) -> None:
        """Update the report; send changes at most every `REPORT_US`, or now with `force`."""
        if readiness != self._readiness or self._report is None:
            self._readiness, self._report = readiness, health_report(readiness)
        due = self._report != self._sent and now_us >= self._sent_us + REPORT_US
        if due or force:
            self._sent, self._sent_us = self._report, now_us
            for event in self._report.events():
                self._send(event)
