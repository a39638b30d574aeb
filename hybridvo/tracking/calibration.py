"""Numbers of the tracker that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

# -- keyframes, places and the motion to expect ------------------------------------------

MIN_DEPTH_SHARE = 0.002
"""Fraction of a frame's pixels with valid depth below which no motion starts from it: sparse laser
depth covers 0.04 and more, a covered depth camera leaves single pixels."""
KEYFRAME_FLOW = 0.05
"""Largest mean ego flow from a keyframe, as a fraction of the image's width; DIS follows a
tenth."""
KEYFRAME_AGE = 12
"""Frames that a keyframe is used for at most: so many are kept."""
KEYFRAME_CORRELATION = 0.75
"""Correlation of the errors of two motions from one keyframe to successive frames. The noise of the
keyframe alone gives 0.5; what interpolation, light and moving things add hardly changes from frame
to frame. By the translation of six recordings of a camera that stands 0.72 in the median (0.08 to
0.88), of nine kinds of rendered video 0.75 to 0.94 (``correlation`` of ``tools/benchmark.py methods
--parts video_rate``)."""
PLACE_DISTANCE = 0.2
"""Mean ego flow between two places at least, as a fraction of the image's width: ten cover about
two views, and matches bridge more than that (``tools/benchmark.py wide_steps``). By hand."""
MIN_LIKENESS = 0.5
"""Correlation of small images from which a place is tried: it costs a motion, and the motion must
be ok to count. By hand."""
ALIKE_PLACES = 3
"""Places that are tried, those that look most alike first: where a scene repeats itself each fits,
and none is believed. By hand: each costs a motion."""
CHANGE_DECAY = 0.9
"""Factor on the weight of earlier changes of the motion with every new one. By hand, as the
next three; ``make golden`` shows the effect of a change."""
CHANGE_INFLATION = 2.0
"""Factor on the mean square of the changes in the prior: a larger one may come."""

# -- what hides the static scene ---------------------------------------------------------

MOSTLY_HIDDEN = 0.85
"""Fraction of what was believed static from which it is hidden: what fills the view is then no
scene. By hand, as the next three."""
HARDLY_HIDDEN = 0.2
"""That up to which what a tracker remembers is all of the scene, and later frames are held against
it."""
MIN_WORLD_IN_VIEW = 0.2
"""Fraction of a remembered view that must be inside the current one before it says anything."""
MAX_HIDDEN_FRAMES = 90
"""Frames for which a hidden scene is waited for, three seconds at 30 Hz."""

# -- depth whose scale changes from frame to frame ---------------------------------------

DEPTH_SCALE_STD = 0.05
"""Standard deviation of the log scale of a frame's depth by a network, about the network's mean:
metric depth networks change their scale by some percent from frame to frame. Chosen by hand;
``tests/io/onnx/test_breathing.py`` shows what comes of wobbles of this size."""
DEPTH_SCALE_DRIFT = 0.005
"""Standard deviation of the log ratio of two depth maps over static pixels, as an estimate of their
scales. A network draws far things too near, and a car that comes closer sees its scale grow:
+.0015 a frame on ``data/devices/kitti00_network_depth``, which noise alone (.001) would let pile
up over 50 frames and not over 10. There, 53 m err by .77 m in the median and 1.53 at most
(without the filter .77 and 1.58, with .001 1.26 and 1.76), and the lengths of neighbouring steps
differ by 2.3 % (2.7 %, 2.3 %)."""

# -- a focal length that is off ----------------------------------------------------------

MIN_TURN_PX = 0.5
"""Turn of a motion, px at the middle of the view, below which it is not asked about the camera:
what it shows grows with the turn, and that of a shutter with its square."""
MIN_FOCAL_INFORMATION = 1e4
"""Sum of the informations on the log focal length below which nothing is stated: a camera that
hardly moves shows none. A Kinect that turns gathers 1e6 in 49 motions, one that stands
(``devices/xtion_hands``) 5e2 in 23."""
MAX_FOCAL_ERROR = 0.03
"""Log of the focal length by which it may be off: what distortion that was not taken out and a
rolling shutter look like."""

# -- the readout of a rolling shutter ----------------------------------------------------

MAX_READOUT_STD_MS = 8.0
"""Standard deviation of the readout, ms, from which on it is not known."""
MIN_STATIC_SHARE = 0.7
"""Fraction of the pixels that follow a motion, above which all of the view shows the readout: the
rest are outliers of its fit."""

# -- depth that is measured later than its image ----------------------------------------------

MIN_TURN_GROWTH = 0.01
"""By how much a turn from frame to frame must grow in a second, rad, to show that depth is late: a
lag of 10 ms then turns depth by a hundredth of a degree."""

# -- frames that a camera hands out again ------------------------------------------------

STANDING_FLOW_PX = 0.5
"""Mean flow of the expected motion, px, below which an image that repeats may be that of a
camera that stands: either answer is then the same within a pixel."""
EQUAL_DEPTH = 2e-3
"""Median relative difference between a depth map of an earlier frame and what the frame must
show, below which the old map is as good as a new one: below a sensor's noise."""

# -- gyroscope and accelerometer ---------------------------------------------------------

GYRO_NOISE_DENSITY = 2e-3
"""Noise of a gyroscope, rad/s/sqrt(Hz): ten times the data sheet of EuRoC's ADIS16448, for its bias
and the delay of its stamps. By hand."""
GYRO_HOLD_S = 0.1
"""Longest time for which a rate of a gyroscope stands, s: the slowest give 50 a second. By hand."""
GYRO_BIAS_STD = 0.1
"""Standard deviation of the unknown bias of a gyroscope, rad/s: that of EuRoC's sensor is .08."""
GYRO_BIAS_WALK = 2e-4
"""By how much that bias walks, rad/s in the root of a second: ten times what ``sensor.yaml``
of EuRoC states, for cheaper sensors that warm up."""
GYRO_MIN_COMPARED = 20
"""Sure steps after which a gyroscope may be found to be none of this camera's. By hand."""
GYRO_MAX_MISFIT = 20.0
"""Mean squared distance between its turns and those of the images, over so many steps, from which
it is: three where both state rightly how much they err, 0.1 on EuRoC. By hand."""
MIN_OF_IMAGES = 0.5
"""Fraction of the information on a rotation that must come from the images for it to show the
bias: the rest is the gyroscope's own."""
ACCELERATION_STD = 0.5
"""Standard deviation of a hand-held camera's acceleration along each axis, m/s^2, before samples
show it."""
ACCELERATION_TIME_S = 0.25
"""Time after which that acceleration is another one, s: a hand goes to and fro once or twice in a
second. A vehicle accelerates for seconds."""
ACCELERATION_MEMORY_S = 10.0
"""Time over which its standard deviation is averaged, s."""
FIRST_ACCELERATION_S = 1.0
"""Time of samples that what is assumed of it beforehand is worth, s."""
MIN_ACCELERATION_STD = 0.1
"""Least standard deviation of that acceleration, m/s^2: a camera on a table is nudged."""
ACCELEROMETER_BIAS_STD = 0.3
"""Standard deviation of what an accelerometer reads beside the truth along each axis, m/s^2; where
it shows along gravity, it is larger by that. EuRoC's sensor, which stands (``euroc_v1_01``), is off
by 2.6 degrees, which are .45 m/s^2, a phone's by 1.0 (``strayscanner_no_video``). By hand."""
UNKNOWN_SPEED = 1.0
"""Standard deviation of an unknown velocity, m/s along each axis: walking. By hand."""

# -- what a tracker remembers ------------------------------------------------------------
#
# All by hand, on 18 clips and tripod recordings (kitchen, box, people before a standing camera);
# on recordings kept back since, flow was needed in 42 instead of 145 of 180 frames at the same
# error, and 43 instead of 56 of 149 steps of moving clips were wrong.

BELIEF_LIMIT = 4.0
"""Largest log odds of a point to be static, or to move: it can still be unlearned."""
BELIEF_DECAY = 0.95
"""Factor on all log odds with every frame, of points and of the whole, so that a wrong belief dies:
with 0.85 as many steps of those clips are wrong."""
BELIEF_SURE = 0.98
"""Probability of a motion that counts at most for the belief."""
DEPTH_RATIO = (-2.5, 0.7)
"""Least and largest log likelihood ratio by a point's depth."""
GREY_RATIO = (-2.5, 1.5)
"""The same by its grey level."""
GREY_STD = 1.5
"""Noise of a blurred grey level, grey levels."""
GREY_STD_OF_GRADIENT = 0.15
"""The same as a multiple of the gradient, px: where a point falls is not exact."""
OTHER_STD_OF_GRADIENT = 1.5
"""Spread of the grey levels of what is not static, as a multiple of the gradient, px; the contrast
around adds to it."""
MAX_CERTAINTY = 7.0
"""Largest log odds of a whole belief to be right."""
CERTAINTY_BY_IMAGES = 3.0
"""Nats by which certainty grows with a motion that the images alone confirm."""
