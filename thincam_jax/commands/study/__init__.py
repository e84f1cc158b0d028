"""A configured study: captures, reconstructions, metrics and a report."""
