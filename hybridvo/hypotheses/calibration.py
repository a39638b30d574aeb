"""Numbers of the sources of motions that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

NO_MOTION = -2.0
"""PWVO's score of no motion being the camera's. In training it was 0, with which two equal
motions would be believed; on 1500 development pairs AUROC .870 with 0, .873 with -1 and -2, .866
with -3 (``tools/calibrate.py`` after a change)."""
CUE_WEIGHTS = {
    "inlier_ratio": 0.35,
    "border_coverage": 0.65,
    "depth_extent": 1.29,
    "mean_log_depth": 2.11,
    "flow_noise": -1.38,
    "prior": 1.0,
}
"""Weights of the cues of :mod:`hybridvo.hypotheses.cues`, a multinomial logit of which motion
is the camera's, on development pairs (before they came in two sizes), the heavy scenes with true
flow and the scenarios, seeds 500 to 511 (``--cues --pairs 100``). The prior's is by hand: nats."""
INLIER_REMOVAL_CUTOFF = 0.8
"""Factor on the kernel's cutoff within which pixels are set aside with a motion: at 2 the right one
is found in 80 % of the same pairs, from 0.5 to 1 in 84 %."""

# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

SHARP_SCORE_PER_PX2 = 44.4
"""Scale of the sharp half of a candidate's score, 1 / px^2: 0.15 px count half."""
BROAD_SCORE_PER_PX2 = 1.2
"""Scale of the broad half of that score, 1 / px^2: 0.9 px count a quarter."""
REESTIMATED_MIN_SCORE = 0.95
"""Smallest score of a motion after the fit with its own noise, over that before; below
it that fit is discarded."""
DISTINCT_MOTION_PX = 3.0
"""Mean difference of the ego flows of two motions above which they are two, px at a
width of 1024."""
INLIER_REMOVAL_GAIN = 2.5
"""Weight that a pixel loses when a motion is removed, in units of its robust weight under
that motion. With a gain of 1 enough would remain to find the motion again."""
MASK_RAMP_START = 0.4
"""Probability of being static up to which a pixel has no weight in a refit."""
MASK_RAMP_END = 0.9
"""Probability of being static from which a pixel has full weight; linear in between."""
MIN_COVERAGE = 0.02
"""Fraction of the usable weight that a mask must leave for a refit inside it."""

# Wide steps

MATCH_RATIO = 0.85
"""Largest ratio of the distances of the best and the second best match (Lowe, IJCV 2004)."""
MATCH_RESIDUAL_PX = 2.0
"""Largest residual of a match that follows a motion, px at a width of 640."""
MATCH_MIN_INLIERS = 15
"""Fewest matches that follow a motion."""
GUIDED_MIN_TEXTURE = 3.0
"""Smallest standard deviation of grey levels over a patch where flow that starts from a motion
counts: above the noise of usual cameras."""

# What is remembered
#
# By hand, on 18 clips of kitchen and box; on 149 steps of clips kept back since, 43 instead of 56
# were wrong. Sums over pixels instead of fractions: half of the gain; without the motion fitted to
# what is believed static: a third of it.

FRACTION_EVIDENCE = 2.5
"""Nats of evidence for each nat by which the fraction of what was static that follows a motion
exceeds that of what moved."""
FRACTION_FLOOR = 0.05
"""Added to fractions before their logarithm is taken."""
MEMORY_DEAD_ZONE = 0.3
"""Nats by which a motion may fit the memory worse than the best at no cost. By hand: without it 14
instead of 9 steps of a turning Kinect (``tum/rgbd_dataset_freiburg1_rpy_100``) are degraded."""
MEMORY_SURE = 0.995
"""Probability that the memory is right, which bounds its evidence."""

# Images alone
