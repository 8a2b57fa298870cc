"""Commands that start one end alone."""
