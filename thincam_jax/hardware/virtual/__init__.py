"""Virtual devices: the optics of this package behind the real protocols, with faults."""
