"""The golden cases that need no data: rendered scenes, made pairs, a tracked walk.

``python tools/golden.py --quick`` measures them; ``tools/golden_cases/ladders.py`` holds
those in which an input gets worse rung by rung, until an estimator says so.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from known_pairs import HEAVY, UNDETERMINED, degenerate
from measuring import ego_flow_error

from golden_cases import followed
from golden_cases.figures import Record, Row, labelled, record, spread, summarise
from golden_cases.ladders import LADDERS
from golden_cases.scenes import (
    PRIOR_STD,
    SCENES,
    Known,
    Walk,
    made_pair,
    model_pair,
    prior_of,
    scene_pairs,
    walk,
)

Run = Callable[[int], list[Record]]
"""Seed of the search -> the records of a case."""


PRIOR_METHODS = ("hybrid", "classical")
PRIOR_PAIRS = 2
"""Of every heavy kind."""
IMAGE_METHODS = ("hybrid", "hybrid-flow", "classical")
SCENARIO_METHODS = ("hybrid-flow", "classical")
SCENARIO_SEEDS = range(3)
MODEL_SEEDS = range(60)
NETWORK_SCENARIOS = ("moving50", "moving70")
NETWORK_METHODS = ("pwvo-refine", "pwvo")
BASELINES = ("pnp-ransac-tuned", "usac-magsac")
WALKS = (("light", 6), ("light", 10))
"""Walks in which an object moves as slowly as the noise of one step."""


def cases() -> dict[str, Run]:
    """Return every case by its name; what stands before the slash shares its inputs."""
    from hybridvo_lab.synthetic.noise_scenarios import (
        DEGENERATE_SCENARIOS,
        MAIN_SCENARIOS,
    )

    runs: dict[str, Run] = {}
    for kind in SCENES:
        for method in IMAGE_METHODS:
            runs[f"{kind}/{method}"] = partial(by_images, kind, method)
    for method in NETWORK_METHODS:
        runs[f"network/{method}"] = partial(by_network, method)
    for number, of in enumerate(WALKS):
        runs[f"walk_{number}/hybrid"] = partial(tracked, *of, "hybrid")
    for name in MAIN_SCENARIOS:
        for method in SCENARIO_METHODS:
            runs[f"scenario_{name}/{method}"] = partial(by_flow, name, method)
        if name in NETWORK_SCENARIOS:
            run = partial(by_flow, name, "pwvo-refine")
            runs[f"scenario_{name}/pwvo-refine"] = run
    for method in BASELINES:
        runs[f"baselines/{method}"] = partial(by_flow, "moving30", method)
    runs["model_noise/classical"] = under_the_model
    for name in (*DEGENERATE_SCENARIOS, *UNDETERMINED):
        runs[f"degenerate_{name}/classical"] = partial(weak, name)
    for wrong in (halved_flow, doubled_depth, frozen_image):
        for method in ("hybrid", "classical"):
            name = f"contradicting_{wrong.__name__}/{method}"
            runs[name] = partial(contradicted, wrong, method)
    runs |= {
        f"ladder_{name}/{method}": run for (name, method), run in LADDERS.items()
    }
    runs |= followed.cases()
    for kind in (None, *PRIOR_STD):
        for method in PRIOR_METHODS:
            runs[f"prior_{kind or 'none'}/{method}"] = partial(
                with_prior, kind, method
            )
    return runs


# -- rendered scenes -----------------------------------------------------------


def by_images(kind: str, method: str, seed: int) -> list[Record]:
    """Return records of pairs of images and depth, whose flow is that of DIS."""
    return from_frames(scene_pairs(kind), method, seed)


def from_frames(
    pairs: Sequence[Known],
    method: str,
    seed: int,
    priors: Sequence[Any] | None = None,
) -> list[Record]:
    """Return records of the frames of some pairs, without the flow that these have."""
    from hybridvo import estimate

    found = []
    for number, known in enumerate(pairs):
        answer = estimate(
            known.pair.prev,
            known.pair.curr,
            method=method,
            prior=None if priors is None else priors[number],
            seed=seed,
        )
        found.append(record(answer, known.T_curr_prev, known.depth, known.pair))
    return found


def with_prior(kind: str | None, method: str, seed: int) -> list[Record]:
    """Return records of pairs of the heavy kinds with a prior, or with none."""
    pairs = []
    for scene in HEAVY:
        later = [
            known for known in scene_pairs(scene) if known.T_before is not None
        ]
        pairs += later[:PRIOR_PAIRS]
    priors = None if kind is None else [prior_of(known, kind) for known in pairs]
    return from_frames(pairs, method, seed, priors)


def by_network(method: str, seed: int) -> list[Record]:
    """Return records of one pair of every scene of the heavy kinds."""
    pairs = [known for kind in HEAVY for known in scene_pairs(kind)[::2]]
    return from_frames(pairs, method, seed)


def tracked(kind: str, walk_seed: int, method: str, seed: int) -> list[Record]:
    """Return records of the steps of a tracked walk; the last one is that of the end.

    The error of a step is in px, as elsewhere; the last record holds that of the motion
    from the first frame to the last, so that drift shows.
    """
    from hybridvo import FramePair, Odometry
    from hybridvo.core.geometry import invert

    path = walk(kind, walk_seed)
    odometry = Odometry(method=method, seed=seed)
    odometry.set_pose(path.T_world_cam[0])
    found = []
    for index, frame in enumerate(path.frames):
        step = odometry.track(frame)
        if step.prev_index is None:
            continue
        prev = step.prev_index
        T_true = invert(path.T_world_cam[index]) @ path.T_world_cam[prev]
        pair = FramePair(path.frames[prev], frame, None)
        found.append(record(step.motion, T_true, path.exact[prev].depth, pair))
    return [*found, drift(path, step.T_world_cam)]


def drift(path: Walk, T_world_cam: np.ndarray) -> Record:
    """Return a record of the motion from the first frame of a walk to the last."""
    from hybridvo import FramePair

    first = path.exact[0]
    T_found = np.linalg.inv(T_world_cam) @ path.T_world_cam[0]
    T_true = np.linalg.inv(path.T_world_cam[-1]) @ path.T_world_cam[0]
    pair = FramePair(first, path.exact[-1], None)
    error = ego_flow_error(T_found, T_true, first.depth, pair)
    return labelled("end", error=error)


# -- pairs without images ------------------------------------------------------


def by_flow(scenario: str, method: str, seed: int) -> list[Record]:
    """Return records of made pairs: known noise, moving objects, gross errors of the flow."""
    return answers([made_pair(scenario, k) for k in SCENARIO_SEEDS], method, seed)


def under_the_model(seed: int) -> list[Record]:
    """Return records of static pairs with the noise that the refinement assumes."""
    return answers([model_pair(k) for k in MODEL_SEEDS], "classical", seed)


def weak(kind: str, seed: int) -> list[Record]:
    """Return records of pairs in which the motion is weak or not determined."""
    return answers(weak_pairs(kind), "classical", seed)


@functools.cache
def weak_pairs(kind: str) -> list[Known]:
    """Return four pairs, two of them without noise."""
    return [
        Known(case.pairs["made"], case.T_curr_prev, case.depth)
        for case in degenerate(kind)
    ]


def answers(pairs: Sequence[Known], method: str, seed: int) -> list[Record]:
    """Return records of pairs with their own flow."""
    from hybridvo import estimate

    found = []
    for known in pairs:
        answer = estimate(known.pair, method=method, seed=seed)
        found.append(record(answer, known.T_curr_prev, known.depth, known.pair))
    return found


# -- inputs that contradict each other -----------------------------------------


def contradicted(
    wrong: Callable[[Known], Known], method: str, seed: int
) -> list[Record]:
    """Return records of pairs in which the camera moves clearly, with a wrong input."""
    pairs = [*scene_pairs("static"), *scene_pairs("light")[:2]]
    return answers([wrong(known) for known in pairs], method, seed)


def halved_flow(known: Known) -> Known:
    """Return the pair with a flow of half its length."""
    pair = known.pair
    return known._replace(pair=replace(pair, flow=0.5 * pair.flow))


def doubled_depth(known: Known) -> Known:
    """Return the pair with a second depth map in another unit."""
    pair = known.pair
    curr = replace(pair.curr, depth=2.0 * pair.curr.depth)
    return known._replace(pair=replace(pair, curr=curr))


def frozen_image(known: Known) -> Known:
    """Return the pair with an image that was handed out twice; the depth is new."""
    pair = known.pair
    curr = replace(pair.curr, rgb=pair.prev.rgb)
    still = np.zeros_like(pair.flow)
    return known._replace(pair=replace(pair, curr=curr, flow=still))


# -- measuring -----------------------------------------------------------------


def measure_quick(names: Sequence[str], seeds: int, jobs: int) -> dict[str, Row]:
    """Return the figures of some cases, and of those beside which they are judged."""
    wanted = {*names, *(beside for name in names if (beside := without(name)))}
    groups: dict[str, list[str]] = {}
    for name in cases():
        if name in wanted:
            groups.setdefault(group_of(name), []).append(name)
    rows: dict[str, Row] = {}
    for some in run_groups(list(groups.values()), seeds, jobs):
        rows |= some
    rows = {name: rows[name] for name in cases() if name in wanted}
    for name, row in rows.items():
        if beside := without(name):
            row["without"] = rows[beside]
    return rows


def group_of(name: str) -> str:
    """Return the name of the cases that share their inputs with a case."""
    first = name.split("/")[0]
    return first if first.startswith(("ladder", "walk")) else first.split("_")[0]


def without(name: str) -> str:
    """Return the name of the same case without a prior; empty where it has none."""
    scene, method = name.split("/")
    has_prior = scene.startswith("prior_") and scene != "prior_none"
    return f"prior_none/{method}" if has_prior else ""


def run_groups(
    groups: Sequence[list[str]], seeds: int, jobs: int
) -> Iterator[dict[str, Row]]:
    """Measure groups of cases, in several processes where there are several jobs."""
    work = partial(measure_group, seeds=seeds)
    if jobs == 1 or len(groups) == 1:
        yield from map(work, groups)
        return
    # each process has one core: results do not depend on that, times do
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        yield from pool.map(work, groups)


def measure_group(names: Sequence[str], seeds: int) -> dict[str, Row]:
    """Return the figures of some cases."""
    known = cases()
    return {name: measure_case(name, known[name], seeds) for name in names}


def measure_case(name: str, run: Run, seeds: int = 1) -> Row:
    """Return the figures of a case; with several seeds also by how much they spread."""
    rows = [summarise(run(seed)) for seed in range(seeds)]
    row = rows[0]
    if name.startswith("ladder"):
        row["exact"] = True
    if seeds > 1:
        row["spread"] = spread(rows)
    return row
