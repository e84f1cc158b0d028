"""What every camera shares: scenes, sensors, targets, operators, metrics."""
