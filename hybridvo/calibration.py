"""Numbers fitted on data: value, unit, data, and how they are found again."""

CUE_GAP = (4.4, 0.0)
"""Slope and offset of the logit of being right (ego-flow error of at most 1 px) in the difference
of the two best cue scores, both dimensionless. Logistic regression over 119 ambiguous pairs of the
heavy development scenes, seeds 900-905, DIS flow; 92 of them right."""
