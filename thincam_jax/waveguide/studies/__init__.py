"""Studies of captures through a screen: its models, its calibration, a mask for its lens."""
