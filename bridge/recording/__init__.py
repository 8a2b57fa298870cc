"""Recording and replay of the frames on a link."""
