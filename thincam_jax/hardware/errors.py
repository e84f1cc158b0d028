"""Errors of devices, each with what was tried, why it failed and what to do."""


class HardwareError(Exception):
    """A device failed: `device`, `operation`, `cause` and `remedy` are one line each.

    A driver raises one of the subclasses below. What an acquisition does about it follows from the
    class: `IncompleteFrame` and `Timeout` are tried again, `Disconnected` reopens the device, all
    others stop the run so that it can be resumed.
    """

    def __init__(self, device: str, operation: str, cause: str, remedy: str):
        super().__init__(device, operation, cause, remedy)
        self.device, self.operation, self.cause, self.remedy = device, operation, cause, remedy

    def __str__(self) -> str:
        return f"{self.device}: {self.operation}: {self.cause}; {self.remedy}"


class NotFound(HardwareError):
    """No such device is connected, or the library of its driver is not installed."""


class PermissionDenied(HardwareError):
    """This user may not open the device; the remedy names the udev rule or the group."""


class Busy(HardwareError):
    """Another program holds the device, named where the system tells."""


class Timeout(HardwareError):
    """The device did not answer, or no frame came, within the time allowed."""


class Disconnected(HardwareError):
    """The device was there and has gone: unplugged, switched off or reset."""


class ProtocolError(HardwareError):
    """The device answered what its protocol does not allow: checksum, id, length or content."""


class IncompleteFrame(HardwareError):
    """A frame came with bytes missing, or its trailer says that it is not whole."""


class OutOfRange(HardwareError):
    """A position, exposure, region or pattern that the device cannot take; nothing was sent."""


class Saturated(HardwareError):
    """More pixels at the largest count than the plan allows."""


class NotHomed(HardwareError):
    """The stage does not know where it is: it was not homed, or it lost steps."""
