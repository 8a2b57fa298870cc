"""Logs replayed: to a link in time, into a controller or an emulator with a comparison; and two logs compared."""
