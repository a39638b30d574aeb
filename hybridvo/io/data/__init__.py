"""Disk or camera to frames, and frames to pairs."""
