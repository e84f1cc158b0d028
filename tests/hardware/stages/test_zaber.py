"""The Zaber driver against a virtual stage, and the vendor's own client against the same stage."""

import math
import threading

import pytest

from thincam_jax.hardware import (
    Busy,
    Identity,
    NotHomed,
    OutOfRange,
    ProtocolError,
    Timeout,
    open_device,
)
from thincam_jax.hardware.stages import zaber
from thincam_jax.hardware.stages.zaber import ZaberMessage, ZaberStage, checksum, parse_message
from thincam_jax.hardware.virtual.serial_device import Motion
from thincam_jax.hardware.virtual.zaber import MICROSTEP, VirtualZaber, parse_command

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)


def open_stage(device: VirtualZaber, **options) -> ZaberStage:
    return ZaberStage.open(ZaberStage.Options(port=str(device.port), **options))


@pytest.fixture
def device():
    with VirtualZaber(FAST) as device:
        yield device


@pytest.fixture
def stage(device, tmp_path):
    with open_stage(device, wire_log=str(tmp_path / "wire.txt")) as stage:
        yield stage


def test_it_is_opened_by_name_and_names_itself(device):
    with open_device("stages", "zaber", {"port": str(device.port)}) as stage:
        assert stage.identity == Identity("Zaber", "device 50081", "12345", "7.38")
        assert stage.limits == (0.0, pytest.approx(10.0, abs=MICROSTEP))


def test_it_goes_where_it_is_sent_to_a_microstep(device, stage):
    stage.home()
    assert stage.position() == device.true_position == 0.0
    for target in (*stage.limits, 1.23456):
        reached = stage.move_to(target)
        assert reached == pytest.approx(target, abs=MICROSTEP / 2 + 1e-9)
        assert stage.position() == reached == pytest.approx(device.true_position, abs=1e-9)


def test_homing_where_it_stands_at_the_switch_ends(stage):
    stage.home()
    stage.home(timeout=1.0)
    assert stage.position() == 0.0


def test_nothing_is_known_and_nothing_moves_before_it_is_homed(device, stage):
    assert not stage.homed
    with pytest.raises(NotHomed, match=r"no reference position \(WR\); home it first"):
        stage.position()
    with pytest.raises(NotHomed):
        stage.move_to(1.0)
    assert device.true_position == 2.0


@pytest.mark.parametrize("position", [-0.001, 10.001, math.nan, math.inf])
def test_outside_of_its_limits_nothing_is_sent(stage, tmp_path, position):
    stage.home()
    sent = (tmp_path / "wire.txt").read_text("utf-8")
    with pytest.raises(OutOfRange, match="give a position from 0 to 9.99"):
        stage.move_to(position)
    assert (tmp_path / "wire.txt").read_text("utf-8") == sent


def test_every_message_has_a_number_and_a_checksum_both_ways(stage, tmp_path):
    stage.home()
    lines = (
        (tmp_path / "wire.txt").read_text("utf-8").splitlines()[2:]
    )  # after checksums are switched on
    sent = [eval(line.split(" ", 2)[2]).strip() for line in lines if " > " in line]
    received = [eval(line.split(" ", 2)[2]).strip() for line in lines if " < " in line]
    assert all(parse_command(line).words for line in sent)
    answers = [parse_message(line) for line in received]
    assert all(answer.checked for answer in answers)
    numbers = [int(parse_command(line).number) for line in sent]
    assert numbers == [answer.number for answer in answers] == list(range(2, 2 + len(numbers)))


def test_stopped_from_another_thread_it_returns_where_it_stands():
    with VirtualZaber(Motion(travel=10.0, start=0.0, speed=20.0)) as device:
        with open_stage(device) as stage:
            stage.home()
            stopper = threading.Timer(0.05, stage.stop)
            stopper.start()
            reached = stage.move_to(9.0)
            stopper.join()
            assert 0.0 < reached < 9.0
            assert reached == pytest.approx(device.true_position, abs=MICROSTEP)
            assert stage.homed and stage.move_to(0.5) == pytest.approx(0.5, abs=MICROSTEP)


def test_too_slow_it_is_stopped():
    with VirtualZaber(Motion(travel=10.0, start=0.0, speed=5.0)) as device:
        with open_stage(device) as stage:
            stage.home()
            with pytest.raises(Timeout, match="not there within 0.05 s"):
                stage.move_to(9.0, timeout=0.05)
            stood = device.true_position
            assert stage.position() == pytest.approx(stood, abs=MICROSTEP)
            assert device.true_position == stood
            with pytest.raises(Timeout, match="no reference found"):
                stage.home(timeout=0.0)
            assert not stage.homed  # it stopped half-way


def test_steps_lost_are_told_and_homing_finds_them_again(device, stage):
    stage.home()
    device.faults.inject("lost_steps")
    with pytest.raises(NotHomed, match=r"it stalled and stopped \(FS\)"):
        stage.move_to(8.0)
    for _ in range(2):
        with pytest.raises(NotHomed, match="FS"):
            stage.position()
    stage.home()
    stage.move_to(8.0)
    assert device.true_position == pytest.approx(8.0, abs=MICROSTEP)


def test_refused_for_long_it_is_busy_and_for_good_a_protocol_error(device, stage, monkeypatch):
    monkeypatch.setattr(zaber, "LONGEST_REFUSAL", 0.02)
    device.faults.inject("busy", 1000)
    with pytest.raises(Busy, match="STATUSBUSY"):
        stage.stop()
    while device.faults.due("busy"):
        pass
    device.faults.inject("nak")
    with pytest.raises(ProtocolError, match="refused: BADCOMMAND"):
        stage.stop()


def test_spoilt_thrice_the_answer_is_given_up(device, stage):
    device.faults.inject("wrong_checksum", 2)
    stage.stop()
    device.faults.inject("wrong_checksum", 50)
    with pytest.raises((ProtocolError, Timeout)):
        stage.stop()


def test_late_answers_are_not_taken_for_those_to_later_commands():
    with VirtualZaber(Motion(travel=10.0, speed=1000.0, latency=0.05)) as device:
        with open_stage(device, answer_time=0.03) as stage:
            stage.home()
            device.faults.inject("latency")
            stage.move_to(3.0)
            device.faults.inject("latency")
            assert stage.move_to(7.0) == pytest.approx(device.true_position, abs=MICROSTEP)


def test_a_device_that_sends_something_else_is_a_protocol_error(device):
    with pytest.raises((ProtocolError, Timeout)):
        ZaberStage.open(ZaberStage.Options(port=str(device.port), device=2, answer_time=0.01))


def test_options_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="give more than 0; the data sheet"):
        ZaberStage.Options(port="", microstep=0.0)


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
def test_other_lines_are_protocol_errors(line):
    with pytest.raises(ProtocolError):
        parse_message(line)


def test_checksum_as_the_vendor_computes_it():
    # sent by the vendor's client, zaber-motion 10.3
    assert [checksum(b"1 1 01 home"), checksum(b"1 1 02 move abs 100")] == [0x34, 0x1E]


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
