"""Benchmarks, each beside its anchor in the same run: `make bench`."""
