"""The Zaber driver against a virtual stage, and the vendor's own client against the same stage."""

import pytest

from thincam_jax.hardware.base import ProtocolError, Timeout
from thincam_jax.hardware.stages.zaber import ZaberMessage, ZaberStage, checksum, parse_message
from thincam_jax.hardware.virtual.serial_device import Motion
from thincam_jax.hardware.virtual.zaber import MICROSTEP, VirtualZaber, parse_command

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)


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


def test_a_device_that_sends_something_else_is_a_protocol_error(device):
    with pytest.raises((ProtocolError, Timeout)):
        ZaberStage.open(ZaberStage.Options(port=str(device.port), device=2, answer_time=0.01))


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
