"""Published results: fly what is out of date, and write pages and cards from it.

python scripts/results.py fingerprint            # does this code fly as the one of the results?
python scripts/results.py fingerprint --accept   # yes, it flies otherwise, and that is meant
python scripts/results.py list                   # what is published, and what is out of date
python scripts/results.py fly [NAME ...]         # fly again what is; hours for all
python scripts/results.py fly --quick [NAME ...] # few flights, minutes; never published
python scripts/results.py collect NAME DIR       # take a result from a folder flown elsewhere
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
    # So that this checkout flies, whatever is installed.
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
    """Carry out a command line; return the exit status."""
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
    """Fly the fingerprint, and compare it or write it down."""
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
    """Say what is published, and what is out of date."""
    del options
    for declared in read_declared().values():
        why = why_out_of_date(declared)
        say(f"{declared.name:24} {why or 'today'}  ({declared.minutes:g} min)  {declared.command}")
    return 0


def fly(options: argparse.Namespace) -> int:
    """Fly what is out of date, once it is known that today's code is that of the fingerprint."""
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
    """Take a result from a folder in which its command was flown."""
    (declared,) = _named([options.name])
    say(_short(take_result(declared, options.folder, options.behaviour or behaviour_today())))
    return 0


def docs(options: argparse.Namespace) -> int:
    """Write pages and cards, or say which are not as the results are."""
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
    """Print a line at once: commands that fly print between."""
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
    commands.add_parser("list", help="what is out of date").set_defaults(run=show)
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
