"""Numbers fitted on data: value, unit, data, and how they are found again."""

CUE_GAP = (4.4, 0.0)
"""Slope and offset of the logit of being right (ego-flow error of at most 1 px) in the difference
of the two best cue scores, both dimensionless. Logistic regression over 119 ambiguous pairs of the
heavy development scenes, seeds 900-905, DIS flow; 92 of them right."""
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
MIN_CONFIDENCE = 0.65
"""Probability of being right below which a motion is degraded. Of the same 120 pairs with DIS flow
the 3 wrong ones have 0.1 to 0.44, the others 0.65 to 1;
``python tools/golden.py --only heavy_ --seeds 3``."""
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
