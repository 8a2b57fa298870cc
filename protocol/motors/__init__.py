"""Motor protocols on CAN."""
