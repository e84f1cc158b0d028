"""Parts that all cameras share: scenes, sensors, targets, operators, metrics."""
