"""Where pose samples come from."""
