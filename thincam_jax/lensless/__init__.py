"""The lensless camera: a coded mask at a distance in front of a sensor."""
