"""Tables of failsafes and pre-arm checks for the documentation (Markdown)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import get_args

from airl_mav.profiles.px4_release import (
    CURRENT,
    ParameterSpec,
    Px4Release,
    PX4ReleaseName,
    px4_release,
)
from firmware_sim.addons.ground_station_services.component_metadata import all_definitions
from firmware_sim.autopilot import prearm
from firmware_sim.autopilot.events.definition import Definition, FailsafeAction, words
from firmware_sim.autopilot.failsafes.failsafe_conditions import (
    Clear,
    Options,
    Takeover,
)
from firmware_sim.autopilot.failsafes.failsafe_table import (
    MODE_OF_ACTION,
    OFFBOARD_LOSS,
    TABLE,
    Row,
)
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.codec import dialect

ACTION_NAMES = {
    FailsafeAction.NONE: "nothing",
    FailsafeAction.WARN: "warn",
    FailsafeAction.FALLBACK_POSCTRL: "Position",
    FailsafeAction.FALLBACK_ALTCTRL: "Altitude",
    FailsafeAction.FALLBACK_STABILIZED: "Stabilized",
    FailsafeAction.HOLD: "Hold",
    FailsafeAction.RTL: "Return",
    FailsafeAction.LAND: "Land",
    FailsafeAction.DESCEND: "Descend",
    FailsafeAction.DISARM: "disarm",
    FailsafeAction.TERMINATE: "terminate",
}

_TAKEOVER = {
    Takeover.ALWAYS: "at once",
    Takeover.AUTO: "yes",
    Takeover.MODE_SWITCH: "by mode",
    Takeover.NEVER: "no",
}
_CLEAR = {
    Clear.WITH_CONDITION: "with its cause",
    Clear.ON_MODE_CHANGE: "by choosing a mode, or disarmed",
    Clear.NEVER: "never",
}


def failsafes() -> str:
    """Return the failsafes: condition, parameter, and action for each parameter value."""
    head = ("failsafe", "when", "action", "take over", "ends")
    return _table(head, (_failsafe(row) for row in TABLE))


def _failsafe(row: Row) -> Sequence[str]:
    shown = _shown(row)
    if row.parameter is None:
        action = ACTION_NAMES[row.answers[0].action]
    else:
        default = int(px4_release().spec_by_name[row.parameter].default)
        choices = ", ".join(
            _choice(value, options, default) for value, options in sorted(row.answers.items())
        )
        action = f"`{row.parameter}`: {choices}"
    related = ", ".join(_parameter(name) for name in row.related)
    when = f"{row.when} ({related})" if related else row.when
    if shown is None:
        return row.title, when, action, "–", "–"
    final = shown.action >= FailsafeAction.DISARM
    takeover = "no" if final else _TAKEOVER[shown.takeover]
    return row.title, when, action, takeover, _CLEAR[shown.clear]


def _shown(row: Row) -> Options | None:
    """Return the response listed with its end: the default, or the mildest active one."""
    # Prefer the default; else Return, else any active response.
    value = 0 if row.parameter is None else int(px4_release().spec_by_name[row.parameter].default)
    acting = [options for options in row.answers.values() if options.action > FailsafeAction.WARN]
    chosen = row.answers.get(value)
    if chosen is not None and chosen.action > FailsafeAction.WARN:
        return chosen
    returning = [options for options in acting if options.action is FailsafeAction.RTL]
    return next(iter(returning or acting), None)


def _choice(value: int, options: Options, default: int) -> str:
    text = f"{value} {ACTION_NAMES[options.action]}"
    return f"**{text}**" if value == default else text


def _parameter(name: str) -> str:
    spec = px4_release().spec_by_name[name]
    unit = f" {spec.unit}" if spec.unit else ""
    return f"`{name}` {spec.default:g}{unit}"


def offboard_loss() -> str:
    """Return the replacements of Offboard after setpoint loss."""
    default = int(px4_release().spec_by_name["COM_OBL_RC_ACT"].default)
    rows = (
        (f"**{value}**" if value == default else f"{value}", ACTION_NAMES[action])
        for value, action in OFFBOARD_LOSS.items()
    )
    return _table(("`COM_OBL_RC_ACT`", "action"), rows)


def fallbacks() -> str:
    """Return the chain of actions, each the replacement of the one before."""
    return " → ".join(ACTION_NAMES[action] for action in MODE_OF_ACTION)


def needs() -> str:
    """Return the requirements of each mode."""

    def words(mode: Mode) -> str:
        names = [need.name or "" for need in mode.spec.needs]
        return ", ".join(name.lower().replace("_", " ") for name in names)

    return _table(("mode", "needs"), ((mode.spec.title, words(mode)) for mode in Mode))


def checks() -> str:
    """Return the pre-arm checks in reporting order."""
    found = prearm.checks(CURRENT)
    rows = ((check.text, words(check.component), _told(check)) for check in found)
    return _table(("text", "component", "told"), rows)


def _told(check: prearm.PrearmCheck) -> str:
    if check.announced:
        return "by itself"
    return "by an event alone" if check.blocks is prearm.never else "when arming is refused"


RULES = {
    "fallback_needs_pilot": "without a pilot, `NAV_RCL_ACT` replaces a fallback to a piloted mode",
    "exceptions_cover_auto_modes": "`COM_RCL_EXCEPT` and `COM_DLL_EXCEPT` 2: all automatic modes",
    "gcs_loss_needs_arming": "a ground station's loss counts in an armed vehicle only",
    "takeover_needs_action": "a mode takes over from any active action",
    "delays_from": "lowest action that waits in Hold",
    "orbit_ends_at_once": "a failsafe turns Orbit into Hold at its beginning",
    "warning_has_text": "a warning has the text Failsafe activated",
}
"""Meaning of each rule in the table of releases."""


def releases() -> str:
    """Return what differs between the PX4 releases: parameters in use, failsafes, commands."""
    names: tuple[PX4ReleaseName, ...] = get_args(PX4ReleaseName)
    found = [px4_release(name) for name in names]
    specs = [{spec.current_name: spec for spec in release.specs} for release in found]
    used = sorted({spec.current_name for each in specs for spec in each.values() if spec.is_used})
    rows = [("source", *(release.source for release in found))]
    rows += [("parameters", *(str(len(release.specs)) for release in found))]
    for name in used:
        cells = [_cell(each.get(name), name) for each in specs]
        if len(set(cells)) > 1:
            rows.append((f"`{name}`", *cells))
    for rule, text in RULES.items():
        values = [getattr(release.failsafes, rule) for release in found]
        rows.append((text, *map(_rule, values)))
    unknown = [", ".join(_command(n) for n in sorted(each.unknown_commands)) for each in found]
    rows.append(("unsupported commands", *(text or "–" for text in unknown)))
    states = ("yes" if release.mission_state else "no" for release in found)
    rows.append(("a return completes a mission, and MISSION_CURRENT has its state", *states))
    events = {each.name: each for each in all_definitions()}
    names_of = (frozenset(each.events) | each.unknown_events for each in found)
    for name in sorted(frozenset().union(*names_of)):
        rows.append((f"`{name}`", *(_event(events[name], release) for release in found)))
    return _table(("", *names), rows)


def _event(event: Definition, release: Px4Release) -> str:
    """Return what a release sends for an event, by its name in the current one."""
    if event.name in release.unknown_events:
        return "–"
    change = release.events.get(event.name, {})
    checks = [
        c for c in prearm.checks(release.name) if c.event.name == change.get("name", event.name)
    ]
    text = change.get("text", checks[0].text if checks else event.message)
    severity = change.get("severity", checks[0].severity.name if checks else "").lower()
    details = [f"`{change['name']}`"] if "name" in change else []
    details += ["level by charge"] if "grades" in change else []
    if "needs" in change:
        details.append(f"modes with {change['needs'].split()[0].lower().replace('_', ' ')}")
    return ", ".join((f"{text} ({severity})" if severity else text, *details))


def _cell(spec: ParameterSpec | None, name: str) -> str:
    if spec is None:
        return "–"
    return f"{spec.default:g}" if spec.name == name else f"`{spec.name}` {spec.default:g}"


def _rule(value: bool | int) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ACTION_NAMES[FailsafeAction(value)]


def _command(number: int) -> str:
    name: str = dialect.enums["MAV_CMD"][number].name
    return name.removeprefix("MAV_CMD_")


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
