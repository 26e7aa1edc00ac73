"""8-bit integer networks: static quantisation of an ONNX model with ONNX Runtime's tool."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.policy.observation_spec import Encoded
from airl_mav.policy.runtime import first_line

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

        def __init__(self) -> None:
            self._rows = _rows(frames)

        def get_next(self) -> Mapping[str, NDArray[Any]] | None:
            return next(self._rows, None)

    with tempfile.TemporaryDirectory(prefix="airl-int8-") as scratch, _quiet():
        floats, shaped, written = (
            Path(scratch) / f"{name}.onnx" for name in ("floats", "shaped", "int8")
        )
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
