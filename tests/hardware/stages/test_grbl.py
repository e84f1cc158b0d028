"""The GRBL driver against a virtual machine."""

import threading
import time

import pytest

from thincam_jax.hardware.base import Disconnected, NotHomed, ProtocolError
from thincam_jax.hardware.stages import grbl
from thincam_jax.hardware.stages.grbl import GrblMessage, GrblStage, parse_line
from thincam_jax.hardware.virtual.grbl import VirtualGrbl
from thincam_jax.hardware.virtual.serial_device import Motion

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)


def open_stage(device: VirtualGrbl, **options) -> GrblStage:
    return GrblStage.open(GrblStage.Options(port=str(device.port), **options))


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


def test_a_board_that_restarts_is_disconnected_and_not_homed():
    with VirtualGrbl(FAST) as device, open_stage(device) as stage:
        stage.home()
        stage._link.write(grbl.RESET, time.monotonic() + 1.0)  # as its button would
        with pytest.raises(Disconnected, match="it was reset"):
            stage.position()
        with pytest.raises(NotHomed, match="it was reset"):
            stage.position()


@pytest.mark.parametrize(
    ("settings", "message"),
    [({22: "0"}, "cannot home"), ({10: "0"}, "no machine positions"), ({13: "1"}, "in mm"),
     ({100: "0"}, "no limits")],
)  # fmt: skip
def test_settings_that_cannot_work_are_refused_at_once(settings, message, monkeypatch):
    usual = VirtualGrbl._settings
    monkeypatch.setattr(VirtualGrbl, "_settings", lambda self: {**usual(self), **settings})
    with VirtualGrbl(FAST) as device, pytest.raises(ProtocolError, match=message):
        open_stage(device)


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
