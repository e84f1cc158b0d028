"""The drivers of GRBL and Zaber against virtual machines."""

import threading
import time

import pytest

from thincam_jax.hardware.base import Disconnected, NotHomed, ProtocolError
from thincam_jax.hardware.stages import grbl
from thincam_jax.hardware.stages.grbl import GrblMessage, GrblStage, parse_line
from thincam_jax.hardware.stages.zaber import ZaberMessage, ZaberStage, parse_message
from thincam_jax.hardware.virtual.grbl import VirtualGrbl
from thincam_jax.hardware.virtual.serial_device import Motion
from thincam_jax.hardware.virtual.zaber import MICROSTEP, VirtualZaber, parse_command

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


@pytest.fixture
def device():
    with VirtualZaber(FAST) as device:
        yield device


def test_every_message_has_a_number_and_a_checksum_both_ways(device, tmp_path):
    log = tmp_path / "wire.txt"
    with ZaberStage.open(ZaberStage.Options(str(device.port), wire_log=str(log))) as stage:
        stage.home()
    lines = log.read_text("utf-8").splitlines()[2:]  # after checksums are switched on
    sent = [eval(line.split(" ", 2)[2]).strip() for line in lines if " > " in line]
    received = [eval(line.split(" ", 2)[2]).strip() for line in lines if " < " in line]
    assert all(parse_command(line).words for line in sent)
    answers = [parse_message(line) for line in received]
    assert all(answer.checked for answer in answers)
    numbers = [int(parse_command(line).number) for line in sent]
    assert numbers == [answer.number for answer in answers] == list(range(2, 2 + len(numbers)))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"@01 1 07 OK BUSY -- 0:E0", ZaberMessage("@", 1, 1, 7, True, True, "--", "0", True)),
        (b"@01 0 OK IDLE WR 7.38", ZaberMessage("@", 1, 0, None, True, False, "WR", "7.38", False)),
        (b"@01 1 99 RJ IDLE FS BADDATA",
         ZaberMessage("@", 1, 1, 99, False, False, "FS", "BADDATA", False)),
        (b"!01 1 IDLE --", ZaberMessage("!", 1, 1, None, False, False, "--", "", False)),
        (b"#01 0 help text", ZaberMessage("#", 1, 0, None, False, False, "--", "help text", False)),
    ],
)  # fmt: skip
def test_lines_of_the_protocol_manual(line, message):
    assert parse_message(line) == message


@pytest.mark.parametrize(
    "line",
    [b"", b"@", b"@01 1 07 OK BUSY -- 0:00", b"@01 1 07 BUSY -- 0", b"/01 1 home", b"!01 1",
     b"@01 1 07 OK BUSY -- 0:E", b"@01 1 07 OK BUSY -- \xff", b"@01 1 OK IDLE -- " + b"0" * 600],
)  # fmt: skip
def test_other_lines_are_protocol_errors_of_zaber(line):
    with pytest.raises(ProtocolError):
        parse_message(line)


def test_the_vendors_client_drives_the_virtual_stage(device):
    ascii_ = pytest.importorskip("zaber_motion.ascii", reason="needs zaber-motion of PyPI")
    from zaber_motion.exceptions import BadDataException

    with ascii_.Connection.open_serial_port(str(device.port), direct=True) as connection:
        (found,) = connection.detect_devices(identify_devices=False)  # it would ask its web service
        found.generic_command("set comm.checksum 1")  # from here on it checks those of the device
        axis = found.get_axis(1)
        assert not axis.is_homed()
        axis.home()
        assert axis.is_homed() and axis.get_position() == 0.0
        axis.move_absolute(20000)
        assert axis.get_position() == 20000
        assert device.true_position == pytest.approx(20000 * MICROSTEP)
        with pytest.raises(BadDataException):
            axis.move_absolute(10**8)
        axis.stop()
        assert axis.warnings.get_flags() == set()
