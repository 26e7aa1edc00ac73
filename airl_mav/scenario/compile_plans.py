"""Compile plans of commands before their first flight. Cheap to import: uses function names."""

from __future__ import annotations

from airl_mav.core.first_start import CompileJob, CompilePlan
from airl_mav.profiles.camera_kind import CameraKind
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import PlantName
from airl_mav.scenario.resolved import ResolvedScenario

_FLIGHT = "firmware_sim.warm_up"
_VECTORIZED = "airl_mav.envs.compile_envs"


def plan_of(scenario: ResolvedScenario) -> CompilePlan:
    """Return the compile plan of a scenario at its level."""
    if scenario.level == "gym":
        return vectorized_plan(scenario.vehicle.camera.kind)
    return flight_plan(scenario.vehicle, scenario.scenario.plant)


def flight_plan(vehicle: VehicleProfile, plant: PlantName) -> CompilePlan:
    """Return the compile plan of a vehicle at levels sitl and lockstep."""
    profile = vehicle.model_dump_json()
    cameras = {each.kind for each in (vehicle.camera, *vehicle.cameras.values())}
    sensors = {name for name, value in vehicle.sensors if value is not None}
    return CompilePlan(
        "flight",
        "-".join((plant, *sorted(cameras), *sorted(sensors))),
        (
            CompileJob(f"{_FLIGHT}:compile_ticks", {"vehicle": profile, "plant": plant}, 128),
            CompileJob(f"{_FLIGHT}:compile_others", {"vehicle": profile}, 92),
        ),
        CompileJob(f"{_FLIGHT}:compile_flight", {"vehicle": profile, "plant": plant}, 5),
    )


def vectorized_plan(kind: CameraKind) -> CompilePlan:
    """Return the kernels of level gym and of a training, by the main camera's kind."""
    return CompilePlan(
        "vectorized",
        kind,
        (
            CompileJob(f"{_VECTORIZED}:compile_images", {"kind": kind}, 51),
            CompileJob(f"{_VECTORIZED}:compile_dynamics", {}, 100),
        ),
        CompileJob(f"{_VECTORIZED}:compile_vectorized", {"kind": kind}, 23),
    )
