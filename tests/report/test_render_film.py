"""`airl render RUN`: camera images of a recorded flight as a film."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from rich.console import Console

from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.colour.pictures import Drawn, Shown, film, moments, still, write_film
from airl_mav.addons.view.replayed_flight import ReplayedRun
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import camera_pose
from airl_mav.cli.options import carry_out
from airl_mav.core.errors import UsageError
from airl_mav.report.policy_view import PolicyCamera
from tests.support.run_demo import write_demo_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    written, _ = write_demo_run(
        tmp_path_factory.mktemp("film") / "run", episodes=2, profile="dynamic-obstacles"
    )
    return written.path


def render(*words: str) -> None:
    code = carry_out(
        "airl render", "airl_mav.addons.colour.command", list(words), console=Console(quiet=True)
    )
    assert code == 0


def drawn(show: Shown) -> Drawn:
    return partial(still, show=show, rays=1, range_m=20.0)


def load(frame: Image.Image) -> bool:
    """Load a picture: only then its duration is known."""
    frame.load()
    return True


def test_pictures_are_what_the_vehicles_camera_saw(folder: Path) -> None:
    """The last sample of the recording, posed by hand."""
    run = ReplayedRun(folder)
    flight = run.flight(run.record(1))
    camera = Intrinsics.from_fov(64, 48, 1.5)
    pictures = list(film(flight, camera, drawn("rgb"), moments(flight, 50.0)))
    path, record = flight.path, flight.record
    assert record.navigation_us is not None
    seconds = (int(path.time_us[-1]) - record.navigation_us) / 1e6
    assert len(pictures) == int(seconds * 50.0) + 1
    # The recording is at 50 Hz, too: its samples are the film's, from navigation on.
    at = int(np.searchsorted(path.time_us, record.navigation_us)) + 10
    time_us = record.navigation_us + 10 * 20_000
    assert path.time_us[at] == time_us
    mount = PolicyCamera.of(flight.vehicle.camera).mount
    place, attitude = camera_pose(path.position[at], path.quaternion[at], mount)
    assert flight.arena is not None
    centers = flight.arena.centers_at(time_us - record.started_us)
    expected = render_picture(
        flight.arena, centers, camera, np.array(place), np.array(attitude)
    ).rgb
    assert (pictures[10] == expected).mean() > 0.999


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_has_every_picture_for_its_time(folder: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"flight{suffix}"
    words = ("--rate-hz", "2", "--width-px", "48", "--height-px", "32", "--out", str(out))
    render(str(folder), "1", *words)
    run = ReplayedRun(folder)
    flight = run.flight(run.record(1))
    assert flight.record.navigation_us is not None
    seconds = (int(flight.path.time_us[-1]) - flight.record.navigation_us) / 1e6
    with Image.open(out) as image:
        assert image.size == (48, 32)
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(image) if load(frame)]
    # Writers merge pictures that are alike.
    assert sum(times) == pytest.approx(500 * (int(2 * seconds) + 1), abs=1)
    assert len(times) > 2


@pytest.mark.parametrize("show", ["rgb", "grey"])
def test_a_video_has_every_picture(folder: Path, tmp_path: Path, show: Shown) -> None:
    """Decoded again: as many, in time, and as like the originals as a lossy codec leaves them."""
    av = pytest.importorskip("av")
    run = ReplayedRun(folder)
    flight = run.flight(run.record(1))
    camera = Intrinsics.from_fov(96, 64, 1.5)
    pictures = list(film(flight, camera, drawn(show), moments(flight, 5.0)))
    out = tmp_path / "flight.mp4"
    assert write_film(out, iter(pictures), 5.0) == len(pictures)
    with av.open(str(out)) as container:
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx(0.2 * np.arange(len(pictures)))
    kind = "rgb24" if show == "rgb" else "gray"
    for frame, picture in zip(frames, pictures, strict=True):
        off = frame.to_ndarray(format=kind).astype(float) - picture
        assert np.abs(off).mean() < 4.0


def test_a_video_of_odd_size_is_refused(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    out = tmp_path / "x.mp4"
    with pytest.raises(UsageError, match=r"49 x 32 px: accepted: even numbers in an \.mp4"):
        render(str(folder), "--width-px", "49", "--height-px", "32", "--out", str(out))
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--seed", "3"), "--seed 3: not for the picture of a flight"),
        (("--north-m", "3"), "--north-m 3: not for the picture of a flight"),
        (("7",), "0 to 1, as far as recorded"),
        (("--out", "x.png"), "accepted: a file name that ends in .gif, .mp4, .webp or .npy"),
    ],
)
def test_what_does_not_go_with_a_flight_is_one_line(
    folder: Path, words: tuple[str, ...], message: str
) -> None:
    with pytest.raises(UsageError) as caught:
        render(str(folder), *words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
