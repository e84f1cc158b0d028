"""Errors of devices, each with operation, cause and remedy."""


class HardwareError(Exception):
    """A device failed: `device`, `operation`, `cause` and `remedy` are one line each.

    Drivers raise the subclasses below. An acquisition retries after `IncompleteFrame` and
    `Timeout`, reopens the device after `Disconnected`, and stops, to be resumed, after all others.
    """

    def __init__(self, device: str, operation: str, cause: str, remedy: str):
        super().__init__(device, operation, cause, remedy)
        self.device, self.operation, self.cause, self.remedy = device, operation, cause, remedy

    def __str__(self) -> str:
        return f"{self.device}: {self.operation}: {self.cause}; {self.remedy}"


class NotFound(HardwareError):
    """No such device is connected, or the library of its driver is not installed."""


class PermissionDenied(HardwareError):
    """This user may not open the device; the remedy names a udev rule or a group."""


class Busy(HardwareError):
    """Another program, named if known, holds the device."""


class Timeout(HardwareError):
    """The device did not answer, or no frame came, within the time allowed."""


class Disconnected(HardwareError):
    """The device was unplugged, switched off or reset."""


class ProtocolError(HardwareError):
    """The answer violates the protocol: its checksum, id, length or content."""


class IncompleteFrame(HardwareError):
    """Part of a frame is missing, or its trailer says so."""


class OutOfRange(HardwareError):
    """A position, exposure, region or pattern outside the device's limits; nothing was sent."""


class Saturated(HardwareError):
    """More saturated pixels than allowed."""


class NotHomed(HardwareError):
    """The stage's position is unknown: it was not homed, or it lost steps."""
