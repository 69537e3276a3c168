"""Damaged inputs, killed jobs, full disks, strangers' folders."""
