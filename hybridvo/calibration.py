"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in what a selector has seen, all without a unit; the
last weight is the offset. ``python tools/calibrate.py`` fits them on the development recordings of
:mod:`hybridvo.synthetic.semi_real` and on the heavy development scenes, with DIS flow.
"""

CUES_RIGHT = (4.4, 0.0)
"""Of the difference of the two best cue scores."""
SELECTOR_RIGHT = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of :func:`hybridvo.hypotheses.selector.evidence_of`."""
CLEAR_RIGHT = 1.0
"""Share of right answers where the first motion explains nearly all that the depth sensor sees."""
