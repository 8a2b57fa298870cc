"""Latency: segments of the closed loop, probes of a link, other programs for comparison."""
