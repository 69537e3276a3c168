"""Standard metrics between two pictures in rendering."""
