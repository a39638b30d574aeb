"""Numbers of the evidence of a pair that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

# Wide steps

MIN_FLOW_COVERAGE = 0.1
"""Fraction of the flow that is the same in both directions, below which it is not searched: 0.0 to
0.05 of steps that are too wide, 0.2 and more of others (turning Kinect, rooms, people on a tripod,
turned windows; ``tools/benchmark.py wide_steps``). It saves 350 ms of a step that is too wide."""

# Rolling shutters

NEGLIGIBLE_SHIFT_PX = 0.05
"""By how much the times of the rows must move some pixel, px, or the image stays as it is: below
the noise of a motion by images."""

# What is remembered

HANDED_OVER = 0.9
"""Factor on the log odds of a surface that the next keyframe sees as well."""
SEEN_THROUGH_LOG_ODDS = -1.5
"""Log odds of what stands where the keyframe before saw farther."""
