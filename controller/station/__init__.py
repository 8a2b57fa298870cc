"""The controller towards a ground station."""
