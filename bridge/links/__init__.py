"""Links: one end of a byte link each, the same face for every transport."""
