"""How time is kept between the emulator and its peer."""
