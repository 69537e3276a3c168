"""The speed of the material fit."""
