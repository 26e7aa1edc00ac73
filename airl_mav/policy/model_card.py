"""Model card of a policy: a page as on model hubs.

Markdown with front matter in YAML (`library_name`, `tags`, `model-index`), rendered only from
`card.json` and written beside it, so that both agree.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

from airl_mav.policy.action_sets import commands_vertical_speed
from airl_mav.policy.card import MeasuredResult, PolicyCard

MODEL_CARD_FILE = "README.md"

MARK = "<!-- Written from card.json by airl-mav, and again whenever a result is added to it. -->"
"""Mark of a generated page. Pages without it are never overwritten."""

TASK = "reinforcement-learning"
ENVIRONMENT = "airl/Navigation-v0"

QUALITIES = (
    ("success_rate", "success rate", "{:.1%}"),
    ("flight_time_s", "flight time [s]", "{:.2f} s"),
    ("distance_m", "distance flown [m]", "{:.1f} m"),
    ("energy_j", "energy drawn [J]", "{:.0f} J"),
)
"""Fields of a result, their names and table formats."""


def model_card(card: PolicyCard) -> str:
    """Return the model card of a policy."""
    return "\n".join([*_front_matter(card), "", MARK, "", *_page(card), ""])


def _front_matter(card: PolicyCard) -> Iterator[str]:
    """Yield the lines for a hub. Texts are quoted as JSON, which is also YAML."""
    tags = [TASK, "deep-reinforcement-learning", "drones", "onnx", ENVIRONMENT]
    yield from ("---", "library_name: airl-mav", f"pipeline_tag: {TASK}", "tags:")
    for tag in [*tags, card.algorithm] if card.algorithm else tags:
        yield f"- {json.dumps(tag)}"
    if card.results:
        yield from ("model-index:", f"- name: {json.dumps(card.name)}", "  results:")
    for result in card.results:
        yield from ("  - task:", f"      type: {TASK}", "      name: navigation")
        yield from ("    dataset:", f"      name: {json.dumps(_conditions(result))}")
        yield from (f"      type: {ENVIRONMENT}", "    metrics:")
        for field, name, _ in QUALITIES:
            if (value := getattr(result, field)) is not None:
                yield from (f"    - type: {field}", f"      value: {round(value, 4)}")
                yield f"      name: {json.dumps(name)}"
    yield "---"


def _page(card: PolicyCard) -> Iterator[str]:
    """Yield the lines for readers."""
    seen, actions, training = card.observation, card.actions, card.training
    yield f"# {card.name}"
    yield ""
    if description := " ".join(card.description.split()).rstrip("."):
        yield from (f"{description[0].upper()}{description[1:]}.", "")
    yield from ("A policy of airl-mav that flies a quadcopter to a goal. In this folder:", "")
    # A network that needs the goal's height cannot fly without one, as in the default arena.
    where = f" --arena {training.arena}" if seen.goal_height and training.arena else ""
    flown = f"airl-sitl --policy .{where}", f"airl evaluate .{where} --episodes 100"
    yield from ("```sh", *flown, "```", "")
    yield from ("| | |", "|---|---|")
    image = f"{seen.kind} image"
    image = image if seen.projection == "pinhole" else f"{seen.projection} {image}"
    far = f", up to {seen.range_m:g} m" if seen.kind == "depth" else ""
    high = " with its height" if seen.goal_height else ""
    others = "".join(
        f"; camera `{name}`: {each.kind} image of {each.width_px}x{each.height_px} px"
        for name, each in seen.cameras.items()
    )
    yield (
        f"| sees | {image} of {seen.width_px}x{seen.height_px} px, {seen.horizontal_fov_deg:g} "
        f"deg wide{far}{others}; own velocity; goal{high} (layout `{seen.layout}`) |"
    )
    if actions.commands == "velocity":
        yield f"| decides | `{actions.set}`, up to {actions.max_speed_m_s:.3g} m/s |"
    else:
        yield f"| is told | {', '.join(seen.in_flight)} |"
        yield f"| decides | `{actions.set}`, up to {actions.max_rate_deg_s:g} deg/s, and a thrust |"
    if actions.commands == "velocity" or card.decisions == "sequential":
        yield f"| holds each action | {card.hold_s:g} s |"
    holds_altitude = actions.commands == "velocity" and not commands_vertical_speed(actions)
    flies = "flies" if holds_altitude else "begins"
    yield f"| {flies} at | {card.altitude_m:g} m, to within {card.goal_radius_m:g} m of the goal |"
    yield f"| network | {' '.join(card.network.split())} |"
    yield f"| size | {card.parameters:,} parameters, {card.macs:,} multiply-accumulates |"
    if card.algorithm:
        yield f"| algorithm | {card.algorithm} |"
    if training.arena is not None:
        yield f"| trained in | {training.arena} |"
    if training.env_steps is not None:
        yield f"| trained for | {training.env_steps:,} decisions |"
    if training.command is not None:
        yield f"| made by | `{training.command}` |"
    yield f"| SHA-256 of the network | `{card.sha256}` |"
    if not card.results:
        return
    yield from ("", "## Results", "", "Means over the flights that reached the goal.", "")
    yield "| flown | flights | success | flight time | distance | energy |"
    yield "|---|---|---|---|---|---|"
    for result in card.results:
        values = [(getattr(result, field), shown) for field, _, shown in QUALITIES]
        cells = ["-" if value is None else shown.format(value) for value, shown in values]
        yield f"| {_conditions(result)} | {result.episodes} | {' | '.join(cells)} |"


def _conditions(result: MeasuredResult) -> str:
    """Return the conditions of a result as one line."""
    late = "" if result.latency is None else f", latency {result.latency}"
    last = result.seed + result.episodes - 1
    return f"arena {result.arena}, level {result.level}{late}, seeds {result.seed} to {last}"
