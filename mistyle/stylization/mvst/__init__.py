"""Multiview-consistent style transfer (paper 4.1.3): warping, and the sweep over views."""
