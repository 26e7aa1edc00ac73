"""Install the clients that the nightly tests fly with, each in an environment of its own.

    python scripts/foreign_clients.py ~/foreign-clients
    AIRL_FOREIGN_CLIENTS=~/foreign-clients python -m pytest tests/flight/test_foreign_clients.py

MAVSDK's gRPC API, dronekit and MAVProxy want other versions of what this project uses, or a great
deal that no flight needs. What is there already is left as it is.
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
"""What pip installs for each, call by call."""


@dataclass(frozen=True)
class Install:
    """Install foreign clients for the nightly tests."""

    folder: tyro.conf.Positional[Path]
    """Gets a virtual environment for each."""


def install(folder: Path, client: str) -> None:
    """Make a client's environment, unless it is there. Raises CalledProcessError."""
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
