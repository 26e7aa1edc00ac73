"""`airl` command: discovery of subcommands, their descriptions and usage."""

from __future__ import annotations

import difflib
import importlib
import subprocess
import sys
from typing import Annotated, Any

import pytest
import tyro

from airl_mav import __version__
from airl_mav.cli import main as entry
from airl_mav.cli.list_command import KINDS
from airl_mav.cli.main import GROUPS, main, subcommands
from airl_mav.cli.options import _arguments, options_in
from airl_mav.core import fields
from airl_mav.core.errors import PAGE
from airl_mav.policy.registry import policy_names
from airl_mav.profiles.loading import list_profiles
from tests.support.processes import ROOT

NAMES = list(subcommands())


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Run `airl WORDS`; return exit status, stdout and stderr."""
    with pytest.raises(SystemExit) as end:
        main(words)
    out, err = capsys.readouterr()
    assert isinstance(end.value.code, int)
    return end.value.code, out, err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "--version") == (0, f"airl-mav {__version__}\n", "")


def test_without_a_word_it_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    code, told, _ = run(capsys)
    assert code == 2
    assert run(capsys, "--help") == (0, told, "")
    for name in subcommands():
        assert f"\n  {name} " in told


@pytest.mark.parametrize(
    ("word", "hint"),
    [("evalute", "did you mean evaluate?"), ("hover", "accepted: sitl, firmware, ")],
)
def test_an_unknown_command_gets_a_hint(
    word: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, word)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: airl {word}: no such command; {hint}")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    "words",
    [
        ("swarm",),
        ("sitl", "--vehicles", "2"),
        ("sitl", "--vehicle", "fixed-wing"),
        ("sitl", "--firmware=betaflight"),
        ("sitl", "--level", "gazebo"),
    ],
)
def test_things_that_do_not_exist_refer_to_their_page(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = run(capsys, *words)
    assert code == 2
    assert err.endswith(f" is unsupported: see {PAGE}\n")


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_shipped_is_listed(kind: Any, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "list", kind)
    assert code == 0
    names = policy_names() if kind == "policies" else list_profiles(kind)
    assert names
    for name in names:
        assert name in out


def test_everything_is_listed_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "list")
    assert code == 0
    assert all(kind in out for kind in KINDS)
    code, _, err = run(capsys, "list", "zeppelins")
    assert code == 2
    assert "zeppelins" in err


@pytest.mark.parametrize("name", NAMES)
def test_help_has_examples_that_can_be_typed(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    code, out, _ = run(capsys, name, "--help")
    assert code == 0
    assert out.startswith(f"usage: airl {name}")
    lines = [line.strip(" │") for line in out.splitlines()]
    assert "Examples:" in lines
    examples = lines[lines.index("Examples:") + 1 :]
    assert any(line.startswith((f"airl {name}", f"airl-{name}")) for line in examples)


def test_the_commands_fit_on_a_page(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = run(capsys, "--help")
    assert len(out.splitlines()) <= 40
    assert max(map(len, out.splitlines())) <= 80
    assert {group for group, _, _ in subcommands().values()} == set(GROUPS)


@pytest.mark.filterwarnings("ignore:get_parser")
@pytest.mark.parametrize("name", NAMES)
def test_help_is_short_and_help_all_complete(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, short, _ = run(capsys, name, "--help")
    assert len(short.splitlines()) <= 60
    _, full, _ = run(capsys, name, "--help-all")
    model = importlib.import_module(subcommands()[name][2]).OPTIONS
    kind: Any = Annotated[(_arguments(model, {}), tyro.conf.HelptextFromCommentsOff)]
    parser = tyro.extras.get_parser(kind)
    expected = {option for action in parser._actions for option in action.option_strings}
    expected = {option for option in expected if not option.startswith("--no-")} - {"-h", "--help"}
    shown = {line.split()[0].rstrip(",") for line in full.splitlines() if line.startswith("  --")}
    assert shown == expected
    options = list(options_in(model))
    assert {each.group for each in options} <= set(fields.GROUPS)
    assert all(each.meaning.strip(". ") for each in options)
    common = [each.usage.split()[0] for each in options if each.is_common]
    assert all(f"\n  {option}" in short for option in common)


@pytest.mark.parametrize("name", ["sitl", "evaluate"])
def test_help_starts_with_policy_and_episodes(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = run(capsys, name, "--help")
    first = out.partition("Options:\n")[2].splitlines()
    shown = [line.split()[0] for line in first if line[2:3] not in ("", " ")]
    assert shown[:2] in (["--policy", "--episodes"], ["[POLICY", "--episodes"])


@pytest.mark.parametrize("name", ["sitl", "firmware", "companion"])
def test_the_script_is_the_subcommand(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, told, _ = run(capsys, name, "--help")
    monkeypatch.setattr(sys, "argv", [f"airl-{name}", "--help"])
    with pytest.raises(SystemExit) as end:
        getattr(entry, name)()
    assert end.value.code == 0
    script = capsys.readouterr().out
    for line in difflib.ndiff(told.splitlines(), script.splitlines()):
        assert line[:2] in ("  ", "? ") or "usage: " in line, line
    _, _, err = run(capsys, name, "--seed", "-1")
    assert err == "error: --seed -1: accepted: 0 <= value <= 2147483648\n"


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        (["--help"], {"pydantic", "numpy"}),
        *(
            ([name, "--help"], {"pybullet", "numba", "matplotlib", "jinja2", "torch", "mavsdk"})
            for name in ("sitl", "evaluate", "report")
        ),
    ],
)
def test_help_loads_no_simulator_and_no_figures(words: list[str], heavy: set[str]) -> None:
    code = (
        "import sys; from airl_mav.cli.main import airl\n"
        f"sys.argv[1:] = {words}\n"
        "try: airl()\n"
        "except SystemExit: pass\n"
        f"heavy = {heavy} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_help_into_a_pipe_that_nobody_reads_is_quiet() -> None:
    """`airl-firmware --help | head -1`."""
    command = [sys.executable, "-m", "airl_mav.cli.firmware_command", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        assert child.stderr.read() == b""
