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

DIS_NOISE = (0.035, 1.2)
"""Flow noise of DIS (medium) per component: std^2 = first^2 + (second * e)^2, px, e the difference
of the flows in both directions. 18 pairs of the synthetic world (light, static and heavy_two
scenes): among pixels that disagree by 0.015, 0.035, 0.075, 0.15, 0.25, 0.4, 0.6, 0.9, 1.2 px the
true error has a (median-based) standard deviation of 0.038, 0.046, 0.077, 0.16, 0.32, 0.53, 0.86,
1.25, 1.8 px; ``tests/flow`` measures it again."""

MIN_TEXTURED = 0.002
"""Smallest fraction of the image with texture across its weakest direction. Real and rendered
images have 0.4 to 0.8, at a tenth of their brightness 0.006 to 0.28; a covered lens has none."""

FLOW_CONTRADICTION = (0.8, 2.0)
"""A flow contradicts its images where the median difference after warping is above the first ratio
times that without, while DIS reaches less than 1 / the second of it (less one grey level). 27
pairs, rendered and real: warped over unwarped is 0.04 to 0.2 for the right flow, up to 0.25 with
noise of 3 px or 30 % of wrong pixels; 1.3 to 1.8 for a negated or backward flow, 1.0 for none, 0.85
to 1.2 for twice the flow. Half the flow (0.5 to 0.7) passes."""
