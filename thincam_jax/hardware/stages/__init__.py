"""Linear stages on a serial port: Zaber ASCII and GRBL."""
