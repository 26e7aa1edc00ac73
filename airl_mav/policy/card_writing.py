"""Writing policy cards, their pages for readers, and copies of policies with a changed card."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import replace_file, write_json
from airl_mav.policy.action_sets import commands_vertical_speed
from airl_mav.policy.card import (
    CARD_FILE,
    ONNX_FILE,
    SCHEMA,
    TORCH_FILE,
    MeasuredResult,
    PolicyCard,
    load_card,
    read_card,
    read_model,
    read_torch_program,
)

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
        yield from ("    dataset:", f"      name: {json.dumps(_model_conditions(result))}")
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
        yield f"| {_model_conditions(result)} | {result.episodes} | {' | '.join(cells)} |"


def _model_conditions(result: MeasuredResult) -> str:
    """Return the conditions of a result as one line."""
    late = "" if result.latency is None else f", latency {result.latency}"
    last = result.seed + result.episodes - 1
    return f"arena {result.arena}, level {result.level}{late}, seeds {result.seed} to {last}"


def write_card(folder: Path, card: PolicyCard) -> None:
    """Write the card into its policy's folder, atomically.

    The generated page `README.md` is written after the card, unless the folder has another page of
    this name. Raises UsageError if the folder contains another policy, or none.
    """
    read_model(folder, card)
    if card.torch_sha256 is not None:
        read_torch_program(folder, card)
    plain = {"schema": SCHEMA, **card.model_dump(mode="json")}
    write_json(folder / CARD_FILE, plain)
    write_model_card(folder, card)


def write_model_card(folder: Path, card: PolicyCard) -> None:
    """Write the page of a card, unless the folder has a page that was not generated."""
    page = folder / MODEL_CARD_FILE
    if not page.exists() or MARK.encode() in page.read_bytes():
        replace_file(page, model_card(card).encode())


def add_result(folder: Path, result: MeasuredResult) -> PolicyCard:
    """Write a result to a card; replaces a result with the same arena, level and latency."""
    card = read_card(folder)
    others = [each for each in card.results if _conditions(each) != _conditions(result)]
    results = tuple(sorted([*others, result], key=_conditions))
    card = card.model_copy(update={"results": results})
    write_card(folder, card)
    return card


def _conditions(result: MeasuredResult) -> tuple[str, str, str]:
    return result.level, result.arena, result.latency or ""


def copy_policy(
    source: Path, out: Path, changes: dict[str, Any], *, trust: bool = False
) -> PolicyCard:
    """Copy a policy to another folder with changes to its card, and return the card.

    The source's results do not apply: the new card has none until it is evaluated. `trust` permits
    the source's author to run code on this machine. Raises UsageError if the policy cannot be used,
    a change is out of range, or `out` is the source or cannot be written.
    """
    card = load_card(source, trust=trust)
    if out.resolve() == source.resolve():
        raise UsageError(f"{out}: accepted: another folder than the policy's own")
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: not a folder")
    plain = card.model_dump(mode="json") | {"results": ()} | changes
    copied = validated(PolicyCard, plain)
    try:
        out.mkdir(parents=True, exist_ok=True)
        replace_file(out / ONNX_FILE, read_model(source, card))
        if card.torch_sha256 is not None:
            replace_file(out / TORCH_FILE, read_torch_program(source, card))
        write_card(out, copied)
        if card.torch_sha256 is None:
            (out / TORCH_FILE).unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror}") from None
    return copied
