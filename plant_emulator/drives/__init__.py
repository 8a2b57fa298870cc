"""Motor drives on a CAN bus."""
