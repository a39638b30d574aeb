"""Optical flow, its noise, and the images of a frame."""
