"""The GRBL driver against a virtual machine."""

import math
import threading
import time

import pytest

from thincam_jax.hardware import (
    Busy,
    Disconnected,
    Identity,
    NotHomed,
    OutOfRange,
    ProtocolError,
    Timeout,
    open_device,
)
from thincam_jax.hardware.stages import grbl
from thincam_jax.hardware.stages.grbl import GrblMessage, GrblStage, parse_line
from thincam_jax.hardware.virtual.grbl import PULL_OFF, VirtualGrbl
from thincam_jax.hardware.virtual.serial_device import Motion

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)
SLOW = Motion(travel=10.0, start=9.5, speed=40.0)


def open_stage(device: VirtualGrbl, **options) -> GrblStage:
    return GrblStage.open(GrblStage.Options(port=str(device.port), **options))


@pytest.fixture
def device():
    with VirtualGrbl(FAST) as device:
        yield device


@pytest.fixture
def stage(device, tmp_path):
    with open_stage(device, wire_log=str(tmp_path / "wire.txt")) as stage:
        yield stage


def test_it_is_opened_by_name_and_names_itself(device):
    with open_device("stages", "grbl", {"port": str(device.port)}) as stage:
        assert stage.identity == Identity("GRBL", "axis X", "virtual", "1.1h.20190830")
        assert stage.limits == (0.0, 10.0)


@pytest.mark.parametrize("speed", [None, 500.0])
def test_it_goes_where_it_is_sent_and_is_there_when_it_says_so(device, speed):
    with open_stage(device, speed=speed) as stage:
        stage.home()
        assert stage.position() == device.true_position == 10.0 - PULL_OFF
        for target in (*stage.limits, 1.234):
            assert stage.move_to(target) == pytest.approx(target, abs=1e-9)
            assert stage.position() == pytest.approx(device.true_position, abs=1e-3)


def test_queued_is_not_there():
    with VirtualGrbl(SLOW) as device, open_stage(device) as stage:
        stage.home()
        stage.move_to(8.0)
        assert device.true_position == pytest.approx(8.0, abs=1e-3)


def test_nothing_is_known_and_nothing_moves_before_it_is_homed(device, stage):
    assert not stage.homed
    with pytest.raises(NotHomed, match="home it first"):
        stage.position()
    with pytest.raises(NotHomed):
        stage.move_to(1.0)
    assert device.true_position == 2.0


@pytest.mark.parametrize("position", [-0.001, 10.001, math.nan, math.inf])
def test_outside_of_its_limits_nothing_is_sent(stage, tmp_path, position):
    stage.home()
    sent = (tmp_path / "wire.txt").read_text("utf-8")
    with pytest.raises(OutOfRange, match="give a position from 0 to 10 mm"):
        stage.move_to(position)
    assert (tmp_path / "wire.txt").read_text("utf-8") == sent


def test_stopped_from_another_thread_it_knows_where_it_stands():
    with VirtualGrbl(SLOW) as device, open_stage(device) as stage:
        stage.home()
        stopper = threading.Timer(0.05, stage.stop)
        stopper.start()
        reached = stage.move_to(1.0)
        stopper.join()
        assert 1.0 < reached < 9.0
        assert reached == pytest.approx(device.true_position, abs=1e-3)
        assert stage.homed and stage.move_to(8.0) == pytest.approx(8.0, abs=1e-3)


def test_homing_is_stopped_from_another_thread_too():
    with VirtualGrbl(Motion(travel=10.0, start=1.0, speed=20.0)) as device:
        with open_stage(device) as stage:
            stopper = threading.Timer(0.1, stage.stop)
            stopper.start()
            with pytest.raises(NotHomed):
                stage.home()
            stopper.join()
            assert device.true_position < 9.0 and not stage.homed
            stage.home()
            assert stage.position() == pytest.approx(device.true_position, abs=1e-3)


def test_too_slow_it_is_stopped():
    with VirtualGrbl(SLOW) as device, open_stage(device) as stage:
        stage.home()
        with pytest.raises(Timeout, match="not there within 0.05 s"):
            stage.move_to(1.0, timeout=0.05)
        stood = device.true_position
        assert stage.position() == pytest.approx(stood, abs=1e-3)
        assert device.true_position == stood
        stage.move_to(2.0)
        with pytest.raises(Timeout):
            stage.home(timeout=0.1)
        assert not stage.homed
        stage.home()
        assert stage.position() == pytest.approx(device.true_position, abs=1e-3)


def test_an_alarm_of_the_motor_is_told_and_homing_ends_it(device, stage):
    stage.home()
    device.faults.inject("lost_steps")
    with pytest.raises(NotHomed, match=r"its motor raised the alarm \(alarm 1\)"):
        stage.move_to(1.0)
    with pytest.raises(NotHomed):
        stage.position()
    stage.home()
    stage.move_to(1.0)
    assert device.true_position == pytest.approx(1.0, abs=1e-3)


def test_a_board_that_restarts_is_disconnected_and_not_homed(device, stage):
    stage.home()
    stage._link.write(grbl.RESET, time.monotonic() + 1.0)  # as its button would
    with pytest.raises(Disconnected, match="it was reset"):
        stage.position()
    with pytest.raises(NotHomed, match="it was reset"):
        stage.position()


def test_not_idle_for_long_it_is_busy_and_refused_a_protocol_error(device, stage, monkeypatch):
    monkeypatch.setattr(grbl, "LONGEST_REFUSAL", 0.02)
    device.faults.inject("busy", 1000)
    with pytest.raises(Busy, match="not idle"):
        stage.home()
    while device.faults.due("busy"):
        pass
    stage.home()
    device.faults.inject("nak")
    with pytest.raises(ProtocolError, match="refused: error 3"):
        stage.move_to(1.0)


def test_a_position_counts_when_it_was_read_twice_alike(device, stage):
    stage.home()
    for _ in range(20):  # another digit each time, without any checksum
        device.faults.inject("wrong_checksum")
        assert stage.position() == pytest.approx(device.true_position, abs=1e-3)
    device.faults.inject("wrong_checksum", 50)
    with pytest.raises((ProtocolError, Timeout)):
        stage.position()


def test_late_answers_are_not_taken_for_those_to_later_commands():
    with VirtualGrbl(Motion(travel=10.0, speed=1000.0, latency=0.1)) as device:
        with open_stage(device) as stage:
            stage.home()
            stage._options = GrblStage.Options(port="", answer_time=0.06)
            device.faults.inject("latency")
            stage.move_to(3.0)
            device.faults.inject("latency")
            assert stage.move_to(7.0) == pytest.approx(device.true_position, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({22: "0"}, "cannot home"), ({10: "0"}, "no machine positions"), ({13: "1"}, "in mm"),
     ({100: "0"}, "no limits")],
)  # fmt: skip
def test_settings_that_cannot_work_are_told_at_once(settings, message, monkeypatch):
    usual = VirtualGrbl._settings
    monkeypatch.setattr(VirtualGrbl, "_settings", lambda self: {**usual(self), **settings})
    with VirtualGrbl(FAST) as device, pytest.raises(ProtocolError, match=message):
        open_stage(device)


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"answer_time": -1.0}])
def test_options_that_cannot_be_are_refused(options):
    with pytest.raises(ValueError, match="give more than 0"):
        GrblStage.Options(port="", **options)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"ok", GrblMessage("ok")),
        (b"error:11", GrblMessage("error", 11)),
        (b"ALARM:1", GrblMessage("alarm", 1)),
        (b"Grbl 1.1h ['$' for help]", GrblMessage("banner", text="1.1h ['$' for help]")),
        (b"$130=200.000", GrblMessage("setting", 130, 200.0)),
        (b"[MSG:Caution: Unlocked]", GrblMessage("feedback", text="[MSG:Caution: Unlocked]")),
        (b"", GrblMessage("feedback")),
        (b"<Idle|MPos:0.000,-3.500,10.250|FS:0,0|WCO:0.000,1.000,2.000>",
         GrblMessage("status", state="Idle", position=(0.0, -3.5, 10.25))),
        (b"<Hold:1|WPos:1.000,2.000,3.000|Pn:XYZ>", GrblMessage("status", state="Hold:1")),
    ],
)  # fmt: skip
def test_lines_of_the_interface(line, message):
    assert parse_line(line) == message


@pytest.mark.parametrize(
    "line",
    [b"o\xffk", b"okok", b"error:", b"error:1e3", b"<Idle|MPos:nan,0.000,0.000>", b"<Idle",
     b"<Idle|MPos:1e99,0.000,0.000>", b"$130=inf", b"Grbl", b"[" + b"a" * 600 + b"]"],
)  # fmt: skip
def test_other_lines_are_protocol_errors(line):
    with pytest.raises(ProtocolError):
        parse_line(line)
