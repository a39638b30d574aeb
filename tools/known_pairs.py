"""Pairs with a known motion that the measuring tools share: rendered, recorded, made by hand."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HEAVY = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
HEAVY_SEEDS = range(900, 906)
HEAVY_FRAMES = 20
HEAVY_AT = [0, 4, 9, 14, 18]
"""Frames of a scene, and those from which pairs are taken."""
SIZE = (218, 512)
UNDETERMINED = ("line", "patch", "every_pixel_its_own", "five_motions")
"""Pictures that do not determine the camera's motion; the other degenerate kinds are scenarios."""
REAL = {
    "tartanair_v2/P000": 1,
    "tum/redwood_livingroom_5": 1,
    "tum/rgbd_dataset_freiburg1_xyz_first10": 1,
    "tum/rgbd_dataset_freiburg1_rpy_100": 9,
    "real_dynamic/jvosf_two_people_moving": 1,
    "real_dynamic/jvosf_robot": 1,
    "real_dynamic/jvosf_opening_door": 1,
    "real_dynamic/adt_slam_left": 1,
    "real_dynamic/dgp_s1_cam05": 1,
    "real_dynamic/dgp_s2_cam01": 1,
    "real_dynamic/dgp_s2_cam07": 1,
    "real_dynamic/kitti02_stereo": 3,
    "real_dynamic/kitti06_stereo": 4,
}
"""Real and recorded sequences below the data folder: every how many-th pair is taken."""


class Case(NamedTuple):
    """Two frames as pairs by the name of their flow, with what is true of them."""

    pairs: dict[str, Any]
    T_curr_prev: np.ndarray
    depth: np.ndarray
    T_before: np.ndarray | None = None
    """Of the pair before, where there is one."""


def groups(data: Path) -> dict[str, Callable[[], Iterator[Case]]]:
    """Name of every group -> what makes its cases; with the recordings that ``data`` holds."""
    made: dict[str, Callable[[], Iterator[Case]]] = {
        kind: partial(heavy, kind) for kind in HEAVY
    }
    there = [name for name in REAL if (data / name).is_dir()]
    return made | {
        f"real_{name.split('/')[-1]}": partial(real, data, name) for name in there
    }


def heavy(kind: str) -> Iterator[Case]:
    """Development scenes in which most of the image moves: true and DIS flow, true depth."""
    for seed in HEAVY_SEEDS:
        yield from heavy_pairs(rendered(kind, seed, SIZE, HEAVY_FRAMES))


def rendered(kind: str, seed: int, size: tuple[int, int], frames: int) -> Any:
    """A rendered scene as a sequence."""
    from hybridvo_lab.synthetic.render import SyntheticSequence
    from hybridvo_lab.synthetic.scenes import make_scene

    height, width = size
    return SyntheticSequence(
        make_scene(kind, seed, height=height, width=width, frames=frames), name=kind
    )


def heavy_pairs(sequence: Any) -> Iterator[Case]:
    """Pairs spread over a scene, each with true and with DIS flow."""
    from hybridvo.flow.providers import dis_flow

    return from_sequence(
        sequence, {"true": scene_flow(sequence), "dis": dis_flow()}, HEAVY_AT
    )


def scene_flow(sequence: Any) -> Any:
    """Provider of a scene's true flow, whole: not masked where the scene is hidden."""
    from hybridvo.flow.providers import FlowField

    return lambda prev, curr: FlowField(
        sequence.flow(prev.index)[0], source="true", is_true=True
    )


def from_sequence(
    sequence: Any, flows: dict[str, Any], wanted: list[int]
) -> Iterator[Case]:
    """Pairs of neighbours with each flow."""
    from hybridvo.core.types import FramePair
    from hybridvo.flow.providers import with_flow

    true = lambda i: np.linalg.inv(sequence.poses[i + 1]) @ sequence.poses[i]  # noqa: E731
    for i in wanted:
        two = sequence.frame(i), sequence.frame(i + 1)
        bare = FramePair(*two, None, depth_source=sequence.depth_source)
        pairs = {name: with_flow(bare, flow) for name, flow in flows.items()}
        yield Case(pairs, true(i), two[0].depth, true(i - 1) if i > 0 else None)


def real(data: Path, name: str) -> Iterator[Case]:
    """Pairs of a sequence on disk: its flow files where there are any, and DIS."""
    from hybridvo import open_sequence
    from hybridvo.flow.providers import dis_flow, file_flow

    sequence = open_sequence(data / name)
    flows = {"file": file_flow(sequence)} if sequence.has_flow else {}
    wanted = list(range(0, len(sequence) - 1, REAL[name]))
    return from_sequence(sequence, flows | {"dis": dis_flow()}, wanted)


def degenerate(kind: str) -> Iterator[Case]:
    """Four pairs, two of them without noise, in which the motion is weak or not determined."""
    from hybridvo_lab.synthetic.noise_scenarios import (
        SCENARIOS,
        Scenario,
        make_pair,
    )

    for k in range(4):
        conditions = (
            Scenario(moving=0.0) if kind in UNDETERMINED else SCENARIOS[kind]
        )
        if k >= 2:
            conditions = replace(
                conditions, flow_noise_px=0.0, depth_noise=0.0, outliers=0.0
            )
        stream = np.random.SeedSequence([zlib.crc32(kind.encode()), k])
        pair, truth = make_pair(conditions, int(stream.generate_state(1)[0]), *SIZE)
        T = truth["T_curr_prev"]
        depth = truth["depth_true"]
        if kind in UNDETERMINED:
            pair = undetermined(
                kind, pair, truth, np.random.default_rng([k, len(kind)])
            )
            T = np.eye(4) if kind in ("every_pixel_its_own", "five_motions") else T
        yield Case({"made": pair}, T, depth)


def undetermined(
    kind: str, pair: Any, truth: dict[str, Any], rng: np.random.Generator
) -> Any:
    """The pair with depth on a line or a patch alone, or with flow of no or of five motions."""
    from hybridvo.core.geometry import ego_flow, se3_exp

    height, width = SIZE
    depth = pair.prev.depth
    flow = pair.flow
    if kind == "line":
        angle, (v, u) = rng.uniform(0, np.pi), np.mgrid[0:height, 0:width]
        off = (u - width / 2) * np.sin(angle) - (v - height / 2) * np.cos(angle)
        depth = np.where(np.abs(off) <= 1.5, depth, np.nan)
    elif kind == "patch":
        top = rng.integers(0, height - 20)
        left = rng.integers(0, width - 20)
        inside = np.zeros(SIZE, dtype=bool)
        inside[top : top + 20, left : left + 20] = True
        depth = np.where(inside, depth, np.nan)
    elif kind == "every_pixel_its_own":
        flow = rng.uniform(-30, 30, flow.shape).astype(np.float32)
    else:
        flow = flow - truth["flow_true"]
        limit = np.array([0.3] * 3 + [0.03] * 3)
        for columns in np.array_split(np.arange(width), 5):
            T = se3_exp(
                rng.uniform(0.5, 1.0, 6) * rng.choice([-1.0, 1.0], 6) * limit
            )
            camera = pair.prev.camera
            flow[:, columns] += ego_flow(truth["depth_true"], T, camera, camera)[
                :, columns
            ]
    prev = replace(pair.prev, depth=depth)
    return replace(pair, prev=prev, curr=replace(pair.curr, depth=None), flow=flow)
