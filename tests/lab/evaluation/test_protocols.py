from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, make_transform
from hybridvo.core.options import FlowOptions, Options
from hybridvo.core.types import Camera
from hybridvo_lab.commands.compare import compare
from hybridvo_lab.evaluation.protocols import pairs_summary, protocols
from hybridvo_lab.evaluation.scores import same_intrinsics

TAG = struct.pack("<f", 202021.25)
HEIGHT, WIDTH, FRAMES = 32, 64, 5
# frame numbers between which f grows
ZOOMS = {"ambush_4": (2, 4), "shaman_2": (1, 3)}
SCENES = ("alley_1", "alley_2", "ambush_4", "shaman_2")
STEP = np.array([0.03, -0.01, 0.02])


def camera(name: str, number: int) -> Camera:
    first, last = ZOOMS.get(name, (0, 0))
    f = 70.0 * (1 + 0.002 * (min(max(number, first), last) - first))
    return Camera(
        f, f, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, height=HEIGHT, width=WIDTH
    )


@pytest.fixture(scope="module")
def sintel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first five frames of four sequences; every camera moves by STEP."""
    training = tmp_path_factory.mktemp("data") / "MPI-Sintel" / "training"
    texture = np.random.default_rng(0).integers(
        0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    image = cv2.imencode(".png", texture)[1].tobytes()
    size = struct.pack("<ii", WIDTH, HEIGHT)
    depth = 4 + np.linspace(0, 4, WIDTH)[None, :].repeat(HEIGHT, axis=0)
    T, E = make_transform(np.eye(3), STEP), np.eye(4)
    for name in SCENES:
        E = np.eye(4)
        for number in range(1, FRAMES + 1):
            K = camera(name, number)
            flow = ego_flow(depth, T, K, camera(name, number + 1))
            content = {
                f"final/{name}/frame_{number:04d}.png": image,
                f"depth/{name}/frame_{number:04d}.dpt": TAG
                + size
                + depth.astype("<f4").tobytes(),
                f"camdata_left/{name}/frame_{number:04d}.cam": (
                    TAG
                    + K.K.astype("<f8").tobytes()
                    + E[:3].astype("<f8").tobytes()
                ),
                f"flow/{name}/frame_{number:04d}.flo": TAG
                + size
                + flow.astype("<f4").tobytes(),
            }
            for path, data in content.items():
                if number < FRAMES or not path.startswith("flow"):
                    (training / path).parent.mkdir(parents=True, exist_ok=True)
                    (training / path).write_bytes(data)
            E = T @ E
    return training.parent


def test_the_complete_set_has_the_published_number_of_pairs() -> None:
    paper = protocols()["paper"]
    assert (paper.pairs, len(paper.sequences)) == (992, 23)
    # 49 pairs change their intrinsics
    assert sum(paper.sequences.values()) - 23 == 1041
    frames = {name: frames - 1 for name, frames in paper.sequences.items()}
    frames["ambush_4"] -= 23
    frames["shaman_2"] -= 26
    scored = [
        {"name": name, "pairs_scored": count} for name, count in frames.items()
    ]
    assert not pairs_summary(paper, scored)["note"]
    keys = {key for key, _, _ in paper.columns}
    assert all(line["source"] and keys <= set(line) for line in paper.published)


@pytest.mark.slow
def test_the_paper_leaves_out_pairs_whose_intrinsics_change(
    sintel: Path, tmp_path: Path
) -> None:
    options = Options(flow=FlowOptions(source="file"))
    methods = ("identity",)
    compare((sintel,), tmp_path, methods=methods, options=options, protocol="paper")
    result = json.loads((tmp_path / "results.json").read_text())
    left_out = {
        s["name"]: [row["index"] for row in s["left_out"]]
        for s in result["sequences"]
    }
    assert left_out.pop("ambush_4") == [1, 2] and left_out.pop("shaman_2") == [0, 1]
    assert not any(left_out.values())
    protocol = result["protocol"]
    assert protocol["pairs"] == 4 * 4 - 4
    assert "12 pairs, the complete set has 992" in protocol["note"]
    assert len(protocol["missing_sequences"]) == 19
    (line,) = result["totals"]
    # standing still is wrong by the motion itself: the component means of the paper
    assert line["t_err"] == pytest.approx(np.abs(STEP).mean(), rel=1e-9)
    assert line["r_err_deg"] == pytest.approx(0, abs=1e-9)
    with (tmp_path / "pairs.csv").open() as file:
        epe = [float(row["epe"]) for row in csv.DictReader(file)]
    assert len(epe) == 12 and line["epe"] == pytest.approx(np.mean(epe))


def test_cameras_are_the_same_to_rounding() -> None:
    K = Camera(1120.0, 1120.0, 511.5, 217.5, height=436, width=1024)
    assert same_intrinsics(
        K,
        Camera(1120.0 * (1 + 1e-12), 1120.0, 511.5, 217.5, height=436, width=1024),
    )
    assert not same_intrinsics(
        K, Camera(1120.01, 1120.0, 511.5, 217.5, height=436, width=1024)
    )
    assert not same_intrinsics(
        K, Camera(1120.0, 1120.0, 511.5, 217.5, height=435, width=1024)
    )
