"""Episodes saved in batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from airl_mav.experiments import campaign
from airl_mav.experiments.campaign import EpisodeSaver
from airl_mav.rehearsal.run_folder import EPISODES_FILE, FlownEpisode, RunFolder, load
from tests.support.processes import wait_until
from tests.support.run_demo import demo_arena, demo_episode, demo_setup

Make = Callable[[int], FlownEpisode]


@pytest.fixture(scope="module")
def episode() -> Make:
    record, trajectory, latency = demo_episode(0, demo_arena(1))
    return lambda index: FlownEpisode(replace(record, index=index), trajectory, latency)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", "saver", {}, setup=demo_setup())


class Watched(RunFolder):
    """Run folder that records the number of episodes per save, and fails on request."""

    def __init__(self, path: Path, fail_at: int | None = None) -> None:
        super().__init__(path)
        self.sizes: list[int] = []
        self.fail_at = fail_at

    def save_episodes(self, episodes: Sequence[FlownEpisode]) -> None:
        self.sizes.append(len(episodes))
        if len(self.sizes) == self.fail_at:
            raise OSError("disk full")
        super().save_episodes(episodes)


def test_at_the_end_all_are_saved(folder: RunFolder, episode: Make) -> None:
    with EpisodeSaver(folder) as saver:
        for index in (2, 0, 1):
            saver.add(episode(index))
    run = load(folder.path)
    assert list(run.episodes) == [episode(i).record for i in range(3)]
    assert set(run.trajectories) == set(run.latency) == {0, 1, 2}


def test_nothing_to_save_leaves_nothing(folder: RunFolder) -> None:
    with EpisodeSaver(folder):
        pass
    assert [path.name for path in folder.path.iterdir()] == ["run.json"]


def has_lines(folder: RunFolder, count: int) -> bool:
    return (folder.path / EPISODES_FILE).read_bytes().count(b"\n") == count


def test_after_a_while_they_are_saved_though_more_will_come(
    folder: RunFolder, episode: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign, "INTERVAL_S", 0.01)
    with EpisodeSaver(folder) as saver:
        for index in range(2):
            saver.add(episode(index))
            wait_until(lambda: (folder.path / EPISODES_FILE).exists(), "the first line")
            wait_until(partial(has_lines, folder, index + 1), "the next line")


def test_no_more_than_so_many_wait(
    folder: RunFolder, episode: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign, "INTERVAL_S", 3600.0)
    monkeypatch.setattr(campaign, "MAX_WAITING", 2)
    watched = Watched(folder.path)
    with EpisodeSaver(watched) as saver:
        for index in range(5):
            saver.add(episode(index))
    assert watched.sizes == [2, 2, 1]
    assert len(load(folder.path).episodes) == 5


def test_saving_that_takes_long_is_done_less_often(
    folder: RunFolder, episode: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses = []
    real = EpisodeSaver._collect

    class Slow:
        """A second passes with each look."""

        def time_us(self) -> int:
            return 1_000_000

    def collect(saver: EpisodeSaver, pause_s: float) -> tuple[bool, list[FlownEpisode]]:
        pauses.append(pause_s)
        return real(saver, pause_s)

    monkeypatch.setattr(EpisodeSaver, "_collect", collect)
    monkeypatch.setattr(campaign, "WallClock", Slow)
    monkeypatch.setattr(campaign, "MAX_WAITING", 1)
    with EpisodeSaver(folder) as saver:
        for index in range(3):
            saver.add(episode(index))
    assert pauses[:2] == [campaign.INTERVAL_S, campaign.INTERVAL_PER_SAVE]


@pytest.mark.parametrize("when", ["while flying", "at the end"])
def test_what_goes_wrong_is_raised_where_the_episodes_come_from(
    folder: RunFolder, episode: Make, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    monkeypatch.setattr(campaign, "INTERVAL_S", 3600.0)
    monkeypatch.setattr(campaign, "MAX_WAITING", 2)
    watched = Watched(folder.path, fail_at=2)
    with pytest.raises(OSError, match="disk full"), EpisodeSaver(watched) as saver:
        for index in range(9 if when == "while flying" else 3):
            saver.add(episode(index))
    assert [e.index for e in load(folder.path).episodes] == [0, 1]


def test_it_does_not_hide_why_the_flights_ended(folder: RunFolder, episode: Make) -> None:
    with (
        pytest.raises(KeyError, match="the flights"),
        EpisodeSaver(Watched(folder.path, 1)) as saver,
    ):
        saver.add(episode(0))
        raise KeyError("the flights")
