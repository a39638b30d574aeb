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
"""Correlation of the errors of two motions from one keyframe, whose noise they share."""
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
the motion of a step. On the same two. Unfitted."""

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
UNKNOWN_SPEED = 1.0
"""Standard deviation of an unknown velocity, m/s along each axis: walking. By hand."""
