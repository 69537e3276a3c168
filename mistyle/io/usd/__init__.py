"""USD: checked, read, written, and overlaid with new materials."""
