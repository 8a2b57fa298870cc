"""How late everything is: legs of the closed loop, probes of a link, other programs beside it."""
