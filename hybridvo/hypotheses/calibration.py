"""Numbers of the sources of motions that decide: value, unit, data, how to find them again."""

from typing import NamedTuple

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

# Refinement on flow and depth
#
# Where no command is named: chosen by hand; ``make golden`` shows what a change does.

NOISE_PIXELS = 1000
"""Pixels from which the noise of a motion is estimated during the search, about."""

# Hypotheses and their selection


class Annealing(NamedTuple):
    """How the scale of a robust kernel shrinks during a fit.

    Attributes:
        start_px: first scale, px; where it follows from the residuals, its largest value.
        end_px: last scale, px.
        ratio: each scale over the one before.
        steps: Gauss-Newton steps at each scale, at most.
    """

    start_px: float
    end_px: float
    ratio: float
    steps: int


# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

CANDIDATE_ANNEALING = Annealing(start_px=64.0, end_px=0.7, ratio=0.4, steps=2)
"""Of the fit of a window, and of a pose that the caller hands in."""
CANDIDATE_MIN_START_PX = 1.0
"""Smallest first scale of that fit, px, even where the residuals are smaller."""
START_SCALE_FACTOR = 1.5
"""First scale about a pose that is handed in, as a multiple of its median residual."""
NEAR_START_PX = 1.5
"""First scale of a second fit about a pose that is handed in, px: where most of the
image moves, a wide kernel would leave even the right motion."""
BEST_CANDIDATES_ANNEALING = Annealing(start_px=1.5, end_px=0.7, ratio=0.4, steps=3)
"""Of the candidates of a round that have the largest scores."""
FOUND_MOTION_ANNEALING = Annealing(start_px=0.7, end_px=0.5, ratio=0.4, steps=3)
"""Of a motion that won its round, before its noise is estimated."""
SHARP_SCORE_PER_PX2 = 44.4
"""Scale of the sharp half of a candidate's score, 1 / px^2: 0.15 px count half."""
BROAD_SCORE_PER_PX2 = 1.2
"""Scale of the broad half of that score, 1 / px^2: 0.9 px count a quarter."""
REESTIMATED_MIN_SCORE = 0.95
"""Smallest score of a motion after the fit with its own noise, over that before; below
it that fit is discarded."""
DUPLICATE_CANDIDATE = 2e-4
"""Largest difference between the entries of two poses that are one candidate: rad, and
translation over the typical depth."""
DISTINCT_MOTION_PX = 3.0
"""Mean difference of the ego flows of two motions above which they are two, px at a
width of 1024."""
MAX_PIXEL_DISTANCE_PX = 1e3
"""Largest difference of the ego flows of two motions at a pixel, px; also that of a pixel
which only one of them leaves in front of the camera."""
INLIER_REMOVAL_GAIN = 2.5
"""Weight that a pixel loses when a motion is removed, in units of its robust weight under
that motion. With a gain of 1 enough would remain to find the motion again."""
MIN_INLIER_NOISE_PX = 0.05
"""Smallest flow noise by which inliers are decided, px: below it all motions count as
equally sharp."""
MIN_PIXEL_WEIGHT = 0.05
"""Weight of a pixel up to which a window leaves it out; 1 is that of an untouched one."""
MIN_WINDOW_PIXELS = 20
"""Fewest pixels of a window that is fitted."""
MIN_WINDOW_WEIGHT = 12.0
"""Smallest sum of the weights of such a window."""
GLOBAL_SAMPLE_PERIOD = 3
"""One of so many minimal samples is drawn from all pixels, the others locally."""
LOCAL_SAMPLE_HEIGHT = 0.5
LOCAL_SAMPLE_WIDTH = 0.4
"""Region of a local sample about its first pixel, over the height and width of the image."""
MASK_RAMP_START = 0.4
"""Probability of being static up to which a pixel has no weight in a refit."""
MASK_RAMP_END = 0.9
"""Probability of being static from which a pixel has full weight; linear in between."""
MIN_COVERAGE = 0.02
"""Fraction of the usable weight that a mask must leave for a refit inside it."""
MAX_SCORE_MARGIN = 8.0
"""Margin of the best score where there is no other motion, and the largest that counts,
nats."""
BORDER_WIDTH = 0.06
"""Width of the band along the border of the image for the cue of border coverage, over
the shorter side of the image."""
CUE_MIN_INLIER_RATIO = 0.01
"""Added to inlier ratios before their logarithm is a cue: none at all is finite."""
CUE_MIN_DEPTH_STD = 0.03
"""Added in quadrature to the standard deviation of log depth before its logarithm is a
cue."""

# Wide steps

MATCH_FEATURES = 800
"""SIFT features of an image, for a step that flow cannot follow: 40 ms on one core. Chosen by
hand, as all of this section; ``tools/benchmark.py wide_steps`` shows the effect of a change."""
MATCH_WIDTH = 400.0
"""Width to which images are reduced before features are matched, px: 35 ms instead of 90 for a
pair at 640x480, and as many wide steps are right (78 and 77 of 86)."""
MATCH_RATIO = 0.8
"""Largest ratio of the distances of the best and the second best match (Lowe, IJCV 2004)."""
MATCH_RESIDUAL_PX = 2.0
"""Largest residual of a match that follows a motion, px at a width of 640."""
MATCH_MIN_INLIERS = 15
"""Fewest matches that follow a motion."""
MATCH_MAX_MOTIONS = 2
"""Motions of a pair that are sought: the scene's, and a moving object's before it."""
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
exceeds that of what moved. Unfitted."""
FRACTION_FLOOR = 0.05
"""Added to fractions before their logarithm is taken. Unfitted."""
MEMORY_DEAD_ZONE = 0.3
"""Nats by which a motion may fit the memory worse than the best at no cost. By hand: without it 14
instead of 9 steps of a turning Kinect (``tum/rgbd_dataset_freiburg1_rpy_100``) are degraded."""
MEMORY_SURE = 0.995
"""Probability that the memory is right, which bounds its evidence. Unfitted."""
