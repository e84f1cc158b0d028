"""A stage moved by hand asks, takes what is read, and loses nothing when it is interrupted."""

import io
import itertools
import signal

import numpy as np
import pytest
from hardware.acquisition.test_faults import frames_in
from hardware.memory_rig import World, fiducial_plan

from thincam_jax.hardware.acquisition.acquire import Procedure, acquire
from thincam_jax.hardware.acquisition.read import Acquisition
from thincam_jax.hardware.base import NotFound, OutOfRange
from thincam_jax.hardware.preview import Preview
from thincam_jax.hardware.registry import open_device

PLAN = fiducial_plan(40, every=4, dark_every=16)


def reading(asked: float) -> float:
    """What the scale reads where a person moves the stage to a position."""
    return round(asked + 0.01 * np.sin(1 + asked), 4)


def read_at(question: str) -> float:
    """What it reads after a question."""
    return reading(float(question.partition(" to ")[2].split()[0]))


class Person:
    """Standard input: the answer to the last question; the `acts` come in place of one."""

    def __init__(self, monkeypatch, *acts):
        self.said, self.acts, self.asked = io.StringIO(), iter(acts), []
        monkeypatch.setattr("sys.stderr", self.said)
        monkeypatch.setattr("sys.stdin", self)

    def readline(self):
        self.asked.append(self.said.getvalue().splitlines()[-1])
        print(file=self.said)
        act = next(self.acts, None)
        if callable(act):
            return act()
        return f"{read_at(self.asked[-1])}\n" if act is None else act


@pytest.fixture
def stage():
    return open_device("stages", "manual", {"name": "the mask", "highest": 10.0})


def test_it_asks_and_takes_what_is_read(monkeypatch, stage):
    moved, person = [], Person(monkeypatch, "\n", "2,017 mm\n", "3\n", "x\n", "99\n", "1.1\n")
    stage._on_move = moved.append
    assert stage.homed and stage.limits == (0.0, 10.0)
    assert [stage.move_to(1.0), stage.position(), stage.move_to(1.0)] == [1.0] * 3
    assert [stage.move_to(2.0), stage.move_to(1.0), stage.position()] == [2.017, 1.1, 1.1]
    assert moved == [1.0, 2.017, 1.1]
    first, second, third, *again = person.asked
    assert first == (
        "Move the mask to 1 mm, then press Enter; or type what it reads (q to stop: nothing is "
        "lost): "
    )
    assert second.startswith("Move the mask to 2 mm") and third.startswith("Move the mask to 1 mm")
    assert again == [
        "3 mm is farther than 0.5 mm from 1 mm; type it again: ",
        "'x' is no position in mm, such as 0.125; type it again: ",
        "99 mm is off the scale, 0 to 10 mm; type it again: ",
    ]
    with pytest.raises(OutOfRange, match="11 mm; give a position from 0 to 10 mm, or its options"):
        stage.move_to(11.0)


def test_where_it_stands_is_asked_before_its_first_move(monkeypatch, stage):
    person = Person(monkeypatch, "\n", "nan\n", "0.3\n")
    assert stage.position() == stage.position() == 0.3
    assert len(person.asked) == 3 and person.asked[0].startswith("Type where the mask stands")


@pytest.mark.parametrize("ended", [None, io.StringIO()])
def test_nobody_answers(monkeypatch, stage, ended):
    """Standard input is closed, or /dev/null."""
    monkeypatch.setattr("sys.stdin", ended)
    with pytest.raises(NotFound, match="nobody answers: standard input has ended; begin it in a"):
        stage.move_to(1.0)


def test_a_number_that_is_none_is_refused():
    with pytest.raises(ValueError, match="give lowest below highest"):
        open_device("stages", "manual", {"lowest": 3.0, "highest": 3.0})


def begin(path, progress=None):
    with World().rig(manual=True) as rig:
        return acquire(PLAN, rig, path, procedure=Procedure(reopen_wait=0.0), progress=progress)


def require_unbroken(monkeypatch, tmp_path, store):
    """The frames and positions are those of a run without an interruption."""
    Person(monkeypatch)
    assert begin(tmp_path / "whole").complete
    first, second = (Acquisition.load(path) for path in (tmp_path / "whole", store))
    for number in range(len(PLAN.steps)):
        np.testing.assert_array_equal(first.frame(number), second.frame(number))
    places = [[shot["position"] for shot in one.shots] for one in (first, second)]
    assert places[0] == places[1]
    asked = [step.position for step in PLAN.steps]
    assert np.abs(np.subtract(places[1], asked)).max() > 0.009
    assert first.distances == second.distances


def interrupt(number=signal.SIGINT):
    signal.raise_signal(number)
    return "never returned\n"


def test_twenty_interruptions_lose_nothing(monkeypatch, tmp_path):
    """At a question by q, Ctrl-C, SIGTERM and the end of input, and after a frame."""
    store, random, stops, kept = tmp_path / "store", np.random.default_rng(2), 0, 0
    acts = ("q\n", interrupt, lambda: interrupt(signal.SIGTERM), lambda: "", None)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for act in itertools.chain(*[acts] * 4):
            Person(monkeypatch, *[None] * int(random.integers(0, 2)), act)
            most = 1 + random.integers(0, 4) if act is None else 99
            count = itertools.count(1)
            stop = lambda _, count=count, most=most: next(count) == most and interrupt()  # noqa: E731
            try:
                assert not begin(store, stop).complete
            except (KeyboardInterrupt, NotFound):
                assert act is not None
            stops += 1
            kept, before_it = frames_in(store), kept
            assert kept >= before_it
    finally:
        signal.signal(signal.SIGINT, before)
    assert stops == 20 and 0 < kept < len(PLAN.steps)
    Person(monkeypatch)
    assert begin(store).complete
    require_unbroken(monkeypatch, tmp_path, store)


def test_a_resumed_run_offers_what_was_read(monkeypatch, tmp_path):
    store, count = tmp_path / "store", itertools.count(1)
    Person(monkeypatch)
    stop = lambda _: next(count) == 6 and interrupt(signal.SIGTERM)  # noqa: E731
    assert not begin(store, stop).complete
    person = Person(monkeypatch, "\n")
    assert begin(store).complete
    assert person.asked[0].startswith(f"Move the stage to 1 mm, where it read {reading(1):g} mm, ")
    assert "read" not in person.asked[1].partition(";")[0]
    require_unbroken(monkeypatch, tmp_path, store)


def test_a_preview_leaves_it_to_its_person(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    with World().rig(manual=True) as rig:
        preview = Preview(rig, PLAN)
        assert "position" not in preview.values and preview.view().pictures
