"""What the vehicle said of its motion, by its own clock."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Track(NamedTuple):
    """Telemetry of a stretch of a flight."""

    motion: NDArray[np.float64]
    """(n, 7) LOCAL_POSITION_NED: time since boot [s], north, east, down [m], their rates [m/s]."""
    heading: NDArray[np.float64]
    """(m, 3) ATTITUDE: time since boot [s], yaw [rad], yawspeed [rad/s]."""

    def between(self, start_s: float, end_s: float) -> Track:
        """Return the part from one time to another, by the vehicle's clock [s]."""
        return Track(*(part[(part[:, 0] >= start_s) & (part[:, 0] <= end_s)] for part in self))
