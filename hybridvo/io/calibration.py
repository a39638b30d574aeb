"""Numbers of recordings and cameras that decide: value, unit, data, how to find them again."""

CENTRAL_PRINCIPAL_POINT = (0.35, 0.65)
"""Place of the principal point, as a fraction of the width and of the height, outside of which
``doctor`` and ``run`` suspect intrinsics of another resolution. Unfitted: those of 43
recordings lie at 0.47 to 0.54, of twice the resolution at 1 (``hybridvo doctor``)."""

# Data, runs and reports

MAX_STAMP_DIFFERENCE_S = 0.02
"""Largest difference of time stamps that belong together, s: the value of the TUM tools, which is
well below the 33 ms between the frames of a depth camera. Chosen by hand."""
LONGEST_DURATION_S = 1.0
"""Largest first column of a list, s, that is read as durations of frames where it does not
increase. Unfitted: a recorder that leaves a second between frames is no video."""
DISPARITY_STD_PX = 0.5
"""Standard deviation of a disparity of semi-global block matching, px. It prefers whole pixels by
up to 0.3 px, whatever the texture: planes of disparity 10 to 11 in steps of 1/8, as
``tests/io/data/test_stereo.py`` renders them. The rest is for occlusion and weak texture, by
hand."""
MAX_DISPARITY_PX = 128
"""Disparity that is searched, px: at KITTI's focal length and baseline all beyond 3 m, at EuRoC's
beyond 0.4 m. Chosen by hand."""
MAX_STEREO_INTERVAL_S = 0.005
"""Between the stamps of the two images of a stereo pair, s: cameras that are triggered together
state the same one, to a few tenths of a millisecond (EuRoC: equal). Chosen by hand."""
MAX_FOOTPRINT_PX = 32
"""Pixels of colour, along a row or a column, that one pixel of depth may cover when depth is
registered: sensors have 1 to 8, a damaged map would cover the whole image. Chosen by hand."""
STEREO_BLOCK_PX = 5
"""Side of the blocks of two images that are compared, px. Chosen by hand."""

# -- folders that no reader knows ---------------------------------------------------------------

TELLING_WEIGHT = 3.0
"""How much more a file that only one kind of recordings has says of a folder than one that many
have, such as ``depth``. Unfitted."""
MIN_LAYOUT_LIKENESS = 0.4
"""Share of a layout, by the weight of its parts, that a folder must have before a refusal names
that layout. Unfitted: ``color`` and ``depth`` alone, which are .4 of what Open3D's recorder writes,
are worth a name; one folder ``rgb`` is not."""

# -- live cameras: chosen by hand, as what a user who waits for a pose can bear ----------------

LIVE_WIDTH_PX = 640
"""Columns of a live image where no preset states otherwise, px: every camera that has a driver
offers this size, and two cores keep up with it."""
LIVE_HEIGHT_PX = 480
"""Rows of such an image, px."""
LIVE_RATE_HZ = 30
"""Frames a second that are requested of a live camera: what all of them offer at that size."""
MAX_FRAME_AGE_S = 0.5
"""Age from which a frame is dropped, s: it shows where the camera was. Sensors hand a frame out
after 0.02 to 0.1 s; above half a second something has held it up."""
MAX_OLD_FRAMES = 10
"""Frames in a row that are dropped for their age; then the camera itself is slow, or its clock is
wrong, and its frames are taken."""
MAX_CLOCK_JUMP_S = 1.0
"""Difference between the time that passed by the stamps and by the arrival of two frames, s, from
which the camera's clock has jumped. USB holds frames up by some tenths of a second."""
MAX_STANDING_STAMPS = 5
"""Frames in a row whose stamps do not rise, from which on the camera has no clock: drivers hand
a frame out two or three times."""
LIVE_WAIT_S = 0.1
"""Longest wait for a frame before a request to stop is looked for, s: for a person, at once."""
MAX_SILENCE_S = 3.0
"""Time without a frame after which a camera is closed and opened again, s: RealSense and OAK need
up to two seconds for their first frame."""
FIRST_RETRY_S = 1.0
"""Time until a lost camera is opened again, s; it doubles with every attempt that fails."""
MAX_RETRY_S = 8.0
"""Longest time between two such attempts, s: a plug that is put back in is noticed soon enough."""
MAX_ABSENCE_S = 60.0
"""Time without a frame after which a live run ends, s: long enough to plug a camera in again."""
MAX_CLOSING_S = 5.0
"""Time that a camera has to stop, s; one that hangs is left alone, and the results are written."""
RATE_STEPS = 30
"""Steps over which the frames a second and the ages on the screen are counted: one second."""
MIN_POSES_HZ = 10.0
"""Poses a second that ``rate="auto"`` keeps where it cannot keep the camera's rate: a hand moves by
a few centimetres meanwhile, which the search still finds. Unfitted."""
RATE_FRAMES = 5
"""First frames of a camera by which a level is chosen: a sixth of a second. Unfitted."""
GUARDED_STEPS = 15
"""Steps in a row whose mean time decides whether a level is too slow. Unfitted."""
MIN_LIVE_COLUMNS = 200
"""Columns below which images are not made smaller, px. Unfitted: ``tools/benchmark.py live`` shows
whether the path holds at 213."""
SMALL_FLOW = "fast"
"""Preset of DIS on images that were made smaller: 12 ms on 320x240, against 83 of ``medium``, which
goes down to the pixels of small images (fr1_rpy, smallest of 19 pairs, loaded machine)."""
STAGE_STEPS = 1000
"""Steps over which the times of the stages are stated: the last half minute. By hand."""
IMU_RATE_HZ = 200
"""Readings a second that are requested of a camera's gyroscope and accelerometer, or the next rate
above that it has: what EuRoC's sensor gives. By hand."""
IMU_READINGS = 4000
"""Readings that are held while no frame comes: ten seconds of the fastest. By hand."""
IMU_MESSAGES = 100
"""Messages of an OAK's IMU that wait for a frame: half a second and more. By hand."""
MAX_ACCELERATION_LAG_S = 0.1
"""Time by which the accelerations may end before the rates of a gyroscope, or begin after them, s:
several readings of the slowest, 63 a second. By hand."""
MAX_DROPPED = 0.05
"""Share of dropped frames up to which nothing needs to be done about them. By hand."""

# -- nodes of ROS: chosen by hand ---------------------------------------------------------------

IMU_PATIENCE_S = 0.05
"""How long a frame waits for the samples up to its stamp, s: a gyroscope of 100 Hz hands one out
every .01 s, and DDS delivers it in less. Unfitted."""

# -- the viewer beside a run: chosen by hand, as what a user who watches it can bear ------------

VIEWER_START_S = 20.0
"""Time within which Rerun's viewer has to listen, s: a window needs about one second here."""
VIEWER_POLL_S = 0.1
"""Time between two questions whether it listens, s."""
VIEWER_SILENCE_S = 5.0
"""Time after which a viewer that takes nothing is lost, s. The tracker does not wait for it."""
VIEWER_CLOSING_S = 10.0
"""Time at the end of a run for what the viewer has not taken yet, s: more than
:data:`VIEWER_SILENCE_S`, after which a viewer that takes nothing is lost anyway."""
