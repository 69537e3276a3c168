"""`mistyle stylize`: the paper's method, section by section."""
