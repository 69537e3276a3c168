"""The report of a stylization: its page, its figures, how the style reads."""
