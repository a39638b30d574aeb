"""The inputs of ``tools/golden.py``: made once, kept as arrays, read by every later revision.

A group is a folder with one npz file for each pair. What a changed generator, reader or optical
flow would give is not seen here: the arrays of one revision judge the estimators of another.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

HEAVY = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
HEAVY_SEEDS = range(900, 906)
HEAVY_FRAMES, HEAVY_AT = 20, [0, 4, 9, 14, 18]
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
WALK_FRAMES, WALK_SIZE = 12, (480, 640)

Cases = Iterator[tuple[dict[str, Any], np.ndarray, dict[str, Any]]]


def write_inputs(folder: Path, data: Path) -> None:
    """Every group below ``folder``, and ``index.json`` with the hash of the arrays of each."""
    groups: dict[str, Cases] = {kind: heavy(kind) for kind in HEAVY}
    from hybridvo.synthetic.scenarios import DEGENERATE_SCENARIOS, MAIN_SCENARIOS

    groups |= {f"scenario_{name}": scenario(name) for name in MAIN_SCENARIOS}
    groups |= {
        f"degenerate_{name}": degenerate(name) for name in (*DEGENERATE_SCENARIOS, *UNDETERMINED)
    }
    groups["model_noise"] = model_noise()
    for name in REAL:
        if (data / name).is_dir():
            groups["real_" + name.split("/")[-1]] = real(data, name)
    hashes = {}
    for name, cases in groups.items():
        digest = hashlib.sha256()
        (folder / name).mkdir(parents=True, exist_ok=True)
        for k, (pairs, T, extra) in enumerate(cases):
            arrays = to_arrays(pairs) | {"T_curr_prev": T} | extra
            np.savez(folder / name / f"{k:03d}.npz", **arrays)
            for key in sorted(arrays):
                digest.update(key.encode() + np.ascontiguousarray(arrays[key]).tobytes())
        hashes[name] = digest.hexdigest()[:16]
        print(name)
    walk(folder)
    key = hashlib.sha256(json.dumps(hashes).encode()).hexdigest()[:16]
    (folder / "index.json").write_text(json.dumps({"key": key, "groups": hashes}, indent=1) + "\n")


def to_arrays(pairs: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays of the same two frames with one or more flows, by the name of the flow."""
    pair = next(iter(pairs.values()))
    arrays: dict[str, Any] = {"depth_source": np.array(pair.depth_source)}
    for side in ("prev", "curr"):
        frame = getattr(pair, side)
        arrays[f"{side}.K"] = frame.camera.K
        arrays[f"{side}.shape"] = np.array(frame.camera.shape)
        arrays[f"{side}.time"] = np.array([frame.timestamp, frame.index], dtype=np.float64)
        for name in ("rgb", "depth", "depth_variance", "mask"):
            arrays[f"{side}.{name}"] = getattr(frame, name)
    for flow, value in pairs.items():
        arrays[f"flow.{flow}"] = value.flow
        arrays[f"variance.{flow}"] = value.flow_variance
        arrays[f"valid.{flow}"] = value.flow_valid
        arrays[f"is_true.{flow}"] = np.array(value.flow_is_true)
    return {name: array for name, array in arrays.items() if array is not None}


def read_pair(path: Path, flow: str) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray | None]:
    """The pair with this flow, its true motion and depth, and the true motion before or None."""
    from hybridvo import Camera, Frame, FramePair

    with np.load(path) as file:
        arrays = {
            name: file[name] for name in file.files if name.endswith("." + flow) or "." not in name
        }
        sides = {n: file[n] for n in file.files if n.startswith(("prev.", "curr."))}
    frames = []
    for side in ("prev", "curr"):
        time, index = sides[f"{side}.time"]
        camera = Camera.from_matrix(sides[f"{side}.K"], *sides[f"{side}.shape"].tolist())
        images = {n: sides.get(f"{side}.{n}") for n in ("rgb", "depth", "depth_variance", "mask")}
        frames.append(Frame(camera=camera, timestamp=time, index=int(index), **images))
    pair = FramePair(
        *frames,
        arrays.get(f"flow.{flow}"),
        arrays.get(f"variance.{flow}"),
        arrays.get(f"valid.{flow}"),
        flow_source=flow,
        flow_is_true=bool(arrays[f"is_true.{flow}"]),
        depth_source=str(arrays["depth_source"]),
    )
    depth = arrays.get("depth_true", pair.prev.depth)
    return pair, arrays["T_curr_prev"], depth, arrays.get("T_before")


def heavy(kind: str) -> Cases:
    """Development scenes in which most of the image moves: true and DIS flow, true depth."""
    for seed in HEAVY_SEEDS:
        yield from heavy_pairs(rendered(kind, seed, SIZE, HEAVY_FRAMES))


def rendered(kind: str, seed: int, size: tuple[int, int], frames: int) -> Any:
    """A rendered scene as a sequence."""
    from hybridvo.synthetic.render import SyntheticSequence
    from hybridvo.synthetic.scenes import make_scene

    height, width = size
    return SyntheticSequence(
        make_scene(kind, seed, height=height, width=width, frames=frames), name=kind
    )


def heavy_pairs(sequence: Any) -> Cases:
    """Pairs spread over a scene, each with true and with DIS flow."""
    from hybridvo.flow import dis_flow

    return from_sequence(sequence, {"true": scene_flow(sequence), "dis": dis_flow()}, HEAVY_AT)


def scene_flow(sequence: Any) -> Any:
    """Provider of a scene's true flow, whole: not masked where the scene is hidden."""
    from hybridvo.flow import FlowField

    return lambda prev, curr: FlowField(sequence.flow(prev.index)[0], source="true", is_true=True)


def from_sequence(sequence: Any, flows: dict[str, Any], wanted: list[int]) -> Cases:
    """Pairs of neighbours with each flow; the true motion of the pair before where there is one."""
    from hybridvo import FramePair

    T_world_cam = np.asarray(sequence.poses)
    for i in wanted:
        prev, curr = sequence.frame(i), sequence.frame(i + 1)
        pairs = {}
        for name, provider in flows.items():
            field = provider(prev, curr)
            pairs[name] = FramePair(
                prev, curr, field.flow, field.variance, field.valid, flow_source=name,
                flow_is_true=field.is_true, depth_source=sequence.depth_source,
            )  # fmt: skip
        extra = {}
        if i > 0:
            extra["T_before"] = np.linalg.inv(T_world_cam[i]) @ T_world_cam[i - 1]
        yield pairs, np.linalg.inv(T_world_cam[i + 1]) @ T_world_cam[i], extra


def real(data: Path, name: str) -> Cases:
    """Pairs of a sequence on disk: its flow files where there are any, and DIS."""
    from hybridvo import open_sequence
    from hybridvo.flow import dis_flow, file_flow

    sequence = open_sequence(data / name)
    flows = {"file": file_flow(sequence)} if sequence.has_flow else {}
    wanted = list(range(0, len(sequence) - 1, REAL[name]))
    return from_sequence(sequence, flows | {"dis": dis_flow()}, wanted)


def scenario(name: str) -> Cases:
    """Pairs without images: known noise, moving objects, gross errors of the flow."""
    from hybridvo.synthetic.scenarios import make_pair

    for seed in range(5):
        pair, truth = make_pair(name, seed)
        yield {"made": pair}, truth["T_curr_prev"], {"depth_true": truth["depth_true"]}


def model_noise() -> Cases:
    """Static pairs whose noise is what the refinement assumes: the covariance must be right."""
    from hybridvo.synthetic.scenarios import make_model_pair

    for seed in range(60):
        pair, truth = make_model_pair(seed)
        depth = truth["depth_true"].astype(np.float32)
        yield {"made": pair}, truth["T_curr_prev"], {"depth_true": depth}


def degenerate(kind: str) -> Cases:
    """Four pairs, two of them without noise, in which the motion is weak or not determined."""
    from hybridvo.synthetic.scenarios import SCENARIOS, Scenario, make_pair

    for k in range(4):
        conditions = Scenario(moving=0.0) if kind in UNDETERMINED else SCENARIOS[kind]
        if k >= 2:
            conditions = replace(conditions, flow_noise_px=0.0, depth_noise=0.0, outliers=0.0)
        stream = np.random.SeedSequence([zlib.crc32(kind.encode()), k])
        pair, truth = make_pair(conditions, int(stream.generate_state(1)[0]), *SIZE)
        T, depth = truth["T_curr_prev"], truth["depth_true"]
        if kind in UNDETERMINED:
            pair = undetermined(kind, pair, truth, np.random.default_rng([k, len(kind)]))
            T = np.eye(4) if kind in ("every_pixel_its_own", "five_motions") else T
        yield {"made": pair}, T, {"depth_true": depth}


def undetermined(kind: str, pair: Any, truth: dict[str, Any], rng: np.random.Generator) -> Any:
    """The pair with depth on a line or a patch alone, or with flow of no or of five motions."""
    from hybridvo.geometry import ego_flow, se3_exp

    height, width = SIZE
    depth, flow = pair.prev.depth, pair.flow
    if kind == "line":
        angle, (v, u) = rng.uniform(0, np.pi), np.mgrid[0:height, 0:width]
        off = (u - width / 2) * np.sin(angle) - (v - height / 2) * np.cos(angle)
        depth = np.where(np.abs(off) <= 1.5, depth, np.nan)
    elif kind == "patch":
        top, left = rng.integers(0, height - 20), rng.integers(0, width - 20)
        inside = np.zeros(SIZE, dtype=bool)
        inside[top : top + 20, left : left + 20] = True
        depth = np.where(inside, depth, np.nan)
    elif kind == "every_pixel_its_own":
        flow = rng.uniform(-30, 30, flow.shape).astype(np.float32)
    else:
        flow = flow - truth["flow_true"]
        limit = np.array([0.3] * 3 + [0.03] * 3)
        for columns in np.array_split(np.arange(width), 5):
            T = se3_exp(rng.uniform(0.5, 1.0, 6) * rng.choice([-1.0, 1.0], 6) * limit)
            camera = pair.prev.camera
            flow[:, columns] += ego_flow(truth["depth_true"], T, camera, camera)[:, columns]
    prev = replace(pair.prev, depth=depth)
    return replace(pair, prev=prev, curr=replace(pair.curr, depth=None), flow=flow)


def walk(folder: Path) -> None:
    """A sequence to track at 640x480 as arrays."""
    sequence = rendered("light", 0, WALK_SIZE, WALK_FRAMES)
    frames = [sequence.frame(i) for i in range(WALK_FRAMES)]
    np.savez(
        folder / "walk.npz",
        K=frames[0].camera.K,
        rgb=np.stack([frame.rgb for frame in frames]),
        depth=np.stack([frame.depth for frame in frames]),
        time=np.array([frame.timestamp for frame in frames]),
        poses=sequence.poses,
    )
