"""USB3 Vision cameras over pyusb: GenCP for control, GenApi for the features, leader to trailer."""
