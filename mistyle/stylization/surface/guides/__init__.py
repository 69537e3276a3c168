"""What each surface point asks of the painting: tone, colour, direction."""
