"""Readers of further published data sets, one file each."""
