"""Decision latency of an environment, and the speed limit that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

from airl_mav.core.constants import MS_PER_S
from airl_mav.envs.spec import Delay, EnvironmentSpec
from airl_mav.envs.stopping import DecisionLoop, StoppingTask
from airl_mav.latency.injection import Injection, choose_injection
from airl_mav.latency.source import longest_ms, parse_latency
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.conditions import Payload
from airl_mav.profiles.loaded import equipped


@dataclass(frozen=True)
class SpeedBound:
    """The safe velocity of an environment, and its inputs."""

    reaction_s: float
    """T: an obstacle comes up -> motors answer, at the worst moment and the longest t2 [s]."""
    sensing_distance_m: float
    safe_velocity_m_s: float
    asked_m_s: float
    """Fastest action without the bound [m/s]."""

    @property
    def max_speed_m_s(self) -> float:
        """Fastest action."""
        return min(self.asked_m_s, self.safe_velocity_m_s)

    def describe(self) -> str:
        """Return the bound in one line."""
        facts = (
            f"safe velocity {self.safe_velocity_m_s:.2f} m/s (reaction {self.reaction_s:.3f} s, "
            f"sensing distance {self.sensing_distance_m:g} m, braking as measured)"
        )
        if self.safe_velocity_m_s < self.asked_m_s:
            share = self.max_speed_m_s / self.asked_m_s
            return f"{facts}: actions scaled by {share:.3f}, from {self.asked_m_s:g} m/s"
        return f"{facts}: above the fastest action, {self.asked_m_s:g} m/s: actions are not scaled"


def injections_of(delay: Delay) -> tuple[Injection, ...]:
    """Return the sources of t2. Raises UsageError for an invalid one."""
    if delay.latency:
        option = "environment.delay.latency"
        return tuple(parse_latency(source, option) for source in delay.latency)
    return (choose_injection(load_computer(delay.computer), delay.workload),)


def speed_bound(spec: EnvironmentSpec) -> SpeedBound | None:
    """Return the safe velocity of an environment; None if it has no bound.

    The latency is the longest of all its sources; the vehicle is that of the profile, which flies
    in the environment.

    Raises:
        UsageError: A profile or a source of latency cannot be used, or the sensing distance ends
            within the hull.
    """
    asked, delay = spec.safe_velocity, spec.delay
    if asked is None:
        return None
    t2_ms = max(
        delay.native_ms if source.latency is None else longest_ms(source.latency)
        for source in injections_of(delay)
    )
    low_high = spec.randomisation.extra_delay_ms
    t2_s = (t2_ms + low_high[1]) / MS_PER_S
    vehicle, _ = equipped(spec.vehicle, delay.computer, Payload())
    loop = DecisionLoop.of(vehicle, spec.episode.hold_s, delay)
    return SpeedBound(
        reaction_s=loop.reaction_s(t2_s),
        sensing_distance_m=asked.sensing_distance_m,
        safe_velocity_m_s=StoppingTask(vehicle, loop, asked.sensing_distance_m).safe_velocity(t2_s),
        asked_m_s=spec.max_speed_m_s,
    )


def bounded(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return an environment with its fastest action bounded by its safe velocity, if it has one.

    Bounding again changes nothing. Raises UsageError as `speed_bound`.
    """
    bound = speed_bound(spec)
    if bound is None or bound.max_speed_m_s == spec.max_speed_m_s:
        return spec
    return spec.model_copy(update={"max_speed_m_s": bound.max_speed_m_s})
