"""Trajectories and truth to numbers, and numbers to pages."""
