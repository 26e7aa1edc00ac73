"""Documentation: the site builds without a network, and all names in it exist."""

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest

from airl_mav.core.plugins import DOORS

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
COMMAND = re.compile(
    r"^(?:\$ )?((?:airl-(?:sitl|firmware|companion)|airl [a-z][a-z-]*)\b.*)$", re.M
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class Assets(HTMLParser):
    """Collects what a browser would load to show a page: everything but links to follow."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "audio", "video"):
            self.found.append(values.get("src") or "")
        if tag == "link" and values.get("rel") not in ("canonical", "next", "prev", "edit"):
            self.found.append(values.get("href") or "")


@pytest.mark.nightly
def test_pages_load_nothing_from_the_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        assets = Assets()
        assets.feed(page.read_text(encoding="utf-8"))
        assert assets.found
        outside = [url for url in assets.found if re.match(r"(https?:)?//", url)]
        assert not outside, f"{page.name}: {outside}"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", sheet.read_text(encoding="utf-8"))


@pytest.mark.nightly
def test_reference_shows_every_field_of_a_vehicle(site: Path) -> None:
    text = (site / "reference" / "profiles.html").read_text(encoding="utf-8")
    for name in ("mass_kg", "thrust_curve", "gps", "motors", "workloads.NAME.latency"):
        assert name in text


SITES = re.compile(r"[a-z]+:|//")
"""Start of a link that leaves the site."""

RAW = re.compile(
    r"--8<|\{ ?(?:width|\.|#|loading)|:::|\*\*\w|\]\(\S+\)|<!--|^#{1,6} ", re.MULTILINE
)
"""Markup that a rendered page must not show."""


class Rendered(HTMLParser):
    """Text outside of code, captions of pictures, links and anchors of a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.text = ""
        self.captions: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self._code = 0
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.links += [values[name] for name in ("href", "src") if name in values]
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "img":
            self.captions.append(values.get("alt", ""))
        self._code += tag in HIDDEN

    def handle_endtag(self, tag: str) -> None:
        self._code -= tag in HIDDEN

    def handle_data(self, data: str) -> None:
        if not self._code:
            self.text += data


HIDDEN = ("code", "pre", "script", "style")


@pytest.fixture(scope="module")
def rendered(site: Path) -> dict[Path, Rendered]:
    return {page: Rendered(page) for page in sorted(site.rglob("*.html")) if page.stem != "404"}


@pytest.mark.nightly
def test_rendered_pages_show_no_raw_markup(rendered: dict[Path, Rendered]) -> None:
    found = [
        f"{page.name}: {match[0]!r} in {each.text[max(0, match.start() - 40) : match.end() + 40]!r}"
        for page, each in rendered.items()
        for match in RAW.finditer(each.text)
    ]
    assert not found, "\n".join(found)


@pytest.mark.nightly
def test_includes_are_resolved(site: Path) -> None:
    unresolved = [
        page.name
        for page in site.rglob("*.html")
        if re.search(r"^--8(?:&lt;|<)", re.sub(r"<[^>]*>", "", page.read_text("utf-8")), re.M)
    ]
    assert not unresolved


@pytest.mark.nightly
def test_links_and_pictures_of_the_site_exist(site: Path, rendered: dict[Path, Rendered]) -> None:
    broken = []
    for page, each in rendered.items():
        for link in each.links:
            path, _, anchor = unquote(link).partition("#")
            if not link or SITES.match(link):
                continue
            target = (page.parent / path).resolve() if path else page
            if not target.is_file():
                broken.append(f"{page.relative_to(site)}: {link}")
            elif anchor and target in rendered and anchor not in rendered[target].anchors:
                broken.append(f"{page.relative_to(site)}: {link}, no such anchor")
    assert not broken, "\n".join(broken)


@pytest.mark.nightly
def test_every_command_and_object_has_a_page(site: Path) -> None:
    pages = reference()
    listed = [*pages.command_pages(), *pages.object_pages(pages.api_text())]
    assert len(listed) > 40
    missing = [path for path in listed if not (site / path).with_suffix(".html").is_file()]
    assert not missing


@pytest.mark.nightly
def test_captions_name_commands_that_exist(rendered: dict[Path, Rendered]) -> None:
    known = {name for name, _ in reference().commands()}
    for page, each in rendered.items():
        for caption in each.captions:
            # The name stands alone or before an option, as in `airl render --png`.
            for name in re.findall(r"\bairl-(?:sitl|firmware|companion)\b|`airl [a-z-]+", caption):
                assert name.strip("`") in known, f"{page.name}: {caption}"


def test_files_that_the_sources_name_exist() -> None:
    """Docstrings, messages and pages name pages by their path from the root; URLs do not count."""
    places = ("airl_mav", "companion", "firmware_sim", "scripts", "examples", "tests")
    sources = [path for place in places for path in (ROOT / place).rglob("*.py")]
    for path in [*sources, *TEXTS, ROOT / "Makefile", ROOT / "mkdocs.yml"]:
        text = re.sub(r"https?://\S+", "", path.read_text(encoding="utf-8"))
        for name in re.findall(r"\bdocs/[\w/-]+\.md\b", text):
            known = (ROOT / name).is_file() or name == "docs/index.md"  # made from the README
            assert known, f"{path.relative_to(ROOT)} names {name}"


ROOMS = "airl_mav|companion|firmware_sim|profiles|scripts|examples|benchmarks|tests"


def test_paths_in_the_pages_exist() -> None:
    """A path between backticks, `airl_mav/core/clock.py`, names a file or folder."""
    for path in TEXTS:
        for name in re.findall(rf"`((?:{ROOMS})/[\w./-]*)`", path.read_text(encoding="utf-8")):
            assert (ROOT / name).exists() or name == "airl_mav/_profiles", f"{path.name}: {name}"


def test_names_in_the_pages_exist() -> None:
    """A dotted name between backticks, `airl_mav.core.clock.Clock`, can be imported."""
    groups = [door.group for door in DOORS]
    for path in TEXTS:
        text = path.read_text(encoding="utf-8")
        for name in re.findall(
            r"`((?:airl_mav|companion|firmware_sim)(?:\.\w+)+)(?:\(.*?\))?`", text
        ):
            known = resolves(name) or name.endswith(".log") or name in groups
            assert known, f"{path.name}: {name}"


def resolves(name: str) -> bool:
    """Return whether a dotted name leads to a module, or to an attribute of one."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        module = ".".join(parts[:length])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False


def test_readme_links_lead_somewhere() -> None:
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{path.name} links to {target}"


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_options_in_the_pages_exist(path: Path) -> None:
    """Every option of a command line in a block of shell, by the command's own --help."""
    blocks = re.findall(r"^```sh\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)
    for block in blocks:
        for line in COMMAND.findall(block.replace("\\\n", " ")):
            line = line.split("#")[0]
            words = line.split()
            command = words[0] if words[0] != "airl" else " ".join(words[:2])
            for option in set(re.findall(r"(?<=\s)--[a-z][\w.-]*", line)) - {"--help"}:
                assert re.search(rf"{re.escape(option)}(?![\w-])", options_of(command)), line


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_python_in_the_pages_compiles(path: Path) -> None:
    for block in re.findall(
        r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S
    ):
        compile(block, path.name, "exec")


@cache
def options_of(command: str) -> str:
    return reference().help_text(command)


@cache
def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference", ROOT / "scripts/docs_reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
