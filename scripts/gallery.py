"""Galleries of the documentation: every built-in arena, vehicle and policy with a picture.

    python scripts/gallery.py           # writes docs/gallery/*.md and missing pictures
    python scripts/gallery.py --pages   # writes the pages only, from profiles and policy cards

Each part has one command; pictures are drawn by that or by `airl render`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from PIL import Image

from airl_mav import Scenario, rehearse
from airl_mav.cli import main as commands
from airl_mav.core.files import replace_file
from airl_mav.policy.registry import find_policy, policy_names
from airl_mav.profiles import loading
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import arena_of, load
from airl_mav.report import run_figures

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "gallery"
PICTURES = ROOT / "docs" / "images" / "gallery"

SEED = 7

WIDTH_PX = 480
COLOURS = 128


@dataclass(frozen=True)
class Entry:
    """One part of a gallery."""

    name: str
    description: str
    facts: str
    commands: tuple[str, ...]
    pictures: Mapping[str, Callable[[Path], None]]
    """Functions that write the pictures, by file name."""


def arenas() -> list[Entry]:
    """Return all arenas: a map and the view of a colour camera at the start."""
    entries = []
    for name in loading.list_profiles("arenas"):
        plan = f"airl arena {name} --seed {SEED} --png map.png"
        view = f"airl render {name} --seed {SEED} --width-px 480 --height-px 320 --out view.png"
        pictures = {
            f"arena-{name}.png": partial(draw_by_command, plan),
            f"view-{name}.png": partial(draw_by_command, view),
        }
        description = loading.describe_profile("arenas", name)
        entries.append(Entry(name, description, "", (plan, view), pictures))
    return entries


def vehicles() -> list[Entry]:
    """Return all vehicles, each with an image of its main camera."""
    entries = []
    for name in loading.list_profiles("vehicles"):
        profile = load_vehicle(name)
        camera, body = profile.camera, profile.body
        taken = f"airl render dense-obstacles --seed {SEED}"
        if camera.kind == "depth":
            # At least as many rows as `airl render` accepts; a lidar has one.
            size = f"--width-px {camera.width_px} --height-px {max(8, camera.height_px)}"
            lens = f"--projection {camera.projection} --fov-deg {camera.horizontal_fov_deg:g}"
            view = f"{taken} --show depth {size} {lens} --out view.png"
        else:
            view = f"{taken} --camera {name} --out view.png"
        facts = (
            f" Mass {body.mass_kg:g} kg. Main camera: {camera.kind}, {camera.width_px} x "
            f"{camera.height_px} pixels, {camera.horizontal_fov_deg:g}°, {camera.rate_hz:g} Hz."
        )
        pictures = {f"vehicle-{name}.png": partial(draw_by_command, view)}
        description = loading.describe_profile("vehicles", name)
        entries.append(Entry(name, description, facts, (view,), pictures))
    return entries


def policies() -> list[Entry]:
    """Return all learned policies, each with a flight in its training arena."""
    entries = []
    for name in policy_names():
        card = find_policy(name).card
        if card is None or card.training is None:
            continue
        environment = card.training.config.get("environment", {})
        arena, vehicle = card.training.arena, environment.get("vehicle", "quad")
        options = f"--arena {arena}"
        options += f" --vehicle {vehicle}" if vehicle != "quad" else ""
        scenario = Scenario(
            policy=name, arena=arena, vehicle=vehicle, level="gym", episodes=1, seed=SEED
        )
        # Pipelined policies decide with every frame.
        period = f"Decision period: {card.hold_s:g} s." if card.decisions == "sequential" else ""
        facts = f" {period}".rstrip()
        for result in [each for each in card.results if each.arena == arena][:1]:
            facts += (
                f" Success in `{result.arena}`: {100.0 * result.success_rate:.1f} % of "
                f"{result.episodes:,} flights."
            )
        entries.append(
            Entry(
                name,
                card.description,
                facts,
                (f"airl-sitl --policy {name} {options}",),
                {f"policy-{name}.png": partial(draw_flight, scenario)},
            )
        )
    return entries


GALLERIES: dict[str, tuple[str, str, Callable[[], list[Entry]]]] = {
    "arenas": (
        "Arenas",
        "Built-in arenas, from above and as the vehicle sees them at the start. Every seed draws "
        "another arena of the same kind. Make your own: [arena profiles](../how-to/arena.md).",
        arenas,
    ),
    "vehicles": (
        "Vehicles",
        "Built-in vehicles, with an image of the main camera in `dense-obstacles`. Make your own: "
        "[vehicle profiles](../how-to/vehicle.md).",
        vehicles,
    ),
    "policies": (
        "Policies",
        "Built-in policies, with one flight each in the training arena. All results: [shipped "
        "policies](../shipped-policies.md). Train your own: [training](../how-to/train.md).",
        policies,
    ),
}
"""Title, introduction and entries of each page."""


def page(title: str, introduction: str, entries: Iterable[Entry]) -> str:
    """Return a gallery page as Markdown."""
    parts = [f"# {title}\n\n<!-- Written by scripts/gallery.py -->\n\n{introduction}"]
    for entry in entries:
        images = "\n".join(f"![{entry.name}](../images/gallery/{file})" for file in entry.pictures)
        description = entry.description[0].upper() + entry.description[1:]
        # The first command shows the part; the others draw its pictures.
        parts.append(
            f"## {entry.name}\n\n{description}.{entry.facts}\n\n{images}\n\n`{entry.commands[0]}`"
        )
    return "\n\n".join(parts) + "\n"


def draw_by_command(command: str, path: Path) -> None:
    """Write the picture of a command that ends in a file name."""
    *words, _ = command.split()[1:]
    sys.argv = ["airl", *words, str(path)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        commands.airl()
    shrink(path)


def draw_flight(scenario: Scenario, path: Path) -> None:
    """Fly one episode in the vectorized simulator and write its map."""
    run = load(rehearse(scenario).path)
    episode = run.episodes[0]
    trajectory = run.trajectories[episode.index]
    path.write_bytes(run_figures.map_figure(episode, trajectory, arena_of(run, episode)).png)
    shrink(path)


def shrink(path: Path) -> None:
    """Rewrite a picture at the width of the page, with a palette."""
    image = Image.open(path).convert("RGB")
    if image.width != WIDTH_PX:
        resample = Image.Resampling.NEAREST if image.width < WIDTH_PX else Image.Resampling.LANCZOS
        size = (WIDTH_PX, round(image.height * WIDTH_PX / image.width))
        image = image.resize(size, resample)
    image.quantize(COLOURS).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the galleries of the documentation.")
    parser.add_argument("--pages", action="store_true", help="write the pages without pictures")
    options = parser.parse_args()
    PAGES.mkdir(exist_ok=True)
    PICTURES.mkdir(exist_ok=True)
    for name, (title, introduction, entries_of) in GALLERIES.items():
        entries = entries_of()
        replace_file(PAGES / f"{name}.md", page(title, introduction, entries).encode())
        if not options.pages:
            for entry in entries:
                for file, draw in entry.pictures.items():
                    if not (PICTURES / file).exists():
                        print(file, flush=True)
                        draw(PICTURES / file)


if __name__ == "__main__":
    main()
