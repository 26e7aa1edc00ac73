"""The network's images of n vehicles by a compiled loop: those of numpy, several times faster.

`policy.images` says what they are; the companion, which has no numba, makes them with numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel
from airl_mav.envs.scanning import COMPILED_SCANNING
from airl_mav.policy.images import Bytes, Shrink


def shrink_depth(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return what `policy.images.shrink_depth` returns."""
    images = np.empty((len(depth_mm), rows, columns), np.uint8)
    _shrink(depth_mm, bytes_of.table, bytes_of.far_mm, images)
    return images


def shrink_colour(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return what `policy.images.shrink_colour` returns."""
    images = np.empty((len(image), image.shape[3], rows, columns), np.uint8)
    _shrink_colour(image, images)
    return images


COMPILED = Shrink(shrink_depth, shrink_colour, COMPILED_SCANNING)
"""As the batch twin does it."""


@kernel
def _shrink_colour(image: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    channels, rows, columns = out.shape[1], out.shape[2], out.shape[3]
    tall, wide = image.shape[1] // rows, image.shape[2] // columns
    if tall == 1 and wide == 1:
        for i in range(len(out)):
            for row in range(rows):
                for channel in range(channels):
                    line = out[i, channel, row]
                    for column in range(columns):
                        line[column] = image[i, row, column, channel]
        return
    count = np.uint32(tall * wide)
    sums = np.empty((channels, columns), np.uint32)
    for i in range(len(out)):
        for row in range(rows):
            sums[:, :] = count // np.uint32(2)
            for k in range(tall):
                for column in range(columns):
                    for m in range(wide):
                        for channel in range(channels):
                            sums[channel, column] += image[
                                i, row * tall + k, column * wide + m, channel
                            ]
            for channel in range(channels):
                for column in range(columns):
                    out[i, channel, row, column] = np.uint8(sums[channel, column] // count)


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
