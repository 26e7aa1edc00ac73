"""Install the clients of the nightly tests, each in a separate environment.

    python scripts/foreign_clients.py ~/foreign-clients
    AIRL_FOREIGN_CLIENTS=~/foreign-clients python -m pytest tests/flight/test_foreign_clients.py

MAVSDK's gRPC API, dronekit and MAVProxy require other versions of this project's dependencies, or
many packages that no flight needs. Existing environments stay unchanged.
"""

from __future__ import annotations

import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import tyro

CLIENTS: dict[str, tuple[tuple[str, ...], ...]] = {
    "mavsdk-grpc": (("mavsdk-grpc",),),
    "dronekit": (("dronekit", "future"),),
    # Without its dependencies: they are maps, plots and videos.
    "mavproxy": (("--no-deps", "MAVProxy"), ("pymavlink", "pyserial", "numpy")),
}
"""Arguments of each pip call, by client."""


@dataclass(frozen=True)
class Install:
    """Install foreign clients for the nightly tests."""

    folder: tyro.conf.Positional[Path]
    """Folder of the virtual environments."""


def install(folder: Path, client: str) -> None:
    """Create a client's environment if missing. Raises CalledProcessError."""
    home = folder / client
    done = home / "installed"
    if done.exists():
        return
    venv.create(home, with_pip=True, clear=True)
    for words in CLIENTS[client]:
        pip = [str(home / "bin" / "python"), "-m", "pip", "install", "--quiet", *words]
        subprocess.run(pip, check=True)
    done.touch()


def main(asked: Install) -> int:
    failed = 0
    for client in CLIENTS:
        try:
            install(asked.folder, client)
        except subprocess.CalledProcessError as error:
            print(f"{client}: not installed: {error}")
            failed += 1
        else:
            print(f"{client}: {asked.folder / client}")
    return min(1, failed)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Install)))
