"""Strangers' files are decoded in a child process with bounds on what they may ask for."""
