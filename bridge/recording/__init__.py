"""Recording and replay of what passes over a link."""
