"""Writing of policy folders: cards, pages for readers, copies with a changed card, random networks.

Random networks follow the paper's template, written as ONNX without torch: L convolutions of F
filters (3x3, stride 1, same padding), joined with velocity and goal, L dense layers of F units, a
score for each action (Krishnan et al., Air Learning, 2021). The inference time depends on the
layers' sizes, not on the weights.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import errors, fields, files
from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import (
    ACTION,
    CARD_FILE,
    ONNX_FILE,
    SCHEMA,
    TORCH_FILE,
    MeasuredResult,
    PolicyCard,
    PolicyFacts,
    digest,
    load_card,
    outputs_of,
    read_card,
    read_model,
    read_torch_program,
    weak_arenas,
)
from airl_mav.policy.layouts import GOAL, VELOCITY
from airl_mav.policy.observation_spec import ObservationSpec

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
    holds_altitude = actions.commands == "velocity" and not actions.vertical
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
    if weak := weak_arenas(card.results):
        listed = ", ".join(f"{arena} ({rate:.1%})" for arena, rate in weak.items())
        yield from ("", f"Do not fly it in: {listed}.")


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
    files.write_json(folder / CARD_FILE, plain)
    write_model_card(folder, card)


def write_model_card(folder: Path, card: PolicyCard) -> None:
    """Write the page of a card, unless the folder has a page that was not generated."""
    page = folder / MODEL_CARD_FILE
    if not page.exists() or MARK.encode() in page.read_bytes():
        files.replace_file(page, model_card(card).encode())


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
        raise errors.UsageError(f"{out}: accepted: another folder than the policy's own")
    if out.exists() and not out.is_dir():
        raise errors.UsageError(f"{out}: not a folder")
    plain = card.model_dump(mode="json") | {"results": ()} | changes
    copied = fields.validated(PolicyCard, plain)
    with errors.usage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        files.replace_file(out / ONNX_FILE, read_model(source, card))
        if card.torch_sha256 is not None:
            files.replace_file(out / TORCH_FILE, read_torch_program(source, card))
        write_card(out, copied)
        if card.torch_sha256 is None:
            (out / TORCH_FILE).unlink(missing_ok=True)
    return copied


OPSET = 18
IR_VERSION = 10
"""ONNX file format, supported since ONNX Runtime 1.18."""

KERNEL = 3
VECTOR_INPUTS = 6
"""Length of velocity and goal; one more with the goal's height."""
GREATEST_BYTES = 1_900_000_000
"""Maximum size of an .onnx file with weights, below the encoding's limit of 2 GiB."""


class NetworkSize(NamedTuple):
    """Size of a network."""

    parameters: int
    macs: int
    """Multiply-accumulates of one inference."""


def template_size(
    layers: int,
    filters: int,
    height_px: int,
    width_px: int,
    outputs: int,
    channels: int = 1,
    vector_inputs: int = VECTOR_INPUTS,
) -> NetworkSize:
    """Return the size of a network of the template; `channels` is the number of image channels."""
    pixels = height_px * width_px
    weights, biases, macs = 0, 0, 0
    for _ in range(layers):
        kernel = KERNEL * KERNEL * channels * filters
        weights, biases, macs = weights + kernel, biases + filters, macs + kernel * pixels
        channels = filters
    inputs = filters * pixels + vector_inputs
    for units in (*[filters] * layers, outputs):
        weights, biases, macs = weights + inputs * units, biases + units, macs + inputs * units
        inputs = units
    return NetworkSize(weights + biases, macs)


def write_template(
    folder: Path, layers: int, filters: int, facts: PolicyFacts, rng: np.random.Generator
) -> PolicyCard:
    """Write a random network of the template and its card to an existing folder.

    The network has `layers` >= 1 convolutions of `filters` filters, and as many dense layers.
    Raises UsageError if it is too large for one .onnx file.
    """
    spec, outputs = facts.observation, outputs_of(facts.actions)
    shape, vectors = spec.image_shape, _vector_inputs(spec)
    size = template_size(layers, filters, *shape, outputs, spec.channels, vectors)
    if 4 * size.parameters > GREATEST_BYTES:
        raise errors.UsageError(
            f"--network {layers}x{filters}: {size.parameters:,} parameters; accepted: at most "
            f"{GREATEST_BYTES // 4:,} (a smaller --image has fewer)"
        )
    model = build_template(layers, filters, spec, facts.actions, rng)
    files.replace_file(folder / ONNX_FILE, model)
    card = PolicyCard(
        **{name: getattr(facts, name) for name in PolicyFacts.model_fields},
        sha256=digest(model),
        network=f"{layers} x conv {filters} 3x3, {layers} x dense {filters}, dense {outputs}",
        parameters=size.parameters,
        macs=size.macs,
    )
    write_card(folder, card)
    return card


def _vector_inputs(spec: ObservationSpec) -> int:
    return VECTOR_INPUTS - 3 + spec.goal_numbers


def build_template(
    layers: int,
    filters: int,
    spec: ObservationSpec,
    actions: ActionSpec,
    rng: np.random.Generator,
) -> bytes:
    """Return a random network of the template as the bytes of an .onnx file.

    Weights are He-initialized (normal, variance 2 / inputs), so that signals keep their scale.
    """
    # Imported late: only the [profile] and [train] extras install it.
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    weights: list[Any] = []

    def add(name: str, values: NDArray[np.float32]) -> str:
        weights.append(numpy_helper.from_array(values, name))
        return name

    def random(name: str, shape: tuple[int, ...]) -> str:
        scale = np.float32(np.sqrt(2.0 / np.prod(shape[1:])))
        return add(name, rng.standard_normal(shape, np.float32) * scale)

    def zeros(name: str, count: int) -> str:
        return add(name, np.zeros(count, np.float32))

    def node(operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    full = add("full_scale", np.array(255.0, np.float32))
    x = node("Div", [node("Cast", [spec.kind], "pixels", to=TensorProto.FLOAT), full], "image")
    channels = spec.channels
    for k in range(layers):
        kernel = random(f"conv{k}.weight", (filters, channels, KERNEL, KERNEL))
        x = node(
            "Conv",
            [x, kernel, zeros(f"conv{k}.bias", filters)],
            f"conv{k}",
            kernel_shape=[KERNEL, KERNEL],
            pads=[KERNEL // 2] * 4,
        )
        x = node("Relu", [x], f"conv{k}.relu")
        channels = filters
    flat = node("Flatten", [x], "flat", axis=1)
    x = node("Concat", [flat, VELOCITY, GOAL], "joined", axis=1)
    inputs = filters * math.prod(spec.image_shape) + _vector_inputs(spec)
    for k in range(layers):
        dense = [x, random(f"dense{k}.weight", (filters, inputs)), zeros(f"dense{k}.bias", filters)]
        x = node("Relu", [node("Gemm", dense, f"dense{k}", transB=1)], f"dense{k}.relu")
        inputs = filters
    outputs = outputs_of(actions)
    last = [x, random("score.weight", (outputs, inputs)), zeros("score.bias", outputs)]
    node("Gemm", last, ACTION, transB=1)
    image = ["n", spec.channels, *spec.image_shape]
    graph = helper.make_graph(
        nodes,
        "template",
        [
            helper.make_tensor_value_info(spec.kind, TensorProto.UINT8, image),
            helper.make_tensor_value_info(VELOCITY, TensorProto.FLOAT, ["n", 3]),
            helper.make_tensor_value_info(GOAL, TensorProto.FLOAT, ["n", spec.goal_numbers]),
        ],
        [helper.make_tensor_value_info(ACTION, TensorProto.FLOAT, ["n", outputs])],
        weights,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString(deterministic=True)
    return data
