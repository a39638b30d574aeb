"""Numbers of what else moves that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

#
# Where a number states what changes without it, that is on scenes of 8 frames
# (``tools/benchmark.py objects``): ``heavy_ten`` slow of seed 9001 and fast of 9002, and ``light``
# fast of 9001.

MIN_OBJECT = 0.004
"""Fraction of the view below which nothing is an object."""
FLOW_STD = 0.001
"""Standard deviation of flow beside what its own variance states, as a fraction of the width of the
image."""
FLOW_STD_OF_LENGTH = 0.03
"""The same, as a fraction of the length of the flow. With neither, 73 instead of 84 of 102 objects
of ``heavy_ten`` are found."""
COST_LIMIT = 4.5
"""Nats that a point's flow or depth costs at most: three standard deviations. By hand."""
DEPTH_STEP = 1.15
"""Ratio of the depths of neighbouring points of the grid from which there is an edge."""
STANDING_BONUS = 0.3
"""Nats a point in favour of the camera's motion: most things stand."""
SHADOW = 0.9
"""Residual of the images under the motion of a new object over that under the camera's, above which
only the flow is drawn along by what moves beside it. Without it ``light`` shows a false object."""
BY_DEPTH = 0.5
"""Nats a point by which its depth must speak for its motion where the images do not."""
SUSPECTED = 0.4
"""Nats by which they must speak against it for a point to be looked at: of static rendered scenes
fewer than 1 in 1000 do."""
MIN_MOVING_COST = 0.7
"""Nats that a point must cost under a motion not to follow it."""
LATTICE = 0.6
"""Fraction of the points of a view with depth below which depth is sought beside them too. Where it
always is, ``light`` shows three false objects, and 91 instead of 84 of ``heavy_ten`` are found."""
LEAST_OF_SEARCHED = 0.03
"""Fraction of what is searched that a motion must explain at least."""
KNOWN_PRICE = 0.002
NEW_PRICE = 0.008
"""Nats that the motion of a known object, and of a new one, costs for each point of the view: each
explains this fraction of it surely. With one price and without the next number, 78 instead of 84 of
102 objects of ``heavy_ten`` are found."""
PREDICTED_BONUS = 1.0
"""Nats in favour of an object's motion where it is expected: see the prices."""
SAME_OBJECT = 20.0
"""Squared distance of the motions of two parts that are near, in standard deviations of both, up to
which they are of one object."""
PARTS_OF_ONE = 3
"""Parts that touch and move apart, from which on they are one thing that is not rigid."""
CONTACT_STEP = 1.08
CONTACT = 0.7
"""Ratio of depths of two points, up to which they touch, and how many must, over the root of the
size of the smaller part, for two parts to be beside each other."""
BEND = 0.5
"""How far two parts of a thing that bends move apart at their border at most, over the mean of
both."""
SMALL_PART = 0.01
"""Fraction of the view up to which a part that touches another one is its border."""
NEW_OBJECT_FRAMES = 4
"""Frames for which an object may still turn out to be a part of another one."""
SAME_FRACTION = 0.06
"""Distance of the motions of two parts that are near, as a fraction of how far they move beside the
camera, up to which they are of one object whatever their covariances."""
OBJECT_FLOW_INFLATION = 4.0
"""Factor on the covariance of an object's motion by flow alone."""
IMAGES_PRIOR_INFLATION = 100.0
"""Factor on the covariance of that motion as a prior of the one by images."""
RIGID_FRACTION = 0.6
"""Fraction of an object's pixels that must follow its motion for it to be rigid."""
FIRST_LOG_ODDS = -1.0
"""Log odds of a new object before its first frame counts."""
LARGE_OBJECT = 0.03
"""Fraction of the view below which these are smaller by its logarithm."""
TRACE_GAIN = 2.0
"""How much the images alone must count for a gain by flow to count as well: where something moves
flow draws along what stands beside it."""
NO_GAIN = 0.5
"""Nats a point by which the motion of an object must be likelier than the camera's for its log odds
to grow."""
MAX_OBJECT_LOG_ODDS = 5.0
MIN_OBJECT_LOG_ODDS = -3.0
"""Largest log odds of an object, and those below which it is forgotten."""
HIDDEN_STEP = 0.3
"""By how much they fall with every frame that does not show it: 17 of them, and it is
forgotten."""
MIN_OVERLAP = 0.15
"""Overlap (intersection over union) with where an object is expected, from which a part is taken
for it."""
SAME_DEPTH = 1.25
"""Ratio of depths up to which a part is taken for an object."""
OBJECT_CHANGE_STD = (0.02, 0.02)
"""Standard deviation of how the motion of an object changes from frame to frame, m and rad."""
