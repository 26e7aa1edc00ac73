"""Quantization of a policy to 8-bit integers: calibration frames, comparison, and card."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError, usage_errors
from airl_mav.core.files import replace_file, scratch_folder
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.evaluation import LearnedPilots, fly_seeds
from airl_mav.experiments import gym_flier, hardware_gap
from airl_mav.policy.actions import discrete_actions
from airl_mav.policy.card import (
    ONNX_FILE,
    TORCH_FILE,
    OnnxRuntime,
    PolicyCard,
    Quantisation,
    digest,
    first_line,
    load_card,
    open_model,
    read_model,
)
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import Encoded
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.scenario.checks import action_generator
from airl_mav.scenario.model import DEFAULT_ARENA, Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.config import check_seeds

METHOD = (
    "static, QDQ: activations uint8, weights int8 by channel, ranges by least and greatest value; "
    "the last layer in floats"
)
"""Description of the method in a card."""

_DENSE = ("Gemm", "MatMul")
"""Operators of dense layers."""


def quantised(model: bytes, frames: Encoded) -> bytes:
    """Return a network with convolutions and dense layers in 8-bit integers.

    Inputs and outputs are unchanged. The last dense layer is small and stays in floats. With
    integers, close scores would change their order. The graph has a pair of QuantizeLinear and
    DequantizeLinear around each tensor (QDQ). ONNX Runtime fuses them on processors with integer
    kernels.

    `model` is an .onnx file with its weights. The rows of `frames` calibrate the ranges. Raises
    UsageError if onnx is not installed or cannot quantise the network.
    """
    try:
        import onnx
        from onnxruntime import quantization
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError:
        raise UsageError("onnx is not installed; pip install 'airl-mav[profile]'") from None

    class Rows(quantization.CalibrationDataReader):  # type: ignore[misc] # untyped
        """Reader of one frame at a time, for minimum memory."""

        rows = _rows(frames)

        def get_next(self) -> Mapping[str, NDArray[Any]] | None:
            return next(self.rows, None)

    with scratch_folder("airl-int8-") as scratch, _quiet():
        floats, shaped, written = (scratch / f"{n}.onnx" for n in ("floats", "shaped", "int8"))
        floats.write_bytes(model)
        try:
            quant_pre_process(floats, shaped, skip_symbolic_shape=True)
            dense = [node.name for node in onnx.load(shaped).graph.node if node.op_type in _DENSE]
            quantization.quantize_static(
                shaped,
                written,
                Rows(),
                quant_format=quantization.QuantFormat.QDQ,
                activation_type=quantization.QuantType.QUInt8,
                weight_type=quantization.QuantType.QInt8,
                per_channel=True,
                # Weights of seven bits. On x86-64 without VNNI, ONNX Runtime adds pairs of products
                # of 8-bit numbers in 16 bits, which overflow and change decisions (ONNX Runtime's
                # documentation of quantisation, "Why did I see saturation").
                reduce_range=True,
                nodes_to_exclude=dense[-1:],
                calibrate_method=quantization.CalibrationMethod.MinMax,
            )
            data: bytes = onnx.load(written).SerializeToString(deterministic=True)
        except Exception as error:  # Any type, from an unknown operator to a broken model.
            raise UsageError(f"the network cannot be quantised: {first_line(error)}") from error
    return data


def relative_error(found: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    """Return the root mean square error of outputs (n, k), in shares of their spread.

    The spread is the standard deviation of `wanted`. The error is infinite if constant outputs
    differ.
    """
    away = float(np.sqrt(np.mean((found - wanted) ** 2)))
    spread = float(wanted.std())
    return away / spread if spread else (np.inf if away else 0.0)


def _rows(frames: Encoded) -> Iterator[Mapping[str, NDArray[Any]]]:
    for i in range(len(next(iter(frames.values())))):
        yield {key: array[i : i + 1] for key, array in frames.items()}


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the tool's warnings about models without preprocessing."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


FIRST_SEED = 800_000
"""First seed of calibration flights; for other seeds see `training.config`."""

FLIGHTS = 200
FRAMES, CHECKED = 512, 512
"""Numbers of random frames for calibration of the ranges, and for the comparison."""


@dataclass
class _Witness:
    """Pilots of all vehicles with one network, recording its inputs. Implements `Pilots`."""

    pilots: LearnedPilots
    seen: list[Encoded] = field(default_factory=list)

    @property
    def failed(self) -> Mapping[int, str]:
        return self.pilots.failed

    def begin(self, slot: int, seed: int) -> None:
        self.pilots.begin(slot, seed)

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        decided = self.pilots.decide(seen, flying)
        encoded = self.pilots.encoded
        self.seen.append({key: array[flying].copy() for key, array in encoded.items()})
        return decided


def frames_of(folder: Path, *, flights: int = FLIGHTS) -> tuple[Encoded, str, int]:
    """Return inputs of a policy on reserved seeds, its training arena, and the last seed."""
    check_seeds(FIRST_SEED, flights)
    card = load_card(folder)
    arena = card.training.arena or DEFAULT_ARENA
    environment = hardware_gap.training_environment(card) or {}
    asked: dict[str, Any] = {"arena": arena, "seed": FIRST_SEED, "episodes": flights}
    if "vehicle" in environment:
        # The vehicle's camera fits the network.
        asked["vehicle"] = environment["vehicle"]
    scenario = resolve(Scenario(level="gym", policy=str(folder), **asked))
    loaded = scenario.fresh_policy(FIRST_SEED)
    assert isinstance(loaded, LearnedPolicy)  # noqa: S101 (it has a card)
    witness = _Witness(LearnedPilots(loaded, action_generator))
    navigation = gym_flier.navigation_of(scenario, min(scenario.scenario.slots, flights))
    for _ in fly_seeds(navigation, witness, list(scenario.seeds)):
        pass
    keys = witness.seen[0]
    frames = {key: np.concatenate([each[key] for each in witness.seen]) for key in keys}
    return frames, Path(arena).stem, scenario.seeds[-1]


def export_int8(
    source: Path, out: Path, *, name: str | None = None, flights: int = FLIGHTS
) -> PolicyCard:
    """Write a policy in 8-bit integers with its card, without the float policy's results.

    The default name is the source's name with `-int8`. Raises UsageError if the source is not a
    float policy, cannot be flown or quantized, or if `out` is the source or not writable.
    """
    card = load_card(source)
    if card.quantisation is not None:
        raise UsageError(f"{source}: accepted: a policy in floats; this one is in 8-bit integers")
    if out.resolve() == source.resolve():
        raise UsageError(f"{out}: accepted: another folder than that of the policy in floats")
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: not a folder")
    frames, arena, last_seed = frames_of(source, flights=flights)
    chosen = stream(FIRST_SEED, Stream.CAMERA).permutation(len(next(iter(frames.values()))))
    ranges, checked = chosen[:FRAMES], chosen[FRAMES : FRAMES + CHECKED]
    if not len(checked):
        raise UsageError(f"{len(chosen)} frames in {flights} flights; accepted: more than {FRAMES}")
    model = quantised(read_model(source, card), _at(frames, ranges))
    wanted = open_model(source, card).infer(_at(frames, checked))
    try:
        found = OnnxRuntime(model, card.observation, card.actions).infer(_at(frames, checked))
    except ValueError as error:
        raise UsageError(f"the network in integers: {error}") from None
    is_discrete = discrete_actions(card.actions) is not None
    same = float(np.mean(found.argmax(1) == wanted.argmax(1))) if is_discrete else None
    facts: dict[str, Any] = {
        "name": name or f"{card.name}-int8",
        "description": f"{card.description or card.name}, in 8-bit integers",
        "results": (),
        "sha256": digest(model),
        "torch_sha256": None,
        "quantisation": Quantisation(
            method=METHOD,
            source_sha256=card.sha256,
            arena=arena,
            first_seed=FIRST_SEED,
            last_seed=last_seed,
            frames=len(ranges),
            checked=len(checked),
            agreement=same,
            error=relative_error(found, wanted),
        ),
    }
    card = PolicyCard.model_validate({**dict(card), **facts})
    with usage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        replace_file(out / ONNX_FILE, model)
        write_card(out, card)
        (out / TORCH_FILE).unlink(missing_ok=True)
    return card


def _at(frames: Encoded, rows: NDArray[np.int64]) -> Encoded:
    return {key: array[rows] for key, array in frames.items()}
