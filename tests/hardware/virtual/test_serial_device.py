"""Virtual stages: who can reach them, how they go and come back, and what they leave behind."""

import os
import stat
import threading

import pytest

from thincam_jax.hardware.base import Disconnected, NotHomed
from thincam_jax.hardware.stages.grbl import GrblStage
from thincam_jax.hardware.stages.zaber import ZaberStage
from thincam_jax.hardware.virtual.grbl import VirtualGrbl
from thincam_jax.hardware.virtual.serial_device import LONGEST_INPUT, Motion, VirtualSerialDevice
from thincam_jax.hardware.virtual.zaber import VirtualZaber

FAST = Motion(travel=10.0, start=2.0, speed=1000.0)
KINDS = pytest.mark.parametrize(
    ("driver", "virtual"), [(ZaberStage, VirtualZaber), (GrblStage, VirtualGrbl)],
    ids=["zaber", "grbl"],
)  # fmt: skip


def open_stage(driver, device: VirtualSerialDevice):
    return driver.open(driver.Options(port=str(device.port)))


@KINDS
def test_only_who_knows_the_folder_and_is_its_owner_reaches_the_port(driver, virtual):
    with virtual(FAST) as one, virtual(FAST) as other:
        folder = one.port.parent
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert stat.S_IMODE(one.port.stat().st_mode) == 0o600  # the terminal behind the link
        assert one.port.stat().st_uid == os.geteuid()
        secret = folder.name.removeprefix("thincam-")
        assert len(secret) == 32 and int(secret, 16) != int(other.port.parent.name[-32:], 16)


@KINDS
def test_no_stranger_opens_a_port_in_use(driver, virtual):
    with virtual(FAST) as device, open_stage(driver, device):
        terminal = os.path.realpath(device.port)  # a stranger lists /dev/pts, without the secret
        if os.geteuid() == 0:
            os.chown(terminal, 65534, -1)  # even if the mode let him in
            os.seteuid(65534)
        try:
            with pytest.raises(OSError, match="busy"):
                os.close(os.open(terminal, os.O_RDWR | os.O_NOCTTY))
        finally:
            if os.getuid() == 0:
                os.seteuid(0)


@KINDS
def test_closing_leaves_no_thread_no_file_and_no_descriptor(driver, virtual):
    descriptors, threads = os.listdir("/proc/self/fd"), threading.active_count()
    device = virtual(FAST)
    stage = open_stage(driver, device)
    device.faults.inject("unplug")
    with pytest.raises(Disconnected):
        while True:
            stage.homed  # noqa: B018
    stage.close()
    open_stage(driver, device).close()
    device.close()
    device.close()
    assert not device.port.parent.exists()
    assert threading.active_count() == threads
    assert len(os.listdir("/proc/self/fd")) == len(descriptors)


@KINDS
def test_unplugged_it_comes_back_at_the_same_path(driver, virtual):
    with virtual(FAST) as device:
        stage = open_stage(driver, device)
        stage.home()
        device.faults.inject("unplug")
        with pytest.raises(Disconnected):
            while True:
                stage.move_to(3.0)
        stage.close()
        with open_stage(driver, device) as again:
            if driver is GrblStage:  # its board restarts with the port, and has forgotten
                with pytest.raises(NotHomed):
                    again.position()
                again.home()
            assert again.position() == pytest.approx(device.true_position, abs=1e-3)


@KINDS
def test_input_without_an_end_is_not_kept(driver, virtual):
    with virtual(FAST) as device:
        port = os.open(device.port, os.O_RDWR | os.O_NOCTTY)
        for _ in range(20):
            os.write(port, b"7" * 1024)
            assert len(device._input) <= LONGEST_INPUT
        os.close(port)
        with open_stage(driver, device) as stage:  # and the next driver does not see it
            assert stage.limits[1] == pytest.approx(10.0, abs=1e-3)


@KINDS
def test_a_move_whose_answer_was_corrupted_is_not_sent_again_after_a_stop(driver, virtual):
    slow = Motion(travel=10.0, start=5.0, speed=20.0, latency=0.05)
    with virtual(slow) as device, open_stage(driver, device) as stage:
        stage.home()
        # the stop comes while the move's answer, late and spoilt, is still awaited
        stopper = threading.Timer(0.03, stage.stop)
        started = stage._start_move

        def start(position):
            device.faults.inject("latency")
            device.faults.inject("wrong_checksum")
            stopper.start()
            started(position)

        stage._start_move = start
        reached = stage.move_to(5.0)
        stopper.join()
        assert abs(reached - 5.0) > 0.1
        assert reached == pytest.approx(device.true_position, abs=1e-3)
