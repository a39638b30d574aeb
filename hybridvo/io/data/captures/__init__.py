"""Recordings as other programs write them: scanners, recorders and apps."""
