"""Repair of the texture (paper 4.3): struggle mask, fill, texture inpainting."""
