"""Reading logs: `fwav-hil log info`, `dump`, `plot`, `export`."""
