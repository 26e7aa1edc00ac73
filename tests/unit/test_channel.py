"""The control channel: every message survives the pipe; nothing else gets through."""

from __future__ import annotations

import dataclasses
import io
import os
import queue
import threading
import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from airl_mav.core.child_process import Exited
from airl_mav.rehearsal import channel
from airl_mav.rehearsal.channel import (
    Abort,
    Begin,
    ChildChannel,
    Event,
    FinishEpisode,
    PhaseEntered,
    Ready,
    Request,
    Shutdown,
    parse_event,
)
from airl_mav.rehearsal.process_pair import Child
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve


def members(union: Any) -> tuple[type[channel._Line], ...]:
    """Return the message types of an annotated union."""
    found: tuple[type[channel._Line], ...] = get_args(get_args(union)[0])
    return found


REQUESTS, EVENTS = members(Request), members(Event)


def values(annotation: Any) -> st.SearchStrategy[Any]:
    """Return all values of a field's annotation that are ever sent: numbers are finite."""
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation is float:
        return st.floats(allow_nan=False, allow_infinity=False)
    if origin is Literal:
        return st.sampled_from(args)
    if origin in (Union, types.UnionType):
        return st.one_of([values(arg) for arg in args])
    if origin is tuple and args[-1] is Ellipsis:
        return st.lists(values(args[0]), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*(values(arg) for arg in args))
    if origin is dict:
        return st.dictionaries(values(args[0]), values(args[1]), max_size=3)
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        hints = get_type_hints(annotation)
        names = [field.name for field in dataclasses.fields(annotation)]
        return st.builds(annotation, **{name: values(hints[name]) for name in names})
    return st.from_type(annotation)


def messages(*kinds: type[channel._Line]) -> st.SearchStrategy[channel._Line]:
    """Return any message of the kinds given."""
    return st.one_of(
        [
            st.builds(kind, **{k: values(f.annotation) for k, f in kind.model_fields.items()})
            for kind in kinds
        ]
    )


class Listener:
    """Child end of a channel on two pipes, with the received requests."""

    def __init__(self, fail_on: type | None = None) -> None:
        read, self._write = os.pipe()
        self.got: queue.Queue[Any] = queue.Queue()
        self.gone = threading.Event()
        self._fail_on = fail_on
        self._file = os.fdopen(read, "rb")
        ChildChannel(self._file, io.BytesIO()).listen(self._handle, self._end)

    def _end(self) -> None:
        self._file.close()
        self.gone.set()

    def _handle(self, request: Any) -> None:
        if self._fail_on is not None and isinstance(request, self._fail_on):
            raise RuntimeError("cannot handle this")
        self.got.put(request)

    def write(self, data: bytes) -> None:
        os.write(self._write, data)

    def hang_up(self) -> None:
        os.close(self._write)


def test_all_messages_are_covered() -> None:
    defined = {
        value
        for value in vars(channel).values()
        if isinstance(value, type) and issubclass(value, channel._Line)
    } - {channel._Line}
    assert defined == {*REQUESTS, *EVENTS}
    names = [kind.model_fields["type"].default for kind in (*REQUESTS, *EVENTS)]
    assert len(set(names)) == len(names)


@given(message=messages(*EVENTS))
def test_every_event_survives(message: channel._Line) -> None:
    line = message.to_line()
    # Any text is encoded in a single line.
    assert line.endswith(b"\n")
    assert len(line.splitlines()) == 1
    assert parse_event(line) == message


@given(message=messages(*(kind for kind in REQUESTS if kind is not Begin)))
def test_every_request_survives(message: channel._Line) -> None:
    line = message.to_line()
    assert len(line.splitlines()) == 1
    listener = Listener()
    listener.write(line)
    assert listener.got.get(timeout=10.0) == message
    listener.hang_up()
    assert listener.gone.wait(10.0)


def test_the_first_line_survives() -> None:
    """One scenario, resolved; test_scenario.py holds others against their JSON."""
    message = Begin(scenario=resolve(Scenario(policy="greedy")), log="autopilot.log")
    line = message.to_line()
    assert len(line.splitlines()) == 1
    assert ChildChannel(io.BytesIO(line), io.BytesIO()).begin() == message
    assert ChildChannel(io.BytesIO(b""), io.BytesIO()).begin() is None


@given(line=st.binary(max_size=80))
def test_other_bytes_are_no_event(line: bytes) -> None:
    with pytest.raises(ValidationError):
        parse_event(line)


@pytest.mark.parametrize(
    "line",
    [
        b'{"type":"lunch"}',
        b'{"type":"ready","more":1}',
        b'{"more":1}',
        b'{"type":"text","time_us":"soon","severity":1,"text":""}',
        b'{"type":"shutdown"}',  # A request is no event.
    ],
)
def test_other_json_is_no_event(line: bytes) -> None:
    with pytest.raises(ValidationError):
        parse_event(line)


def test_unknown_lines_are_passed_over_and_named(capfd: pytest.CaptureFixture[str]) -> None:
    listener = Listener()
    listener.write(b'{"type":"lunch"}\nnoise \xff\n' + FinishEpisode().to_line())
    assert isinstance(listener.got.get(timeout=10.0), FinishEpisode)
    assert not listener.gone.is_set()
    listener.hang_up()
    assert listener.gone.wait(10.0)
    assert "not a request: " in capfd.readouterr().err


def test_a_line_cut_short_by_the_end_is_no_request(capfd: pytest.CaptureFixture[str]) -> None:
    listener = Listener()
    listener.write(Abort(land=True).to_line() + b'{"type":"abort","la')
    listener.hang_up()
    assert listener.gone.wait(10.0)
    assert isinstance(listener.got.get_nowait(), Abort)
    assert listener.got.empty()
    capfd.readouterr()


def test_a_handler_that_fails_is_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A failed handler ends the channel: the child must not outlive its harness."""
    failures: queue.Queue[Any] = queue.Queue()
    monkeypatch.setattr(threading, "excepthook", failures.put)
    listener = Listener(fail_on=Shutdown)
    listener.write(Shutdown().to_line())
    assert listener.gone.wait(10.0)
    assert failures.get(timeout=10.0).exc_type is RuntimeError
    listener.hang_up()


def test_events_of_many_threads_do_not_mix() -> None:
    read, write = os.pipe()
    outgoing = os.fdopen(write, "wb", buffering=0)
    end = ChildChannel(io.BytesIO(), outgoing)
    text = "x" * 300

    def send(who: int) -> None:
        for _ in range(50):
            end.send(PhaseEntered(phase=text, time_us=who))

    threads = [threading.Thread(target=send, args=(who,)) for who in range(4)]
    for thread in threads:
        thread.start()
    with os.fdopen(read, "rb") as incoming:
        found = [parse_event(incoming.readline()) for _ in range(200)]
    for thread in threads:
        thread.join()
    outgoing.close()
    assert sorted(e.time_us for e in found if isinstance(e, PhaseEntered)) == sorted(
        [0, 1, 2, 3] * 50
    )


def test_sending_to_a_harness_that_is_gone_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb", buffering=0) as outgoing:
        ChildChannel(io.BytesIO(), outgoing).send(Ready())


CHATTERBOX = '''
"""A child that prints from C, as pybullet does, and speaks the channel."""
import ctypes, os, queue, sys, threading
from airl_mav.rehearsal.channel import ChildChannel, PhaseEntered, Ready
channel = ChildChannel.on_stdio()
over = threading.Event()
os.write(1, b"banner of a library\\n")
print("printed", flush=True)
channel.send(Ready())
channel.listen(lambda r: channel.send(PhaseEntered(phase=r.type, time_us=0)), over.set)
over.wait(60)
channel.send(PhaseEntered(phase="gone", time_us=1))
sys.exit(7)
'''


def test_child_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Output of libraries goes to the log; closing the pipe ends the child."""
    (tmp_path / "chatterbox.py").write_text(CHATTERBOX, encoding="utf-8")
    root = str(Path(__file__).resolve().parents[2])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, str(tmp_path)]))
    events: queue.Queue[Any] = queue.Queue()
    child = Child("c", "chatterbox", tmp_path / "c.log", events)
    try:
        assert events.get(timeout=60.0) == ("c", Ready())
        child.send(FinishEpisode())
        assert events.get(timeout=60.0) == ("c", PhaseEntered(phase="finish", time_us=0))
    finally:
        child.stop()
    assert events.get(timeout=10.0) == ("c", PhaseEntered(phase="gone", time_us=1))
    assert events.get(timeout=10.0) == ("c", Exited(7))
    assert child.log_tail() == "banner of a library\nprinted"
    child.send(FinishEpisode())  # To a dead child: no error.
    child.stop()


def test_exit_in_words() -> None:
    assert str(Exited(3)) == "exit status 3"
    assert str(Exited(-9)) == "SIGKILL"


def test_messages_are_immutable() -> None:
    message: Any = Abort(land=True)
    with pytest.raises(ValidationError):
        message.land = False
