"""Parameters of the failsafes, read at start and after every change."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

LONGEST_S = 1e6
"""Limit of every value, so that times in microseconds do not overflow [s]."""


class Settings(NamedTuple):
    """Failsafe parameters: the field name in capitals; defaults are PX4's.

    PX4's simulated airframe sets COM_LOW_BAT_ACT to 3 and COM_RC_IN_MODE to 1.
    """

    com_act_fail_act: int = 0
    com_fail_act_t: float = 5.0
    com_fltt_low_act: int = 3
    com_imb_prop_act: int = 0
    com_lkdown_tko: float = 3.0
    com_low_bat_act: int = 0
    com_obl_rc_act: int = 0
    com_pos_low_act: int = 3
    com_posctl_navl: int = 0
    com_rc_in_mode: int = 3
    com_rcl_except: int = 0
    com_spoolup_time: float = 1.0
    com_wind_max_act: int = 0
    cbrk_flightterm: int = 121212
    gf_action: int = 2
    nav_dll_act: int = 0
    nav_rcl_act: int = 2

    @classmethod
    def read(cls, value: Callable[[str], float]) -> Settings:
        """Read the parameters with a look-up by PX4 name, clipped to `LONGEST_S`."""
        defaults = cls._field_defaults.values()
        return cls(
            *(
                type(default)(min(max(value(name.upper()), -LONGEST_S), LONGEST_S))
                for name, default in zip(cls._fields, defaults, strict=True)
            )
        )


FLIGHT_TERMINATION_OFF = 121212
"""Value of CBRK_FLIGHTTERM that disables flight termination by the failure detector."""
