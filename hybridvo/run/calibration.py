"""Numbers of the command line that decide: value, unit, data, how to find them again.

Where no command is named: ``hybridvo doctor DIR`` on the recordings. Those of depth, texture,
focus, registration and gaps lie between rungs of ``tools/golden.py --quick --only ladder_doctor``.
"""

MIN_VALID_DEPTH = 0.1
"""Fraction of the pixels with depth, in the median frame, from which ``doctor`` is content.
Recordings that give right motions have 0.17 (lidar) to 1; with a tenth of the pixels motions are
degraded."""
EMPTY_DEPTH = 0.01
"""Fraction below which a frame is one without depth: the rungs have 0.006 to 0.016."""
MIN_TEXTURE = 0.03
"""Fraction of the pixels with a gradient above 2 grey levels. Recordings have 0.17 to 0.9."""
MIN_FOCUS = 0.4
"""Second over first derivative at strong edges: 0.9 to 1.9 on 16 recordings and rendered scenes,
0.16 to 0.27 with a Gaussian blur of three pixels over them."""
NORMAL_REGISTRATION_SHIFT = 0.02
"""Displacement of the edges of depth beside those of the image, as a fraction of the longer side,
from which ``doctor`` reports it. 11 recordings and rendered scenes have 0 to 0.012 (8 px of 640:
fr1_xyz), and moved by 60 px they have that and 60 px; stereo and lidar depth have no clear best
one."""
CERTAIN_REGISTRATION_STDS = 6.0
"""Standard deviations of the agreement of edges over all displacements, above which the best one is
believed. On the same recordings."""
CERTAIN_ZOOM_STDS = 7.5
"""The same for depth that is enlarged or reduced, of the best of 13 factors. Depth that is not
registered has 15, at the factor that its calibration states (``tripod/unregistered``); 9 registered
recordings have 5 to 12.6, at a factor of 1 wherever it is above 6. ``hybridvo doctor DIR``."""
NEEDED_REGISTRATION_GAIN = 1.5
"""How many times as good the best displacement must be as the best one within
``NORMAL_REGISTRATION_SHIFT``. On the same recordings."""
STAMP_GAP_FACTOR = 1.5
"""Factor on the median interval of time stamps above which one is a gap: half of the way
to a frame that was left out."""
MAX_LATE_SHARE = 0.1
"""Fraction of gaps among the intervals above which ``doctor`` states that frames were dropped: the
rungs have 0.05 to 0.15."""
MAX_JITTER = 0.2
"""Standard deviation of the intervals about a whole number of frames, frames. A Kinect has 0.13
(fr1_rpy: ``hybridvo doctor DIR``); uniform ones, by which no frame can be counted, 0.29."""
CLOCK_SMOOTHING = 1.5
"""Standard deviation of the smoothing of both motions, frames. Stamps that jitter shake both alike:
without it the offsets of fr1_rpy, paired some frames late, err by up to 26 ms, with it by 1 ms."""
MIN_CLOCK_CORRELATION = 0.9
"""Correlation of the motions of colour and depth from which their offset is believed: fr1_rpy has
0.99 at any offset of its stamps, rooms_110 (3 frames a second) 0.96. ``hybridvo doctor DIR``."""
MAX_CLOCK_STD_S = 0.02
"""Standard deviation of the offset, s, above which it is not known. fr1_rpy has 0.004 in 100
frames at 30 Hz, rooms_110 0.09 at 3 Hz. ``hybridvo doctor DIR``."""
MAX_CLOCK_OFFSET_S = 0.025
"""Offset of the clocks, s, from which ``doctor`` reports it: in a turn of 45 degrees a second depth
lies 10 px of 640 beside its image. A Kinect has 0.019 (fr1_rpy); with its stamps of depth moved by
0.05 and -0.07 s it has 0.070 and -0.052. ``hybridvo doctor DIR``."""
MAX_SCALE_ERROR = 0.2
"""Relative error of the scale of depth with which ``doctor`` is content: noisy ground truth over
short motions errs by half of that (``hybridvo doctor DIR`` on the recordings of TUM)."""
