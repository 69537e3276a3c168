"""Inverse problems without files or jobs: materials, cameras and scene parameters from pictures."""
