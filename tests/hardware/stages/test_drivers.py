"""Both stage drivers against their virtual machines: what every stage does."""

import math
import threading

import pytest
from stage_faults import STAGES

from thincam_jax.hardware.base import Busy, NotHomed, OutOfRange, ProtocolError, Timeout
from thincam_jax.hardware.stages import serial_stage
from thincam_jax.hardware.virtual.grbl import PULL_OFF
from thincam_jax.hardware.virtual.serial_device import Motion
from thincam_jax.hardware.virtual.zaber import MICROSTEP

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)
SLOW = Motion(travel=10.0, start=5.0, speed=20.0)
STEP = 1e-3  # mm: a microstep, and the digits of GRBL's positions


@pytest.fixture(params=STAGES)
def kind(request):
    return request.param


@pytest.fixture
def connect(kind):
    """Opens the driver of a virtual machine."""
    driver = STAGES[kind][0]
    return lambda device, **options: driver.open(driver.Options(port=str(device.port), **options))


@pytest.fixture
def device(kind):
    with STAGES[kind][1](FAST) as device:
        yield device


@pytest.fixture
def stage(connect, device, tmp_path):
    with connect(device, wire_log=str(tmp_path / "wire.txt")) as stage:
        yield stage


@pytest.fixture
def slow(kind, connect):
    with STAGES[kind][1](SLOW) as device, connect(device) as stage:
        stage.home()
        yield device, stage


@pytest.mark.parametrize(
    ("kind", "options", "home", "step"),
    [
        ("zaber", {}, 0.0, MICROSTEP / 2),
        ("grbl", {}, 10.0 - PULL_OFF, 5e-4),
        ("grbl", {"speed": 500.0}, 10.0 - PULL_OFF, 5e-4),
    ],
)
def test_it_stands_where_it_says_once_it_was_homed(device, connect, options, home, step):
    with connect(device, **options) as stage:
        stage.home()
        stage.home(timeout=1.0)  # at the switch already
        assert stage.position() == device.true_position == home
        for target in (*stage.limits, 1.23456):
            reached = stage.move_to(target)
            assert reached == pytest.approx(target, abs=step + 1e-9)
            assert stage.position() == reached == pytest.approx(device.true_position, abs=1e-9)


def test_before_homing_nothing_is_known_and_nothing_moves(device, stage):
    assert not stage.homed
    with pytest.raises(NotHomed, match="; home it first"):
        stage.position()
    with pytest.raises(NotHomed):
        stage.move_to(1.0)
    assert device.true_position == 2.0


@pytest.mark.parametrize("position", [-0.001, 10.001, math.nan, math.inf])
def test_outside_of_its_limits_nothing_is_sent(stage, tmp_path, position):
    stage.home()
    sent = (tmp_path / "wire.txt").read_text("utf-8")
    with pytest.raises(OutOfRange, match=r"give a position from 0 to (10|9\.99\d*) mm"):
        stage.move_to(position)
    assert (tmp_path / "wire.txt").read_text("utf-8") == sent


def test_stopped_from_another_thread_it_returns_where_it_stands(slow):
    device, stage = slow
    start = stage.move_to(5.0)
    stopper = threading.Timer(0.05, stage.stop)
    stopper.start()
    reached = stage.move_to(9.0)
    stopper.join()
    assert start < reached < 9.0
    assert reached == pytest.approx(device.true_position, abs=STEP)
    assert stage.homed and stage.move_to(5.0) == pytest.approx(5.0, abs=STEP)


def test_lost_steps_are_reported_until_it_is_homed(kind, device, stage):
    cause = {"zaber": r"it stalled and stopped \(FS\)",
             "grbl": r"its motor raised the alarm \(alarm 1\)"}[kind]  # fmt: skip
    stage.home()
    stage.move_to(5.0)
    device.faults.inject("lost_steps")
    with pytest.raises(NotHomed, match=cause):
        stage.move_to(1.0)
    for _ in range(2):
        with pytest.raises(NotHomed):
            stage.position()
    stage.home()
    stage.move_to(1.0)
    assert device.true_position == pytest.approx(1.0, abs=STEP)


def test_refused_for_long_it_is_busy_and_for_good_a_protocol_error(device, stage, monkeypatch):
    monkeypatch.setattr(serial_stage, "LONGEST_REFUSAL", 0.02)
    device.faults.inject("busy", 1000)
    with pytest.raises(Busy, match="STATUSBUSY|not idle"):
        stage.home()
    while device.faults.due("busy"):
        pass
    stage.home()
    device.faults.inject("nak")
    with pytest.raises(ProtocolError, match="refused: (BADCOMMAND|error 3)"):
        stage.move_to(1.0)


def test_corrupted_answers_are_asked_for_again_but_not_for_ever(device, stage):
    stage.home()
    for _ in range(20):
        device.faults.inject("wrong_checksum")
        assert stage.position() == pytest.approx(device.true_position, abs=STEP)
    device.faults.inject("wrong_checksum", 50)
    with pytest.raises((ProtocolError, Timeout)):
        stage.position()


def test_late_answers_are_not_taken_for_those_to_later_commands(kind, connect):
    with STAGES[kind][1](Motion(travel=10.0, speed=1000.0, latency=0.1)) as device:
        with connect(device) as stage:
            stage.home()
            stage._options = type(stage).Options(port="", answer_time=0.06)
            device.faults.inject("latency")
            stage.move_to(3.0)
            device.faults.inject("latency")
            assert stage.move_to(7.0) == pytest.approx(device.true_position, abs=STEP)


def test_too_slow_it_is_stopped(slow):
    device, stage = slow
    stage.move_to(5.0)
    with pytest.raises(Timeout, match="not there within 0.05 s"):
        stage.move_to(9.0, timeout=0.05)
    stood = device.true_position
    assert stage.position() == pytest.approx(stood, abs=STEP)
    assert device.true_position == stood
    with pytest.raises(Timeout):
        stage.home(timeout=0.0)
    assert not stage.homed  # it stopped half-way
    stage.home()
    assert stage.position() == pytest.approx(device.true_position, abs=STEP)
