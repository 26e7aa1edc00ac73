"""Parameters of a stand-in for real PX4: the built-in autopilot's and its airframe's."""

from __future__ import annotations

from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.autopilot.parameter_store import Parameters, ParameterValue

FRAME = (
    # Front right, rear left, front left, rear right.
    (0.1515, 0.245, 0.05),
    (-0.1515, -0.1875, 0.05),
    (0.1515, -0.245, -0.05),
    (-0.1515, 0.1875, -0.05),
)
"""CA_ROTORi_PX, _PY, _KM of airframe 10016."""

SWAPPED = (2, 0, 1, 3)
"""Outputs of a wrong motor order."""


class Px4Parameters(Parameters):
    """PX4 parameters used by the project, on airframe 10016."""

    def __init__(
        self, vehicle: VehicleProfile, *, swapped: bool = False, outputs: str = "PWM_MAIN_FUNC{}"
    ) -> None:
        super().__init__(vehicle.parameters)
        frame: dict[str, float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4, "THR_MDL_FAC": 0.0}
        for i in range(4):
            px, py, km = FRAME[SWAPPED[i] if swapped else i]
            frame |= {f"CA_ROTOR{i}_PX": px, f"CA_ROTOR{i}_PY": py, f"CA_ROTOR{i}_KM": km}
            frame[outputs.format(i + 1)] = 101 + i
        own = [spec.name for spec in px4_release().specs]
        wanted = {} if vehicle.px4 is None else vehicle.px4.parameters
        # Parameters set by a vehicle exist, with another value before.
        self._more = frame | {n: type(v)(0) for n, v in wanted.items() if n not in own}
        self._names = list(dict.fromkeys([*own, *self._more]))

    def __len__(self) -> int:
        return len(self._names)

    def by_name(self, name: str) -> ParameterValue | None:
        if name not in self._more:
            return super().by_name(name)
        return ParameterValue(name, self._more[name], self._names.index(name))

    def by_index(self, index: int) -> ParameterValue | None:
        if not 0 <= index < len(self._names):
            return None
        name = self._names[index]
        return self.by_name(name) if name in self._more else super().by_index(index)

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        if name not in self._more:
            return super().set(name, value)
        self._more[name] = type(self._more[name])(value)
        self.revision += 1
        return self.by_name(name)
