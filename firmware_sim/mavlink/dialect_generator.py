"""Makes the module of our MAVLink dialect, with pymavlink's own generator."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from xml.etree import ElementTree as Xml

from pymavlink.generator import mavgen


def generate(newer: Path, definitions: Path, included: tuple[str, ...], module: Path) -> None:
    """Write the Python module of a dialect.

    Args:
        newer: Definitions of our own; they take the place of messages with the same number.
        definitions: Folder of pymavlink's definitions.
        included: Those of them that belong to the dialect, each including the one before.
        module: The file to write. The folder must be empty: definitions are put there, too.

    Raises:
        ImportError: The generator refuses the definitions.
    """
    folder = module.parent
    root = Xml.parse(newer).getroot()  # noqa: S314 (our own file)
    numbers = {message.get("id") for message in root.iter("message")}
    for name in included:
        tree = Xml.parse(definitions / f"{name}.xml")  # noqa: S314 (pymavlink's own file)
        for messages in tree.getroot().iter("messages"):
            for message in [m for m in messages if m.get("id") in numbers]:
                messages.remove(message)
        tree.write(folder / f"{name}.xml")
    include, version = Xml.Element("include"), Xml.Element("version")
    include.text = f"{included[-1]}.xml"
    version.text = "3"  # HEARTBEAT's mavlink_version, as in minimal.xml
    root[:0] = [include, version]
    source = module.with_suffix(".xml")
    Xml.ElementTree(root).write(source)
    options = mavgen.Opts(
        str(module.with_suffix("")), wire_protocol="2.0", language="Python3", validate=False
    )
    said = io.StringIO()
    # Standard output of a process of a rehearsal is its channel to the harness.
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        made = mavgen.mavgen(options, [str(source)])
    if not made:
        raise ImportError(f"pymavlink's generator failed: {said.getvalue()}")
