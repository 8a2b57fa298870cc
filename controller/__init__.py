"""The controller: reference, laws, and the process that reads positions and publishes commands."""
