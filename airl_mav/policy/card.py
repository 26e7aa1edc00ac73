"""Policy card: inputs, outputs, training and measured quality of a policy file; its runtimes.

A policy is a folder with `policy.onnx` and `card.json`. The card contains the file's SHA-256
digest, which binds the card to this file.

Runtimes are ONNX Runtime, or torch if installed. Both are imported only when a network is opened: a
classical policy needs neither. A network with memory takes its memory as additional inputs, and
returns the next memory as additional outputs, whose names begin with `next_`. A runtime is
stateless: one serves any number of flights.
"""

from __future__ import annotations

import hashlib
import io
import json
import threading
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, model_validator

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.child_process import run_limited
from airl_mav.core.compiling import writable_folder
from airl_mav.core.constants import Level
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, optional, quantity, switch, validated
from airl_mav.core.files import read_json, read_limited
from airl_mav.policy.actions import (
    ACTION_SETS,
    ActionSpec,
    DecisionTiming,
    continuous_numbers,
    discrete_actions,
)
from airl_mav.policy.layouts import LAYOUTS, boxes, layout_of
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch, further_mismatch
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.loading import profiles_dir

SCHEMA = 1
"""Version of the card's fields."""

CARD_FILE = "card.json"
ONNX_FILE = "policy.onnx"
TORCH_FILE = "policy.pt2"
"""Optional copy of the network as a torch program (`torch.export`)."""

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Strict()]


class Training(ProfileModel):
    """Training of a policy; unknown for some external policies."""

    arena: str | None = optional("arena profile it was trained in")
    first_arena_seed: Count | None = optional("first seed of the arenas")
    last_arena_seed: Count | None = optional("last seed of the arenas")
    seed: Count | None = optional("seed of the training")
    env_steps: int | None = quantity("decisions it was trained on", "1", ge=0, default=None)
    config_file: str | None = optional("name of the training's settings")
    config: dict[str, Any] = Field(default_factory=dict, description="the settings in full")
    command: str | None = optional("command that made the policy")
    versions: dict[str, str] = Field(default_factory=dict, description="packages by name")
    date_utc: str | None = optional("when it was exported, ISO 8601")


class MeasuredResult(ProfileModel):
    """Measured quality over a set of episodes; medians over the successful ones."""

    arena: str = Field(description="arena profile")
    level: Level = Field(description="fidelity level")
    latency: str | None = optional(
        "source of t2 as --latency takes it; none: as fast as a desktop computer"
    )
    episodes: int = quantity("episodes flown", "1", ge=1)
    seed: Count = Field(description="seed of the first episode; each has the next")
    success_rate: float = quantity("share of episodes that reached the goal", "1", ge=0, le=1)
    success_low: float | None = quantity(
        "lower end of its 95 % interval (Wilson)", "1", ge=0, le=1, default=None
    )
    success_high: float | None = quantity(
        "upper end of its 95 % interval (Wilson)", "1", ge=0, le=1, default=None
    )
    flight_time_s: float | None = quantity("flight time", "s", ge=0, default=None)
    distance_m: float | None = quantity("distance flown", "m", ge=0, default=None)
    energy_j: float | None = quantity("energy drawn", "J", ge=0, default=None)
    flown_utc: str | None = optional("when it was flown, ISO 8601")
    behaviour: str | None = optional("fingerprint of the flight behaviour that it was flown with")

    @classmethod
    def of(cls, quality: Any, **conditions: Any) -> MeasuredResult:
        """Return a result with the figures of a quality; `conditions` are the other fields.

        `quality` is a `flight.statistics.Aggregate`, or a published run with the same estimates.
        """
        rate = quality.success_rate
        return cls(
            episodes=rate.n,
            success_rate=rate.value or 0.0,
            success_low=rate.low,
            success_high=rate.high,
            flight_time_s=quality.flight_time_s.value,
            distance_m=quality.distance_m.value,
            energy_j=quality.energy_j.value,
            **conditions,
        )


WEAK = 0.9
"""Success rate below which a policy should not fly in an arena."""


def weak_arenas(results: Sequence[MeasuredResult]) -> dict[str, float]:
    """Return the success rates below `WEAK`, by arena, without an injected latency."""
    plain = {each.arena: each.success_rate for each in results if each.latency is None}
    return {arena: rate for arena, rate in plain.items() if rate < WEAK}


class PolicyFacts(ProfileModel):
    """Metadata of a policy from its author: all fields that the file does not contain."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$",
        description="short name: letters, digits, '.', '_', '-'",
    )
    description: str = Field(default="", description="one line for people")
    observation: ObservationSpec
    actions: ActionSpec = Field(default_factory=ActionSpec)
    hold_s: float = quantity("t3: how long each action is held", "s", ge=0, le=10)
    goal_radius_m: float = quantity("radius of the goal in training", "m", ge=0.2, le=50)
    altitude_m: float = quantity("height above the start", "m", ge=0.5, le=100)
    hover_after_s: float | None = quantity(
        "the vehicle hovers when a command is this old; none: the last one keeps flying",
        "s",
        ge=0,
        le=60,
        default=None,
    )
    decision_timeout_s: float | None = quantity(
        "a decision is overdue so long after the last one; none: as the companion has it by"
        " default",
        "s",
        ge=0.1,
        le=60,
        default=None,
        later=True,
    )
    decisions: DecisionTiming = Field(
        default="sequential", description="when a decision begins; see airl_mav.scenario.model"
    )
    compensate: bool = switch("it wants its decision latency compensated, as in training")
    algorithm: str = Field(default="", description="training algorithm")
    epsilon: float = quantity("share of random actions in flight", "1", ge=0, le=1, default=0.0)
    training: Training = Field(default_factory=Training)
    results: tuple[MeasuredResult, ...] = Field(default=(), description="how well it flies")

    @model_validator(mode="after")
    def _random_actions_are_discrete(self) -> PolicyFacts:
        # Custom sets are not loaded: reading a card runs no code.
        known = ACTION_SETS.get(self.actions.set)
        if self.epsilon and known is not None and known.discrete is None:
            raise ValueError(
                f"epsilon = {self.epsilon:g}: accepted: 0 with the action set {self.actions.set!r}"
            )
        return self


class Quantisation(ProfileModel):
    """Conversion of a network from floats to 8-bit integers."""

    method: str = Field(description="quantised parts, and the method for the ranges")
    source_sha256: Digest = Field(description=f"SHA-256 digest of the {ONNX_FILE} in floats")
    arena: str = Field(description="arena profile of the calibration's frames")
    first_seed: Count = Field(description="first seed of those flights; no evaluation uses it")
    last_seed: Count = Field(description="last seed of those flights")
    frames: int = quantity("frames that the ranges come from", "1", ge=1)
    checked: int = quantity("other frames on which both were compared", "1", ge=1)
    agreement: float | None = quantity(
        "share of those on which both choose the same action; none: continuous actions",
        "1",
        ge=0,
        le=1,
        default=None,
    )
    error: float = quantity(
        "root mean square of the difference of the outputs, in shares of their spread", "1", ge=0
    )


class PolicyCard(PolicyFacts):
    """Complete policy card."""

    sha256: Digest = Field(description=f"SHA-256 digest of {ONNX_FILE}")
    torch_sha256: Digest | None = optional(f"SHA-256 digest of {TORCH_FILE}, if there is one")
    state: dict[str, tuple[Count, ...]] = Field(
        default_factory=dict,
        description="memory of a recurrent network: shapes by name; input NAME, output next_NAME,"
        " zeros at the start of a flight",
    )
    network: str = Field(description="its layers, as text")
    parameters: int = quantity("weights and biases", "1", ge=1)
    macs: int = quantity("multiply-accumulates of one inference", "1", ge=1)
    quantisation: Quantisation | None = optional(
        "of a network in 8-bit integers; none: one in floats"
    )


def digest(data: bytes) -> str:
    """Return the SHA-256 of a file's bytes as in a card."""
    return hashlib.sha256(data).hexdigest()


def read_card(folder: Path) -> PolicyCard:
    """Read the card of a policy without the network. Raises UsageError."""
    path = folder / CARD_FILE
    data = read_json(path, SCHEMA, "policy")
    del data["schema"]
    return validated(PolicyCard, data, path)


def read_model(folder: Path, card: PolicyCard) -> bytes:
    """Return the network of a card. Raises UsageError if the digest differs."""
    return _read_bound(folder / ONNX_FILE, card.sha256)


def read_torch_program(folder: Path, card: PolicyCard) -> bytes:
    """Return the torch program of a card. Raises UsageError if missing or the digest differs."""
    if card.torch_sha256 is None:
        raise UsageError(
            f"{folder / TORCH_FILE}: the card names none; export the policy with --with-torch"
        )
    return _read_bound(folder / TORCH_FILE, card.torch_sha256)


def load_card(folder: Path, *, trust: bool = False) -> PolicyCard:
    """Read the card of a policy and check the policy against it.

    Raises UsageError as `read_card`, and if the digest, inputs or outputs of the file differ from
    the card, or the card names untrusted code.
    """
    card = read_card(folder)
    open_model(folder, card, trust=trust)
    return card


def check_trust(folder: Path, card: PolicyCard, *, trust: bool) -> None:
    """Raise UsageError for a card that names code, unless its author is trusted.

    Cards of this package name no code.
    """
    named = {"actions.set": card.actions.set} if card.actions.set not in ACTION_SETS else {}
    if card.observation.layout not in LAYOUTS:
        named["observation.layout"] = card.observation.layout
    if named and not trust:
        listed = ", ".join(f"{field} = {name!r}" for field, name in named.items())
        raise UsageError(
            f"{folder / CARD_FILE}: {listed} is code that would run on this machine; accepted: with"
            " --trust, if you trust its maker"
        )


def open_model(
    folder: Path, card: PolicyCard, threads: int = 1, *, trust: bool = False
) -> OnnxRuntime:
    """Return the policy of a card, ready for inference. Raises UsageError as `load_card`.

    The model of a foreign folder runs in a child process with limits first.
    """
    check_trust(folder, card, trust=trust)
    model = read_model(folder, card)
    try:
        if not is_shipped(folder):
            _try_limited(model, card)
        return OnnxRuntime(model, card.observation, card.actions, threads, card.state)
    except ValueError as error:
        raise UsageError(f"{folder / ONNX_FILE}: {error}") from None


def is_shipped(folder: Path) -> bool:
    """Return True for a policy of this package."""
    return folder.resolve().is_relative_to((profiles_dir() / "policies").resolve())


def vehicle_mismatch(
    card: PolicyCard, camera: Camera, further: Mapping[str, Camera] | None = None
) -> str | None:
    """Return why a vehicle's cameras cannot serve a policy, or None; `further` are by name."""
    seen, others = card.observation, further or {}
    lenses = {name: Intrinsics.of(each) for name, each in others.items()}
    if (reason := further_mismatch(seen, lenses)) is not None:
        return reason
    if layout_of(seen.layout).looks_ahead and camera.yaw_deg != 0.0:
        return f"camera with yaw_deg = {camera.yaw_deg:g}; accepted: 0 with layout {seen.layout!r}"
    for name, each in seen.cameras.items():
        if each.kind == "depth" and others[name].range_m < each.range_m:
            return (
                f"camera {name!r} with a range of {others[name].range_m:g} m;"
                f" accepted: {each.range_m:g} m or more"
            )
    if (reason := camera_mismatch(card.observation, Intrinsics.of(camera))) is not None:
        return reason
    # Objects beyond the camera's range would look free, unlike in training. Colour has no range.
    if camera.kind == "depth" and camera.range_m < card.observation.range_m:
        return (
            f"camera with a range of {camera.range_m:g} m; "
            f"accepted: {card.observation.range_m:g} m or more"
        )
    return None


def _read_bound(path: Path, sha256: str) -> bytes:
    """Return a file's bytes if they match the digest. Raises UsageError."""
    data = read_limited(path, "a network", MODEL_BYTES, links=False)
    if (found := digest(data)) != sha256:
        raise UsageError(
            f"{path}: SHA-256 {found[:12]}...; accepted: {sha256[:12]}..., that of {CARD_FILE}"
        )
    return data


MODEL_BYTES = 256 << 20
"""Maximum size of a network's file."""

RuntimeName = Literal["onnx", "torch"]

ACTION = "action"
"""Name of the action output, the only output of a network without memory."""

NEXT = "next_"
"""Prefix of a memory's output; the rest is the name of its input."""

Shapes = Mapping[str, tuple[int, ...]]
"""Memory of a network: the shape of each array by name, without the leading axis."""

Memory = dict[str, NDArray[np.float32]]
"""Memory of n flights: arrays of n rows by name."""

_FATAL_ONLY = 4
"""ONNX Runtime's log severity "fatal": errors are exceptions."""

_ONNX_TYPES: dict[type[np.generic], str] = {
    np.uint8: "tensor(uint8)",
    np.float32: "tensor(float)",
}


class Runtime:
    """A network ready for inference; base class."""

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs (n, k) for the arrays of a layout, each with n rows; next memory."""
        raise NotImplementedError(f"{type(self).__name__} runs no network with a memory")

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs (n, k) of a network without memory."""
        return self.step(encoded, {})[0]


def blank_memory(shapes: Shapes, n: int) -> Memory:
    """Return the memory of n flights before their first decision: zeros."""
    return {name: np.zeros((n, *shape), np.float32) for name, shape in shapes.items()}


def outputs_of(actions: ActionSpec) -> int:
    """Return the number of outputs: a score for each discrete action, or the action itself."""
    return discrete_actions(actions) or continuous_numbers(actions)


class OnnxRuntime(Runtime):
    """A network in ONNX Runtime, on the CPU."""

    def __init__(
        self,
        model: bytes,
        observation: ObservationSpec,
        actions: ActionSpec,
        threads: int = 1,
        state: Shapes | None = None,
    ) -> None:
        """Open the bytes of an .onnx file with weights. Small networks need one thread.

        The network must take the observation, return the actions, and keep `state` between
        decisions; None = no memory. Raises ValueError if it is not ONNX, or inputs or outputs
        differ.
        """
        self._session = _open_session(model, threads)
        self._state = tuple(state or {})
        self._names = [ACTION, *(f"{NEXT}{name}" for name in self._state)]
        _check_signature(self._session, *_signatures(observation, actions, state or {}))

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs and the next memory; see `Runtime`.

        Raises TimeoutError after `INFERENCE_S` per row.
        """
        inputs = {**encoded, **memory}
        found, *after = _run(self._session, self._names, inputs)
        return found, dict(zip(self._state, after, strict=True))


def _open_session(model: bytes, threads: int) -> Any:
    """Return a session for the bytes of an .onnx file. Raises ValueError if it is not ONNX."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(_FATAL_ONLY)
    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY
    # A spinning thread must not take a core from telemetry.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors share no other base class.
        raise ValueError(f"not a model that ONNX Runtime loads: {first_line(error)}") from None


class TorchRuntime(Runtime):
    """A network as a torch program (`torch.export`), on the CPU."""

    def __init__(
        self,
        program: bytes,
        observation: ObservationSpec,
        threads: int = 1,
        state: Shapes | None = None,
    ) -> None:
        """Open the bytes of a .pt2 file; `threads` applies to the whole process.

        `state` is the memory between decisions; None = no memory. Raises ValueError if torch is not
        installed, or cannot load the program.
        """
        try:
            import torch
        except ImportError:
            raise ValueError("torch is not installed; pip install 'airl-mav[train]'") from None
        torch.set_num_threads(threads)
        try:
            self._module = torch.export.load(io.BytesIO(program)).module()
        except Exception as error:  # Any type, from a bad archive to an unknown operator.
            raise ValueError(f"not a program that torch loads: {first_line(error)}") from None
        self._torch = torch
        self._keys, self._state = tuple(boxes(observation)), tuple(state or {})

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs and the next memory; see `Runtime`."""
        with self._torch.inference_mode():
            tensors = self._tensors(encoded, self._keys) + self._tensors(memory, self._state)
            outputs = self._module(*tensors)
            outputs = outputs if isinstance(outputs, tuple) else (outputs,)
            found, *after = (each.numpy() for each in outputs)
        return found, dict(zip(self._state, after, strict=True))

    def _tensors(self, arrays: Mapping[str, NDArray[Any]], keys: tuple[str, ...]) -> list[Any]:
        return [self._torch.from_numpy(np.ascontiguousarray(arrays[key])) for key in keys]


INFERENCE_S = 10.0
"""Maximum duration of an inference, for each row of its inputs [wall s]."""

_running: dict[int, list[Any]] = {}
"""Inferences in progress by the id of their options: ONNX Runtime's options, remaining time [s]."""


def _run(session: Any, names: list[str], inputs: Mapping[str, NDArray[Any]]) -> list[Any]:
    """Return the outputs of a session. Raises TimeoutError for an inference that does not end."""
    import onnxruntime

    _terminator()
    options = onnxruntime.RunOptions()
    _running[id(options)] = [options, INFERENCE_S * len(next(iter(inputs.values())))]
    try:
        outputs: list[Any] = session.run(names, inputs, options)
    except Exception:
        if options.terminate:
            raise TimeoutError(f"no output in {INFERENCE_S:g} s per observation") from None
        raise
    finally:
        del _running[id(options)]
    return outputs


@cache
def _terminator() -> None:
    """Start the thread that terminates inferences after their time."""

    def watch() -> None:
        never = threading.Event()
        while not never.wait(1.0):
            for each in list(_running.values()):
                each[1] -= 1.0
                each[0].terminate = each[1] < 0.0

    threading.Thread(target=watch, name="inference limit", daemon=True).start()


# --- trials of foreign models

Signature = Mapping[str, tuple[str, tuple[int, ...]]]
"""Arrays by name: ONNX type, and shape without the leading axis."""

TRIAL_BYTES, COPIES = 1 << 30, 6
"""Maximum address space of a trial, of which ONNX Runtime takes 150 MB, and copies of the model."""

TRIAL_S = 20.0
"""Timeout of a trial, with the start of the child [wall s]."""


def _try_limited(model: bytes, card: PolicyCard) -> None:
    """Raise ValueError for a model that fails in a child process with limits.

    Passed trials are recorded, and not repeated.
    """
    arrays = json.dumps(_signatures(card.observation, card.actions, card.state)).encode()
    folder = writable_folder("trials")
    record = None if folder is None else folder / digest(card.sha256.encode() + arrays)
    if record is not None and record.exists():
        return
    memory = TRIAL_BYTES + COPIES * len(model)
    try:
        found = run_limited(f"{__name__}:try_model", b"%b\n%b" % (arrays, model), memory, TRIAL_S)
    except ValueError as error:
        found = f"its inference {error}"
    if found:
        raise ValueError(found)
    if record is not None:
        record.touch()


def try_model(data: bytes) -> str:
    """Return why a model fails on two observations, all zeros and all ones; "" if it does not.

    `data` are the signatures of inputs and outputs in a line of JSON, and the bytes of the model.
    """
    arrays, _, model = data.partition(b"\n")
    takes, gives = json.loads(arrays)
    types = {name: dtype for dtype, name in _ONNX_TYPES.items()}
    try:
        session = _open_session(model, 1)
        _check_signature(session, takes, gives)
        inputs = {
            name: np.stack([make(shape, types[kind]) for make in (np.zeros, np.ones)])
            for name, (kind, shape) in takes.items()
        }
        outputs = _run(session, list(gives), inputs)
    except ValueError as error:
        return str(error)
    except Exception as error:
        return f"its inference fails: {type(error).__name__}: {first_line(error)}"
    for (name, (_, shape)), output in zip(gives.items(), outputs, strict=True):
        if output.shape != (2, *shape):
            return f"output {name} {output.shape}; accepted: {(2, *shape)}"
    return "its output is not a number" if np.isnan(outputs[0]).any(axis=1).all() else ""


def _check_signature(session: Any, takes: Signature, gives: Signature) -> None:
    """Raise ValueError if a session's inputs or outputs differ from the signatures of its card."""
    _compare("inputs", session.get_inputs(), takes)
    _compare("outputs", session.get_outputs(), gives)


def _signatures(
    observation: ObservationSpec, actions: ActionSpec, state: Shapes
) -> tuple[Signature, Signature]:
    """Return the signatures of a network's inputs and outputs."""
    takes = {name: (_ONNX_TYPES[box.dtype], box.shape) for name, box in boxes(observation).items()}
    gives: dict[str, tuple[str, tuple[int, ...]]] = {
        ACTION: (_ONNX_TYPES[np.float32], (outputs_of(actions),))
    }
    for name, shape in state.items():
        takes[name] = gives[f"{NEXT}{name}"] = _ONNX_TYPES[np.float32], shape
    return takes, gives


def _compare(what: str, nodes: list[Any], wanted: Signature) -> None:
    """Compare inputs or outputs by name, type and shape; the first axis must be free."""
    found = {node.name: (node.type, tuple(node.shape)) for node in nodes}
    fits = found.keys() == wanted.keys() and all(
        found[name][0] == kind
        and found[name][1][1:] == tuple(shape)
        and not isinstance(found[name][1][0], int)
        for name, (kind, shape) in wanted.items()
    )
    if not fits:
        accepted = {name: (kind, ("n", *shape)) for name, (kind, shape) in wanted.items()}
        raise ValueError(f"{what} {_signature(found)}; accepted: {_signature(accepted)}")


def _signature(nodes: Mapping[str, tuple[str, tuple[Any, ...]]]) -> str:
    return ", ".join(
        f"{name} {kind} ({', '.join(str(axis) for axis in shape)})"
        for name, (kind, shape) in nodes.items()
    )


def first_line(error: Exception) -> str:
    """Return the first line of an error."""
    return (str(error) or type(error).__name__).splitlines()[0]
