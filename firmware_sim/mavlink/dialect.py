"""MAVLink dialect module, built by pymavlink's generator.

pymavlink's `development` set includes all of `common`, but lacks the newest messages of PX4: EVENT,
COMPONENT_METADATA, TIME_ESTIMATE_TO_TARGET and others. `newer_messages.xml` defines these messages.
The first import after an install generates a module from both (a fraction of a second) and caches
it beside the compiled kernels. Later imports load the cached module.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import io
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree as Xml

import pymavlink

from airl_mav.core.compiling import writable_folder

NEWER = Path(__file__).with_name("newer_messages.xml")
"""Messages missing from pymavlink's definitions."""

DEFINITIONS = Path(pymavlink.__file__).parent / "dialects" / "v20"
INCLUDED = ("minimal", "standard", "common", "development")
"""pymavlink's definitions included in `development`, each including the one before."""

_NAME = "airl_mavlink_dialect"


def load() -> ModuleType:
    """Return the dialect module, the counterpart of `pymavlink.dialects.v20.common`.

    Raises:
        ImportError: pymavlink is installed without its message definitions.
    """
    present = sys.modules.get(_NAME)
    if present is not None:
        return present
    # Without a writable folder, each process generates its own module.
    folder = writable_folder(f"mavlink-{_digest()}")
    if folder is not None:
        return _imported(generated(folder))
    with tempfile.TemporaryDirectory() as temporary:
        return _imported(generated(Path(temporary)))


def _digest() -> str:
    """Return a digest of the module's source definitions."""
    digest = hashlib.sha256(NEWER.read_bytes())
    for name in INCLUDED:
        # Size and time reveal an upgrade of pymavlink without reading half a megabyte of text.
        try:
            seen = (DEFINITIONS / f"{name}.xml").stat()
        except OSError as error:
            raise ImportError(f"pymavlink lacks its message definitions: {error}") from error
        digest.update(f"{name} {seen.st_size} {seen.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def generated(folder: Path) -> Path:
    """Return the path of the module in a folder. Generates a missing module."""
    path = folder / f"{_NAME}.py"
    # A temporary folder hides the half-written module from other processes.
    if not path.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as temporary:
            made = Path(temporary) / path.name
            generate(NEWER, DEFINITIONS, INCLUDED, made)
            made.replace(path)  # atomic, for several processes at once
    return path


def _imported(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(_NAME, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path}: cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # Registered before execution, as in importlib's documentation.
    sys.modules[_NAME] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[_NAME]
        raise
    return module


def generate(newer: Path, definitions: Path, included: tuple[str, ...], module: Path) -> None:
    """Write the Python module of a dialect.

    Args:
        newer: Additional definitions; they replace messages with the same number.
        definitions: Folder of pymavlink's definitions.
        included: Definitions of the dialect, each including the one before.
        module: File to write, in an empty folder. Definitions are written there, too.

    Raises:
        ImportError: The generator rejects the definitions.
    """
    # Imported here because loading an existing module does not need the generator.
    from pymavlink.generator import mavgen

    folder = module.parent
    root = Xml.parse(newer).getroot()  # noqa: S314 (our own file)
    # A newer definition replaces pymavlink's message with the same number.
    numbers = {message.get("id") for message in root.iter("message")}
    for name in included:
        tree = Xml.parse(definitions / f"{name}.xml")  # noqa: S314 (pymavlink's own file)
        for messages in tree.getroot().iter("messages"):
            for message in [m for m in messages if m.get("id") in numbers]:
                messages.remove(message)
        tree.write(folder / f"{name}.xml")
    # Include and version come first, as in pymavlink's own files.
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
    # In a rehearsal, a process's standard output is its channel to the harness.
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        made = mavgen.mavgen(options, [str(source)])
    if not made:
        raise ImportError(f"pymavlink's generator failed: {said.getvalue()}")
