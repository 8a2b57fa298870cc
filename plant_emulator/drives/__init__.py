"""Motor drives behind a CAN bus."""
