"""Compiled kernels: how they are made, stored and shipped."""
