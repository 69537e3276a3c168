"""Cameras, captures and folders of views."""
