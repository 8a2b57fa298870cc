"""Links: one end of a byte link, with the same interface for every transport."""
