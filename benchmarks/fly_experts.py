"""Success rates of the experts for imitation in an arena, in the vectorized simulator.

python benchmarks/fly_experts.py rooms --expert planner --episodes 300
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import get_args

import numpy as np

from airl_mav.addons.imitation.imitation import StatefulExpert
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.flight.statistics import wilson
from airl_mav.policy.actions import commands
from airl_mav.training.config import ExpertName

VEHICLES = 50
"""Side by side."""


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("arena")
    parser.add_argument("--expert", choices=get_args(ExpertName), default="planner")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1, help="of the first")
    parser.add_argument("--actions", default="velocity-fixed-yaw")
    parser.add_argument("--speed", type=float, default=4.0, help="maximum [m/s]")
    parser.add_argument("--hold", type=float, default=0.2, help="between decisions [s]")
    options = parser.parse_args()
    spec = EnvironmentSpec.model_validate(
        {
            "arena": options.arena,
            "actions": options.actions,
            "max_speed_m_s": options.speed,
            "episode": {"hold_s": options.hold},
        }
    )
    ended: Counter[str] = Counter()
    times, ways = [], []
    for first in range(options.seed, options.seed + options.episodes, VEHICLES):
        seeds = range(first, min(first + VEHICLES, options.seed + options.episodes))
        navigation = Navigation(spec, len(seeds))
        expert = StatefulExpert(options.expert, navigation)
        navigation.begin(range(len(seeds)), seeds)
        expert.begin(range(len(seeds)))
        while (navigation.fleet.verdict == FlightStatus.FLYING).any():
            navigation.fly(commands(spec.action_spec, expert.decide()))
        flights = navigation.flights()
        ended.update(FlightStatus(int(verdict)).name.lower() for verdict in flights.verdict)
        reached = flights.verdict == FlightStatus.SUCCESS
        times += flights.time_s[reached].tolist()
        ways += flights.distance_m[reached].tolist()
    n, goals = options.episodes, ended["success"]
    share = wilson(goals, n).scaled(100.0)
    print(
        f"{options.expert} in {options.arena}: {goals} of {n} goals, {share.value:.1f} "
        f"[{share.low:.1f}, {share.high:.1f}] %, {np.mean(times):.2f} s, {np.mean(ways):.1f} m; "
        + ", ".join(f"{count} {name}" for name, count in sorted(ended.items()))
    )


if __name__ == "__main__":
    main()
