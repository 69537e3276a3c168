"""Fitting parameters of live Mitsuba scenes."""
