"""The benchmark's solvers alone: time of the processor, one thread, the flow given.

    python tools/benchmark.py solver     # prints the figures as JSON

``classical`` searches the motions of the flow, refines the camera's and states its covariance;
from a start it only refines. Beside it stand the calls of PoseLib and OpenCV on the 10 000
points that they get, and the whole answer with each of them: points, solver, covariance.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from known_pairs import rendered
from measuring import digits, methods_here, parser_of, this_tool

from hybridvo.core.processes import ONE_THREAD

SIZE = (436, 1024)
"""Rows and columns of the images."""
KIND = "light"
FRAMES = 9
"""Frames of the scene: eight pairs."""
REPEATS = 5
"""Calls on each pair."""
OURS = "classical"
STARTED = "classical, start given"
OPENCV = "pnp-ransac-tuned"
POINT_SOLVERS = ("poselib", OPENCV)

Work = Callable[[], Any]


def solver() -> dict[str, Any]:
    """The figures, from a process of one thread."""
    environment = os.environ | ONE_THREAD
    done = subprocess.run(
        this_tool("solver"),
        capture_output=True,
        text=True,
        env=environment,
    )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["failed"]
        return {"error": lines[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def measure() -> dict[str, Any]:
    """Times of the processor on every pair of a scene."""
    import cv2

    from hybridvo import FramePair
    from hybridvo.baselines.correspondences import POINTS
    from hybridvo.flow.providers import dis_flow, with_flow

    cv2.setNumThreads(1)
    ready = methods_here(POINT_SOLVERS).ready
    alone: dict[str, list[float]] = {}
    answer: dict[str, list[float]] = {}
    for two in pairwise(rendered(KIND, 0, SIZE, FRAMES)):
        pair = with_flow(FramePair(*two, None), dis_flow())
        for name, work in solvers(pair, ready).items():
            alone.setdefault(name, []).extend(times(work))
        for name, work in answers(pair, ready).items():
            answer.setdefault(name, []).extend(times(work))
    given = {"size": list(SIZE), "pairs": FRAMES - 1, "points": POINTS}
    return given | figures(alone, answer)


def solvers(pair: Any, ready: list[str]) -> dict[str, Work]:
    """What solves a pair: ours, and the calls of other libraries on their points."""
    from hybridvo import refine
    from hybridvo.baselines import SOLVERS, sample

    known = refine(pair).T_curr_prev
    works: dict[str, Work] = {
        OURS: partial(refine, pair),
        STARTED: partial(refine, pair, known),
    }
    points = sample(pair, 0)
    given = (points, pair.curr.camera, 0, points.inlier_px)
    return works | {name: partial(SOLVERS[name], *given) for name in ready}


def answers(pair: Any, ready: list[str]) -> dict[str, Work]:
    """The whole answer about a pair, by method."""
    from hybridvo import estimate

    names = (OURS, *ready)
    return {name: partial(estimate, pair, method=name) for name in names}


def times(work: Work) -> list[float]:
    """Times of the processor, ms, after one call that does not count."""
    work()
    found = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        found.append(1e3 * (time.process_time() - begin))
    return found


def figures(
    alone: dict[str, list[float]], answer: dict[str, list[float]]
) -> dict[str, Any]:
    """Medians, and each as a part of OpenCV's."""
    result: dict[str, Any] = {}
    for key, by_method in (("solver", alone), ("answer", answer)):
        ms = {name: np.median(each) for name, each in by_method.items()}
        whole = ms[OPENCV]
        result[key] = {
            name: {"ms": digits(one), "of_opencv": digits(one / whole)}
            for name, one in ms.items()
        }
    return result


def main(argv: list[str] | None = None) -> int:
    """Print the figures of this process as JSON."""
    parser_of(__file__, __doc__).parse_args(argv)
    print(json.dumps(measure()))
    return 0
