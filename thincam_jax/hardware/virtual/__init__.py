"""Virtual devices: the optics of this package, served through the real protocols, with faults."""
