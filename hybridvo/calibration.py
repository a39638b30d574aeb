"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in what a selector has seen, all without a unit; the
last weight is the offset. ``python tools/calibrate.py`` fits them on the development recordings of
:mod:`hybridvo.synthetic.semi_real` and on the heavy development scenes, with DIS flow.
"""

CUES_RIGHT = (2.0, 1.45)
"""Of the difference of the two best cue scores. On 158 development answers, 133 right, the gap says
little (AUROC .66, calibration error .07); the limit of what is sure stands at a gap of 0.14."""
SELECTOR_RIGHT = (0.433, 0.575, 2.111)
"""Of :func:`hybridvo.hypotheses.selector.evidence_of`: 158 development answers, 148 right, AUROC
.89, calibration error .05."""
CLEAR_RIGHT = 0.99
"""Share of right answers where the first motion explains nearly all that the depth sensor sees: no
wrong one was met in the development pairs, which are too few to say more."""
CUE_WEIGHTS = {
    "border": 1.2,
    "excess": -1.5,
    "spread": 0.7,
    "behind": 0.15,
    "noise": -0.2,
    "prior": 0.3,
    "dominant": 2.0,
}
"""Weights of the cues of :mod:`hybridvo.hypotheses.cues`, dimensionless. Chosen by hand on seeds
900-905 of the heavy development scenes and the scenario ``one60``;
``python tools/golden.py --only /refine`` shows what they give."""
MIN_CONFIDENCE = 0.85
"""Probability of being right below which a motion is degraded, and PWVO is asked. Of the
development answers of the selector that are 14 % of the right ones and 60 % of the wrong."""
CLEAR_COHERENCE = 0.5
"""Spatial correlation of the residuals above which even a motion that most of the image follows may
be a compromise: 0.02 for independent noise, 0.25 to 0.4 for DIS flow of static scenes, above 0.6
where a large moving object bends the flow (the same pairs)."""
CLEAR_BEND_PX = 0.15
"""Coherent part of the residuals, px at a width of 1024, above which it may be one as well: noise
hides slowly moving objects, and they bend the motion (the same pairs)."""
SETTLED_COHERENCE = 0.35
"""Correlation above which a motion of half the image does not end the search of the first one;
depth noise that is half correlated in space stays below 0.25 (the same pairs)."""
ASIDE = 0.8
"""Factor on the kernel's cutoff within which pixels are set aside with a motion. Wider, a motion
takes with it much of another that looks like it in places: at 2 the right one is found in 80 % of
the same pairs, from 0.5 to 1 in 84 %."""
CORRECTION_LIMIT = 100.0
"""Chi-square of a correction by key frames beyond which a step's motion is no measurement: up to 36
where the trajectory holds, 450 and more after a frame of another place (rendered sequences)."""
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
