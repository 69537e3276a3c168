"""An unknown environment light, solved together with a coarse material."""
