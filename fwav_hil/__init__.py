"""The top package: the command line, runs of two processes, in-process simulation, scores and reports."""

__version__ = "0.1.0"
