"""How a message travels and when: links, clocks, rate keeping, routing, recording, replay, faults, latency."""
