"""A headless Chromium that a test drives while a page lives: Chrome's DevTools protocol."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.sync.connection import Connection

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)

START_S = 60.0
REPLY_S = 60.0


class Page:
    """One tab."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        call = {"id": number, "method": method, "params": parameters}
        self._connection.send(json.dumps(call))
        while True:
            told = json.loads(self._connection.recv(timeout=REPLY_S))
            if told.get("id") == number:
                assert "error" not in told, told
                result: dict[str, Any] = told["result"]
                return result

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript, awaited."""
        found = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def resize(self, width: int, height: int, *, phone: bool = False) -> None:
        """Set the size of the page [CSS px]."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def text(self) -> str:
        """Return what the page says."""
        return str(self.evaluate("document.body?.innerText ?? ''"))

    def press(self, label: str) -> bool:
        """Press the button of a label; return whether there is one."""
        return self._click(label, "button")

    def tick(self, label: str) -> bool:
        """Click the checkbox that follows a label; return whether there is one."""
        return self._click(label, "input[type=checkbox]")

    def _click(self, label: str, kind: str) -> bool:
        """Click the element of a kind that has a text, or else the next one behind it."""
        found = self.evaluate(
            f"""(() => {{
  const texts = [...document.querySelectorAll("*")]
    .filter((each) => !each.children.length && each.textContent.trim() === {json.dumps(label)});
  for (const text of texts) {{
    const box = text.closest({json.dumps(kind)}) ??
      [...document.querySelectorAll({json.dumps(kind)})].find(
        (each) => text.compareDocumentPosition(each) & Node.DOCUMENT_POSITION_FOLLOWING);
    if (box) {{ box.click(); return true; }}
  }}
  return false;
}})()"""
        )
        return bool(found)

    def screenshot(self, path: Path) -> None:
        """Write a screenshot (PNG)."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


@contextmanager
def browser(folder: Path, *flags: str, niceness: int = 0) -> Iterator[Page]:
    """Run Chromium for a while, with its profile in a folder, and with more flags."""
    assert CHROMIUM is not None
    # Of the session, too: Linux' autogroups share the processor out among sessions.
    nicely = ["sh", "-c", 'echo $0 > /proc/self/autogroup; exec nice -n $0 "$@"', str(niceness)]
    profile = folder / "chromium"
    with (folder / "chromium.log").open("wb") as log:
        process = subprocess.Popen(
            [
                *(nicely if niceness else ()),
                CHROMIUM,
                *FLAGS,
                *flags,
                f"--user-data-dir={profile}",
                "about:blank",
            ],
            stdout=log,
            stderr=log,
            start_new_session=niceness > 0,
        )
    try:
        with connect(_address(process, profile), max_size=None) as connection:
            page = Page(connection)
            page.call("Page.enable")
            yield page
    finally:
        process.terminate()
        process.wait()


def _address(process: subprocess.Popen[bytes], profile: Path) -> str:
    """Return the address of the first tab's connection."""
    found, deadline = profile / "DevToolsActivePort", time.monotonic() + START_S
    while not (found.exists() and found.read_text().count("\n")):
        assert process.poll() is None, "Chromium ended"
        assert time.monotonic() < deadline, "Chromium does not start"
        time.sleep(0.05)
    port = found.read_text().split()[0]
    while True:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as reply:
            tabs = [tab for tab in json.load(reply) if tab["type"] == "page"]
        if tabs:
            return str(tabs[0]["webSocketDebuggerUrl"])
        assert time.monotonic() < deadline, "Chromium has no tab"
        time.sleep(0.05)
