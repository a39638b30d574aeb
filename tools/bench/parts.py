"""The published figures: which tool measures which part of which file in docs/results."""

from __future__ import annotations

import shlex
from typing import NamedTuple


class Part(NamedTuple):
    """What one command measures for the tables."""

    name: str
    tool: str  # of tools/benchmark.py
    options: str
    file: str  # stem of the JSON file in docs/results
    key: str  # of the part in that file; empty: the whole file
    minutes: float  # alone on two cores of 2026
    alone: bool = False  # times are published: nothing else may run
    before: str = ""  # a command of tools that makes what is measured
    after: str = ""  # a command of tools that draws what was measured

    def words(self, data: str, out: str) -> list[str]:
        """Return the options of the tool.

        Args:
            data: folder of the recordings.
            out: the JSON file.
        """
        words = shlex.split(self.options)
        if self.tool not in WITHOUT_DATA:
            words += ["--data", data]
        words += ["--out", out]
        if self.tool in ASK_FOR_OVERWRITE:
            words.append("--overwrite")
        return words


WITHOUT_DATA = ("sequences", "install")
"""Tools that read no recording."""
ASK_FOR_OVERWRITE = (
    "methods",
    "sequences",
    "moving_people",
    "peers",
    "scale",
    "install",
)
"""Tools that replace a file only where that is said."""

# fmt: off
PARTS = (
    Part("thresholds", "methods", "--parts thresholds --seed0 9200 --pairs 10 --sequences 6",
         "benchmark", "thresholds", 8),
    Part("demo", "methods", "--parts demo", "benchmark", "demo", 1),
    Part("scenarios", "methods", "--parts scenarios,model_noise",
         "benchmark", "model_noise", 7),
    Part("real", "methods", "--parts real", "benchmark", "real", 3),
    Part("video_rate", "methods", "--parts video_rate --video-frames 60",
         "benchmark", "video_rate", 6),
    Part("makers", "makers", "--pairs 60 --methods hybrid,pwvo-refine,classical,poselib",
         "makers", "", 4),
    Part("semi_real", "semi_real",
         "--pairs 480 --methods classical,hybrid-flow,hybrid,pwvo-refine,poselib",
         "semi_real", "", 6),
    Part("two_recordings", "two_recordings", "--clips 40", "two_recordings", "", 5),
    Part("pwvo_parts", "pwvo_parts", "", "pwvo_parts", "", 5),
    Part("sigmas", "sigmas", "--methods hybrid,hybrid-flow --pairs 40", "sigmas", "", 3),
    Part("wide_steps", "wide_steps", "--pairs 16", "wide_steps", "", 3),
    Part("passes", "passes", "", "passes", "", 3),
    Part("sequences", "sequences", "--frames 40", "sequences", "", 3),
    Part("objects", "objects", "--families light,heavy_two,heavy_ten --seeds 2 --frames 8",
         "objects", "heavy_ten", 4),
    Part("objects_static", "objects", "--families static --seeds 1 --frames 8",
         "objects", "static", 1),
    Part("objects_clips", "objects", "--families '' --clips", "objects", "clips", 2),
    Part("memory", "memory", "", "memory", "", 3),
    Part("memory_unseen", "memory_unseen", "", "memory_unseen", "", 8),
    Part("moving_people", "moving_people", "", "moving_people", "", 2,
         after="benchmark.py moving_people --draw docs/results/moving_people.json"),
    Part("t265", "t265", "--draw", "t265", "", 3),
    Part("peers", "peers", "", "peers", "", 18),
    Part("heavy", "methods", "--parts heavy --seed0 9200 --pairs 10 --sequences 6",
         "benchmark", "heavy", 8, alone=True),
    Part("costs", "methods", "--parts costs --repeats 1",
         "benchmark", "costs", 4, alone=True),
    Part("live", "live", "", "live", "", 3, alone=True),
    Part("lost", "lost", "--methods hybrid,classical", "lost", "", 2, alone=True),
    Part("slam_peers", "slam_peers", "", "slam_peers", "", 15, alone=True),
    Part("wheels", "install", "--parts wheels,speed --repeats 3 --wheels runs/tables/dist",
         "install", "speed", 5, alone=True, before="build_wheel.py --out runs/tables/dist"),
    Part("install", "install", "--repeats 4", "install", "", 3, alone=True),
    Part("scale", "scale", "--parts costs,tables,workers", "scale", "workers", 5, alone=True),
)
# fmt: on
"""In the order in which they are measured. The minutes are estimates from published times.
Not among them: the rows of the paper, which are trained for hours (tools/ablation.py,
tools/paper.py)."""
