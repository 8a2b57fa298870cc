"""Control laws and the reference that they follow."""
