"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in what a selector has seen, all without a unit; the
last weight is the offset. ``python tools/calibrate.py`` fits them on the development recordings of
:mod:`hybridvo.synthetic.semi_real` and on the heavy development scenes, with DIS flow.
"""

CUES_RIGHT = (2.0, 1.92)
"""Of the difference of the two best cue scores: 158 development answers, 133 right, of which the
gap says little (AUROC .66, calibration error .10); the threshold below stands where it stood."""
SELECTOR_RIGHT = (0.086, 0.497, 1.316)
"""Of :func:`hybridvo.hypotheses.selector.evidence_of`: 357 development answers, 340 right; AUROC
.84 and calibration error .015 over five folds."""
CLEAR_RIGHT = 0.99
"""Share of right answers where the first motion explains nearly all that the depth sensor sees: no
wrong one was met in the development pairs, which are too few to say more."""
SURE = 0.9
"""Probability of being right below which a motion is degraded, and PWVO is asked. Over five folds
of the development answers of the selector 15 % of the right ones are, and 71 % of the wrong ones.
"""
