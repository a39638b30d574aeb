"""Sequences, cameras, networks and messages in; messages out."""
