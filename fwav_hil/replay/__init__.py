"""Replay of logs to a link, or into a controller or an emulator with a comparison; comparison of two logs."""
