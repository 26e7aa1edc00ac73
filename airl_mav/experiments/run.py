"""Python API of a run: episodes, quality of flight, latencies, paths and report."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from airl_mav.core.files import Arrays
from airl_mav.flight.record import EpisodeRecord, run_sha256
from airl_mav.flight.statistics import Aggregate, aggregate
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stages import Samples, pool, stage_samples
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo, load


@dataclass(frozen=True)
class Run:
    """Loaded run folder. Large data is read on first access."""

    path: Path

    @cached_property
    def _loaded(self) -> LoadedRun:
        return load(self.path)

    @property
    def info(self) -> RunInfo:
        """Settings, seeds, versions and machine of the run."""
        return self._loaded.info

    @property
    def episodes(self) -> tuple[EpisodeRecord, ...]:
        """Records of all episodes, by index."""
        return self._loaded.episodes

    @cached_property
    def quality(self) -> Aggregate:
        """Success rate, and means over the successful flights, each with its 95 % interval."""
        return aggregate(self.episodes)

    @cached_property
    def latency(self) -> dict[str, Samples]:
        """Durations (n,) [µs] by stage over all decisions; keys as in `latency.stages.STAGES`."""
        return pool(stage_samples(stamps) for stamps in self.stamps.values())

    @property
    def stamps(self) -> dict[int, Arrays]:
        """Raw stamps of the decisions (n,) [µs] by name, by episode index."""
        return self._loaded.latency

    @property
    def trajectories(self) -> dict[int, Trajectory]:
        """True paths, by episode index: time [µs], position and velocity NED, attitude, power."""
        return self._loaded.trajectories

    @property
    def sha256(self) -> str | None:
        """Digest of all lockstep flights, equal if bit-identical; None at other levels."""
        return run_sha256(self.episodes)

    @property
    def complete(self) -> bool:
        """True if all planned episodes have been flown."""
        return len(self.episodes) == len(self.info.seeds)

    def _repr_html_(self) -> str:
        """Return the notebook view: the verdict, the statistics and a map of the flights."""
        from airl_mav.report.notebook import run_html

        return run_html(self._loaded)

    def report(self) -> Path:
        """Write the page and pictures of the run and return the page, or raise UsageError."""
        # Imported here: matplotlib takes half a second, which runs without a page do not need.
        from airl_mav.report.run_report import write_report

        return write_report(self.path)


def load_run(path: Path | str) -> Run:
    """Read a run folder; raise UsageError if it is damaged or contains no run."""
    run = Run(Path(path))
    _ = run.info  # Checks the folder.
    return run
