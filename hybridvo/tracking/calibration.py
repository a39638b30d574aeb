"""Numbers of the tracker that decide: value, unit, data, how to find them again."""

MIN_DEPTH_SHARE = 0.002
"""Fraction of a frame's pixels with valid depth below which no motion starts from it: sparse laser
depth covers 0.04 and more, a covered depth camera leaves single pixels."""
KEYFRAME_FLOW = 0.05
"""Largest mean ego flow from a keyframe, as a fraction of the image's width; DIS follows a
tenth."""
KEYFRAME_AGE = 12
"""Frames that a keyframe is used for at most: so many are kept."""
KEYFRAME_CORRELATION = 0.5
"""Correlation of the errors of two motions from one keyframe: where both frames of a pair have
noise of one size, half of the variance of its motion is the keyframe's, which both share."""
SAME_MOTION = 16.8
"""Squared distance of two estimates of a motion, in standard deviations of both, up to which they
are of one: 99 % of a chi-square of six numbers."""
PLACES = 10
"""Earlier frames that are kept to find a lost path again. By hand."""
PLACE_DISTANCE = 0.2
"""Mean ego flow between two places at least, as a fraction of the image's width: ten cover about
two views, and matches bridge more than that (``tools/benchmark_wide_steps.py``). By hand."""
MIN_LIKENESS = 0.5
"""Correlation of small images from which a place is tried: it costs a motion, and the motion must
be ok to count. By hand."""
ALIKE_PLACES = 3
"""Places that are tried, those that look most alike first: where a scene repeats itself each fits,
and none is believed. By hand: each costs a motion."""
CHANGE_DECAY = 0.9
"""Factor on the weight of earlier changes of the motion with every new one. By hand, as the
next four; ``make golden`` shows the effect of a change."""
MIN_CHANGES = 3
"""Changes of the motion; with fewer their standard deviation is not known yet."""
CHANGE_INFLATION = 2.0
"""Factor on the mean square of the changes in the prior: a larger one may come."""
MIN_CHANGE_STD = 1e-3
"""Smallest standard deviation of a change, m and rad: no camera repeats its motion exactly."""

# The motion by images and depth maps alone, without flow.

MAX_UNEXPLAINED = 0.2
"""Fraction of the texture in unexplained regions up to which the images from a keyframe confirm
the motion of a step: 3 of 32 steps of a moving stereo camera leave more, and all of a walk that
follows a slow object but one (see ``SHARED_DEPTH_NOISE`` of the solver). Unfitted."""

# Data, runs and reports

DEPTH_SCALE_STD = 0.05
"""Standard deviation of the log scale of a frame's depth by a network, about the network's mean:
metric depth networks change their scale by some percent from frame to frame. Chosen by hand;
``tests/onnx_networks/test_breathing.py`` shows what comes of wobbles of this size."""
DEPTH_SCALE_DRIFT = 0.005
"""Standard deviation of the log ratio of two depth maps over static pixels, as an estimate of their
scales. A network draws far things too near, and a car that comes closer sees its scale grow:
+.0015 a frame on ``data/devices/kitti00_network_depth``, which noise alone (.001) would let pile
up over 50 frames and not over 10. There, 53 m err by .77 m in the median and 1.53 at most
(without the filter .77 and 1.58, with .001 1.26 and 1.76), and the lengths of neighbouring steps
differ by 2.3 % (2.7 %, 2.3 %)."""

# -- a focal length that is off ----------------------------------------------------------

MIN_FOCAL_STEPS = 30
"""Motions before which nothing is stated of the focal length. Unfitted."""
MIN_FOCAL_INFORMATION = 1e4
"""Sum of the informations on the log focal length below which nothing is stated: a camera that
hardly moves shows none. A Kinect that turns gathers 1e6 in 49 motions, one that stands
(``devices/xtion_hands``) 5e2 in 23."""
MAX_FOCAL_ERROR = 0.03
"""Log of the focal length by which it may be off: what distortion that was not taken out and a
rolling shutter look like. Unfitted."""
FOCAL_SIGMAS = 3.0
"""Standard deviations by which it must be off by more than that. Unfitted."""

# -- frames that a camera hands out again ------------------------------------------------

STANDING_FLOW_PX = 0.5
"""Mean flow of the expected motion, px, below which an image that repeats may be that of a
camera that stands: either answer is then the same within a pixel. Unfitted."""
EQUAL_DEPTH = 2e-3
"""Median relative difference between a depth map of an earlier frame and what the frame must
show, below which the old map is as good as a new one: below a sensor's noise. Unfitted."""
REPEATED_RIGHT = 0.5
"""Probability of a motion that depth alone or the motion before give while the image is an old
one. Unfitted."""

# What other sensors measure before the images are used.

GYRO_NOISE_DENSITY = 2e-3
"""Noise of a gyroscope, rad/s/sqrt(Hz): ten times the data sheet of EuRoC's ADIS16448, for its bias
and the delay of its stamps. By hand."""
GYRO_HOLD_S = 0.1
"""Longest time for which a rate of a gyroscope stands, s: the slowest give 50 a second. By hand."""
GYRO_BIAS_STD = 0.1
"""Standard deviation of the unknown bias of a gyroscope, rad/s: that of EuRoC's sensor is .08.
Unfitted."""
GYRO_BIAS_WALK = 2e-4
"""By how much that bias walks, rad/s in the root of a second: ten times what ``sensor.yaml``
of EuRoC states, for cheaper sensors that warm up. Unfitted."""
UNKNOWN_SPEED = 1.0
"""Standard deviation of an unknown velocity, m/s along each axis: walking. By hand."""

# -- what a tracker remembers ------------------------------------------------------------
#
# All by hand, on 18 clips and tripod recordings (kitchen, box, people before a standing camera);
# on recordings kept back since, flow was needed in 42 instead of 145 of 180 frames at the same
# error, and 43 instead of 56 of 149 steps of moving clips were wrong.

BELIEF_LIMIT = 4.0
"""Largest log odds of a point to be static, or to move: it can still be unlearned. Unfitted."""
BELIEF_DECAY = 0.95
"""Factor on all log odds with every frame, so that a wrong belief dies: with 0.85 as many steps of
those clips are wrong. Unfitted."""
BELIEF_SURE = 0.98
"""Probability of a motion that counts at most for the belief. Unfitted."""
HANDED_OVER = 0.9
"""Factor on the log odds of a surface that the next keyframe sees as well. Unfitted."""
SEEN_THROUGH_LOG_ODDS = -1.5
"""Log odds of what stands where the keyframe before saw farther. Unfitted."""
DEPTH_RATIO = (-2.5, 0.7)
"""Least and largest log likelihood ratio by a point's depth. Unfitted."""
GREY_RATIO = (-2.5, 1.5)
"""The same by its grey level. Unfitted."""
GREY_STD = 1.5
"""Noise of a blurred grey level, grey levels. Unfitted."""
GREY_STD_OF_GRADIENT = 0.15
"""The same as a multiple of the gradient, px: where a point falls is not exact. Unfitted."""
OTHER_STD_OF_GRADIENT = 1.5
"""Spread of the grey levels of what is not static, as a multiple of the gradient, px; the contrast
around adds to it. Unfitted."""
RATIO_SIDE = 3
LIGHT_CHANGE_SIDE = 9
CONTRAST_SIDE = 5
"""Sides of the squares, in points of the grid, over which likelihood ratios are averaged, a change
of light is, and the contrast around a point. Unfitted."""
MAX_CERTAINTY = 7.0
"""Largest log odds of a whole belief to be right. Unfitted."""
CERTAINTY_DECAY = 0.95
"""Factor on these with every frame: after 25 frames that only memory confirmed, the view is looked
at anew. Unfitted."""
CERTAINTY_BY_IMAGES = 3.0
"""Nats by which certainty grows with a motion that the images alone confirm. Unfitted."""
CERTAINTY_BY_FLOW = 0.7
"""The same with a motion by flow, as a multiple of its log odds. Unfitted."""
CERTAINTY_STEP = 2.0
"""The same at most, either way. Unfitted."""
MIN_KEPT_CERTAINTY = -1.0
"""Certainty below which everything is forgotten. Unfitted."""
