"""What added latency costs: a policy at latencies that grow, on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, model_validator

from airl_mav.cli.cells import Cell
from airl_mav.core.errors import UsageError
from airl_mav.policy.registry import find_policy
from airl_mav.report.comparison.degradation import (
    AGAINST_FIRST,
    STEP,
    build_degradation,
    contrasts_by_key,
    curves_section,
    policy_tables,
)
from airl_mav.report.comparison.model import Comparison, RunEntry
from airl_mav.report.document import Section
from airl_mav.studies.findings import Findings
from airl_mav.studies.parts import (
    AGGREGATE,
    GAP,
    fan_data,
    fan_gallery,
    fan_table,
    findings_of,
    path_lengths,
    slug,
)
from airl_mav.studies.study import FanConfig, Flown, Study, StudyConfig

BASE = "base"
"""No latency added: 1 ms, as of a desktop computer."""


class DegradationConfig(StudyConfig):
    """Latencies that are added to policies."""

    policies: tuple[str, ...] = Field(min_length=1, description="names, or paths to folders")
    also_if_there: tuple[str, ...] = Field(
        default=(), description="policies that are passed over where there are none"
    )
    arena: str = Field(default="static-obstacles", description="arena profile")
    latencies: tuple[str, ...] = Field(
        default=(BASE, "150ms", "300ms", "400ms", "950ms"),
        min_length=2,
        description="t2, growing, as --latency takes it; base: none added; first: the reference",
    )
    fan: FanConfig = Field(description="flights to one goal")

    @model_validator(mode="after")
    def _different(self) -> DegradationConfig:
        if len(set(self.latencies)) < len(self.latencies):
            raise ValueError("latencies: one twice; accepted: each once")
        return self

    def flown_policies(self) -> list[str]:
        """Return the policies, without those that are not there."""
        return [*self.policies, *(name for name in self.also_if_there if _there(name))]


def cells(config: DegradationConfig, _root: Path) -> list[Cell]:
    """Return every policy at every latency, and its flights to one goal."""
    planned = []
    for policy in config.flown_policies():
        for latency in config.latencies:
            given = None if latency == BASE else latency
            planned += [
                Cell(
                    _key(policy, latency),
                    f"{Path(policy).name} at {latency}",
                    config.command(policy, config.arena, latency=given),
                ),
                Cell(
                    _fan_key(policy, latency),
                    f"{Path(policy).name} at {latency}, one goal",
                    config.command(
                        policy,
                        config.arena,
                        latency=given,
                        episodes=config.fan.flights,
                        arena_seed=config.fan.arena_seed,
                    ),
                ),
            ]
    return planned


def _there(policy: str) -> bool:
    try:
        find_policy(policy)
    except UsageError:
        return False
    return True


def _key(policy: str, latency: str) -> str:
    return slug(f"{Path(policy).name}-{latency}")


def _fan_key(policy: str, latency: str) -> str:
    return f"{_key(policy, latency)}-one-goal"


def findings(config: DegradationConfig, flown: Mapping[str, Flown]) -> Findings:
    """Say what latency costs."""
    entries = [
        RunEntry(
            key,
            flown[key].held.folder,
            label=_latency_name(latency),
            group=Path(policy).name,
            rules=flown[key].held.rules,
        )
        for policy in config.flown_policies()
        for latency in config.latencies
        for key in (_key(policy, latency),)
    ]
    runs = {entry.name: flown[entry.name].run for entry in entries}
    comparison = build_degradation({"arena": config.arena}, entries, runs)
    fans = {
        Path(policy).name: [
            (_latency_name(latency), flown[_fan_key(policy, latency)])
            for latency in config.latencies
        ]
        for policy in config.flown_policies()
    }
    sections = [curves_section(comparison)]
    for policy in comparison.groups:
        fan = fan_table(f"{policy}: flights to one goal", fans[policy])
        title = f"{policy}: {config.fan.flights} flights to one goal"
        sections += [
            Section(policy, tables=(*policy_tables(comparison, policy), fan)),
            fan_gallery(f"fan-{slug(policy)}", title, fans[policy]),
        ]
    return findings_of(
        "degradation",
        config,
        flown,
        title="Degradation by latency",
        question="How much worse does a policy fly as its decisions come later?",
        answers=[*comparison.answers, *(_fan_sentence(name, each) for name, each in fans.items())],
        sections=sections,
        facts=(("arena", config.arena),),
        data={
            "arena": config.arena,
            "latencies": list(config.latencies),
            "policies": [_data(config, comparison, policy) for policy in comparison.groups],
            "one_goal": {name: fan_data(each) for name, each in fans.items()},
        },
    )


def _latency_name(latency: str) -> str:
    """Return a latency as people read it."""
    return latency if latency == BASE else latency.replace("ms", " ms")


def _fan_sentence(policy: str, fans: list[tuple[str, Flown]]) -> str:
    """Return the path lengths of the flights to one goal."""
    lengths = [(name, path_lengths(flown).value) for name, flown in fans]
    told = ", ".join(
        f"{name} {'none reached it' if value is None else f'{value:.1f} m'}"
        for name, value in lengths
    )
    return f"{policy}, mean path to one goal: {told}."


def _data(config: DegradationConfig, comparison: Comparison, policy: str) -> dict[str, object]:
    return {
        "policy": policy,
        "cells": [
            {
                "latency": latency,
                "folder": run.entry.folder,
                "t2_mean_us": run.stages["t2"].mean,
                **AGGREGATE.dump_python(run.quality, mode="json"),
            }
            for latency, run in zip(config.latencies, comparison.group(policy), strict=True)
        ],
        **{
            name: [
                GAP.dump_python(contrast.paired, mode="json")
                for contrast in contrasts_by_key(comparison, policy, key)
            ]
            for name, key in (("against_first", AGAINST_FIRST), ("steps", STEP))
        },
    }


DEGRADATION_STUDY = Study(
    key="degradation",
    model=DegradationConfig,
    cells=cells,
    findings=findings,
    quick={"episodes": 40, "fan": {"flights": 12}},
)
