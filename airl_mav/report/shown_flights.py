"""Single flights of a page: still pictures of the worst, and the data of the page's script."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from airl_mav.arena.geometry import Arena
from airl_mav.flight.record import EpisodeRecord
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.flight_data import chosen, flight_data
from airl_mav.report.forensics.evidence import Cause, ranked
from airl_mav.report.forensics.worst import flown_path
from airl_mav.report.policy_view import PolicyAgain, SeenDecision, policy_again, seen_decisions
from airl_mav.report.run_figures import map_figure
from airl_mav.report.scene import ALL_FLIGHTS, SceneFlight, scene_json, top_speed
from airl_mav.report.theme import FigureImage, palette
from airl_mav.report.tracking import TrackedFlight, track
from airl_mav.report.tracking_figure import IMAGES, tracking_figure

MAX_PICTURED = 6
"""Maximum number of flights with still pictures, worst first."""

MAX_SHOWN = 24
"""Maximum number of flights in the view of single flights, worst first."""


@dataclass(frozen=True)
class PicturedFlight:
    """Flight with still pictures."""

    record: EpisodeRecord
    cause: Cause | None
    pictures: tuple[FigureImage, ...]
    scene: int | None
    """Number in the view of single flights; None without a path."""


@dataclass(frozen=True)
class ShownFlight:
    """Flight in the view of single flights."""

    scene: SceneFlight
    tracked: TrackedFlight
    seen: tuple[SeenDecision, ...]
    """Recomputed decisions; empty if the arena or the vehicle is unknown."""


@dataclass(frozen=True)
class ShownFlights:
    """Flights of the view, worst first."""

    flights: tuple[ShownFlight, ...]
    policy: PolicyAgain | None
    numbers: dict[int, int] = field(init=False)
    """Number of each flight in the view, by episode index."""

    def __post_init__(self) -> None:
        """Number the flights."""
        numbers = {flight.scene.record.index: k for k, flight in enumerate(self.flights)}
        object.__setattr__(self, "numbers", numbers)

    @property
    def note(self) -> str:
        """Note on the source of the policy's images and scores."""
        told = "Rendered again from the recorded path, without the camera's noise."
        asked = [d.again for flight in self.flights for d in flight.seen if d.again is not None]
        if asked:
            told += (
                f" The policy, asked again, chose the flown action in {sum(asked):,} of "
                f"{len(asked):,} decisions."
            )
        return told


def pictured(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes with still pictures, worst first."""
    return ranked(run)[:MAX_PICTURED]


def shown(run: LoadedRun) -> list[EpisodeRecord]:
    """Return the episodes for the view of single flights, worst first."""
    return ranked(run)[:MAX_SHOWN]


def shown_flights(
    run: LoadedRun, arenas: Mapping[int, Arena], vehicle: VehicleProfile | None
) -> ShownFlights:
    """Return the flights of the view; flights without a path are skipped."""
    again = None if vehicle is None else policy_again(run.info)
    flights = []
    for record in shown(run):
        path, tracked, arena = flown_path(run, record), track(run, record), arenas.get(record.index)
        if path is None or tracked is None:
            continue
        seen: tuple[SeenDecision, ...] = ()
        if arena is not None and vehicle is not None:
            seen = tuple(seen_decisions(run, record, arena, vehicle, again))
        flights.append(ShownFlight(SceneFlight(record, path, arena), tracked, seen))
    return ShownFlights(tuple(flights), again)


def pictured_flights(
    run: LoadedRun,
    arenas: Mapping[int, Arena],
    view: ShownFlights,
    causes: Mapping[int, Cause],
    range_m: float,
) -> list[PicturedFlight]:
    """Draw the still pictures of flights, worst first."""
    top = top_speed([flight.scene for flight in view.flights])
    found = []
    for episode in pictured(run):
        number = view.numbers.get(episode.index)
        flight = None if number is None else view.flights[number]
        path = None if flight is None else flight.scene.path
        pictures = [map_figure(episode, path, arenas.get(episode.index), top)]
        if flight is not None:
            seen = [flight.seen[k] for k in chosen(len(flight.seen), IMAGES, 2)]
            pictures.append(tracking_figure(flight.tracked, seen, range_m))
        found.append(PicturedFlight(episode, causes.get(episode.index), tuple(pictures), number))
    return found


def page_data(
    run: LoadedRun,
    view: ShownFlights,
    pictures: Sequence[FigureImage],
    vehicle: VehicleProfile | None,
) -> str:
    """Return the data of the page's script as JSON: pictures, views and flights."""
    fov, range_m = (0.0, 0.0) if vehicle is None else (
        vehicle.camera.horizontal_fov_deg, vehicle.camera.range_m,
    )  # fmt: skip
    everyone = ranked(run)[:ALL_FLIGHTS]
    data: dict[str, Any] = {
        "pictures": {picture.name: picture.svg for picture in pictures},
        "flights": [
            {
                **flight_data(
                    flight.tracked,
                    run.latency.get(flight.scene.record.index, {}),
                    flight.seen,
                    range_m,
                    view.policy,
                ),
                "faults": flight.scene.record.fault_spans_s(),
            }
            for flight in view.flights
        ],
        "palette": palette(),
    }
    views = scene_json(run, [flight.scene for flight in view.flights], everyone, fov)
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return f'{text[:-1]},"views":{views}}}'
