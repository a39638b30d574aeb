"""Numbers fitted on data: value, unit, the data, and the command that finds them again."""

CUE_GAP = (6.0, 0.0)
"""Slope and offset of the logit of being right in the gap between the two best cue scores."""
