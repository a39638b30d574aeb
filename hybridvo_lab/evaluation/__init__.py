"""Trajectories and ground truth to numbers, and numbers to pages."""
