"""From a design's file to designs found, and what the full simulation says of them."""
