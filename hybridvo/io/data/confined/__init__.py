"""Recordings of foreign formats, read in a child process that has limits."""
