"""Time: the clock, fixed rates, real-time settings, time synchronisation."""
