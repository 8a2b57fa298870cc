"""The controller as a ground station sees it."""
