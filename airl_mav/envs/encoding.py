"""The network's images of n vehicles by a compiled loop: those of numpy, several times faster.

`policy.layouts` says what they are; the companion, which has no numba, makes them with numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel
from airl_mav.policy.layouts import Bytes


def shrink(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return what `policy.layouts.shrink` returns."""
    images = np.empty((len(depth_mm), rows, columns), np.uint8)
    _shrink(depth_mm, bytes_of.table, bytes_of.far_mm, images)
    return images


@kernel
def _shrink(
    depth_mm: NDArray[np.uint16], table: NDArray[np.uint8], far_mm: float, out: NDArray[np.uint8]
) -> None:
    rows, columns = out.shape[1], out.shape[2]
    tall, wide = depth_mm.shape[1] // rows, depth_mm.shape[2] // columns
    if tall == 1 and wide == 1:
        _to_bytes(depth_mm.ravel(), np.uint16(1), table, far_mm, out.ravel())
        return
    line, least = np.empty(depth_mm.shape[2], np.uint16), np.empty((rows, columns), np.uint16)
    for i in range(len(out)):
        for row in range(rows):
            for u in range(len(line)):
                line[u] = depth_mm[i, row * tall, u] - np.uint16(1)
            for k in range(1, tall):
                for u in range(len(line)):
                    line[u] = min(line[u], np.uint16(depth_mm[i, row * tall + k, u] - 1))
            if wide == 2:
                # The usual one: a stride that the compiler knows becomes vector instructions.
                for column in range(columns):
                    least[row, column] = min(line[2 * column], line[2 * column + 1])
            else:
                for column in range(columns):
                    nearest = line[column * wide]
                    for k in range(1, wide):
                        nearest = min(nearest, line[column * wide + k])
                    least[row, column] = nearest
        _to_bytes(least.ravel(), np.uint16(0), table, far_mm, out[i].ravel())


@kernel
def _to_bytes(
    depths: NDArray[np.uint16],
    less: np.uint16,
    table: NDArray[np.uint8],
    far_mm: float,
    out: NDArray[np.uint8],
) -> None:
    """Write the bytes of depths (k,), which are `less` more than the values of `Bytes`."""
    if far_mm == 0.0:
        for u in range(len(depths)):
            out[u] = table[np.uint16(depths[u] - less)]
        return
    one, most, far = np.float32(1.0), np.float32(255.0), np.float32(far_mm)
    for u in range(len(depths)):
        ratio = most * (np.float32(np.uint16(depths[u] - less)) + one) / far
        out[u] = np.uint8(np.rint(ratio if ratio < most else most))
