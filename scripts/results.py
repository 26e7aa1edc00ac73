"""Published results: fly outdated ones, and write pages and cards.

python scripts/results.py fingerprint            # does this code fly as the results' code?
python scripts/results.py fingerprint --accept   # accept a changed behaviour
python scripts/results.py list                   # published and outdated results
python scripts/results.py fly [NAME ...]         # repeat outdated results; hours for all
python scripts/results.py fly --quick [NAME ...] # few flights, minutes; never published
python scripts/results.py collect NAME DIR       # import a result from another folder
python scripts/results.py docs [--check]         # write pages and cards from results/*.json
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:
    # Use this checkout instead of an installed version.
    sys.path.insert(0, str(ROOT))

from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, EXIT_USAGE, UsageError  # noqa: E402
from published.behaviour import fly_behaviour, write_behaviour  # noqa: E402
from published.declared import (  # noqa: E402 (from here on the checkout is found)
    Declared,
    read_declared,
)
from published.flying import (  # noqa: E402
    behaviour_differs,
    fly_result,
    take_result,
    why_out_of_date,
)
from published.pages import pages, rendered, stale_cards, write_all  # noqa: E402
from published.record import (  # noqa: E402
    BEHAVIOUR_FILE,
    all_records,
    behaviour_today,
)


def main(words: Sequence[str] | None = None) -> int:
    """Execute a command line; return the exit status."""
    options = _parser().parse_args(words)
    try:
        code: int = options.run(options)
    except UsageError as error:
        say(f"results.py: {error}", sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return code


def fingerprint(options: argparse.Namespace) -> int:
    """Fly the behaviour flights, and compare or store them."""
    if options.accept:
        flown = fly_behaviour()
        write_behaviour(BEHAVIOUR_FILE, flown)
        say(f"{flown.digest}  {len(flown.flights)} flights, written to {_short(BEHAVIOUR_FILE)}")
        say("pages say of older results that they are older after: results.py docs")
        return 0
    if found := behaviour_differs(BEHAVIOUR_FILE):
        for difference in found:
            say(str(difference))
        say(f"not the behaviour {behaviour_today()}: {len(found)} flights are others")
        return EXIT_BROKEN
    say(f"{behaviour_today()}  the same behaviour")
    return 0


def show(options: argparse.Namespace) -> int:
    """Print the published results and their status."""
    del options
    for declared in read_declared().values():
        why = why_out_of_date(declared)
        say(f"{declared.name:24} {why or 'today'}  ({declared.minutes:g} min)  {declared.command}")
    return 0


def fly(options: argparse.Namespace) -> int:
    """Fly outdated results, after a check that today's code has the stored behaviour."""
    asked = _named(options.names)
    if found := behaviour_differs(BEHAVIOUR_FILE):
        raise UsageError(
            f"this code does not fly as {_short(BEHAVIOUR_FILE)} says ({len(found)} flights; the "
            f"first: {found[0]}); accepted: results.py fingerprint --accept first, if that is meant"
        )
    for declared in asked:
        why = "quick" if options.quick else why_out_of_date(declared)
        if not why and not options.names:
            continue
        say(f"{declared.name}: {why or 'asked for'} {declared.command}")
        say(f"{declared.name}: {_short(fly_result(declared, quick=options.quick))}")
    return 0


def take(options: argparse.Namespace) -> int:
    """Import a result from the output folder of its command."""
    (declared,) = _named([options.name])
    say(_short(take_result(declared, options.folder, options.behaviour or behaviour_today())))
    return 0


def docs(options: argparse.Namespace) -> int:
    """Write pages and cards, or list the outdated ones."""
    records = all_records()
    if not options.check:
        for path in write_all(records):
            say(_short(path))
        return 0
    stale = [folder / "card.json" for folder, _ in stale_cards(records)]
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if rendered(text, records, _short(page)) != text:
            stale.append(page)
    for path in stale:
        say(f"{_short(path)}: not as results/*.json; accepted: results.py docs")
    return EXIT_BROKEN if stale else 0


def say(line: str, to: TextIO | None = None) -> None:
    """Print a line immediately, because child commands print in between."""
    print(line, file=to or sys.stdout, flush=True)


def _named(names: Sequence[str]) -> list[Declared]:
    known = read_declared()
    for name in names:
        if name not in known:
            raise UsageError(f"result {name!r}: accepted: {', '.join(known)}")
    return [known[name] for name in names] or list(known.values())


def _short(path: Path) -> str:
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else str(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    one = commands.add_parser("fingerprint", help="fly the fingerprint of the flight behaviour")
    one.add_argument("--accept", action="store_true", help="write it down as today's")
    one.set_defaults(run=fingerprint)
    commands.add_parser("list", help="outdated results").set_defaults(run=show)
    one = commands.add_parser("fly", help="fly again what is out of date")
    one.add_argument("names", nargs="*", metavar="NAME", help="these, out of date or not")
    one.add_argument("--quick", action="store_true", help="few flights, never published")
    one.set_defaults(run=fly)
    one = commands.add_parser("collect", help="take a result from a folder flown elsewhere")
    one.add_argument("name", metavar="NAME")
    one.add_argument("folder", metavar="DIR", type=Path)
    one.add_argument("--behaviour", help="fingerprint of the code that flew it; default: today's")
    one.set_defaults(run=take)
    one = commands.add_parser("docs", help="write pages and cards from results/*.json")
    one.add_argument("--check", action="store_true", help="only say which differ")
    one.set_defaults(run=docs)
    return parser


if __name__ == "__main__":
    sys.exit(main())
