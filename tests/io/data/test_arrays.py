"""Stacks of arrays as a sequence, from one file or several, and what is refused of them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridvo import InputError, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.run.cli import main

N = 4
SIZE = (24, 32)
K = np.array([[40.0, 0, 15.5], [0, 41.0, 11.5], [0, 0, 1]])


def stacks() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, 0, 3] = np.arange(N)
    return {
        "rgb": rng.integers(0, 256, (N, *SIZE, 3), dtype=np.uint8),
        "depth": rng.uniform(0.5, 4, (N, *SIZE)).astype(np.float32),
        "K": K,
        "timestamps": 5.0 + 0.1 * np.arange(N),
        "poses": poses,
    }


def write(root: Path, how: str, arrays: dict[str, Any]) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    if how == "npy":
        for name, array in arrays.items():
            np.save(root / f"{name}.npy", array)
        return root
    path = root / "walk.npz"
    save = np.savez_compressed if how == "packed" else np.savez
    save(path, **arrays)
    return path


@pytest.mark.parametrize("how", ["npy", "npz", "packed"])
def test_stacks_read_back(how: str, tmp_path: Path) -> None:
    arrays = stacks()
    sequence = open_sequence(write(tmp_path / "walk", how, arrays))
    assert (sequence.kind, sequence.name, len(sequence)) == ("arrays", "walk", N)
    assert sequence.warnings == []
    np.testing.assert_array_equal(sequence.camera(0).K, K)
    np.testing.assert_array_equal(sequence.timestamps, arrays["timestamps"])
    np.testing.assert_array_equal(sequence.poses, arrays["poses"])
    for i in (0, 3, 1):
        np.testing.assert_array_equal(sequence[i].rgb, arrays["rgb"][i])
        np.testing.assert_array_equal(sequence[i].depth, arrays["depth"][i])


def test_grey_images_and_depth_of_whole_numbers(tmp_path: Path) -> None:
    arrays = stacks()
    grey = arrays["rgb"][..., 0]
    stored = np.full((N, *SIZE), 5000, np.uint16)
    stored[:, 0, 0] = 65535  # without depth
    given = {"rgb": grey, "depth": stored, "K": K}
    path = write(tmp_path / "a", "npz", given)
    with pytest.raises(
        InputError, match="whole numbers: expected an array 'depth_scale'"
    ):
        open_sequence(path)
    sequence = open_sequence(path, depth_scale=5000)
    assert sequence[0].depth[1, 1] == 1.0 and sequence[0].depth[0, 0] == 0.0
    assert (sequence[0].rgb[..., 2] == grey[0]).all()
    assert any("30 frames a second assumed" in text for text in sequence.warnings)
    scaled = write(tmp_path / "b", "npy", given | {"depth_scale": np.array(1000)})
    assert open_sequence(scaled)[0].depth[1, 1] == 5.0


def test_arrays_that_are_not_packed_stay_on_the_disk(tmp_path: Path) -> None:
    rgb = np.zeros((200, 120, 160, 3), np.uint8)
    depth = np.ones((200, 120, 160), np.float32)
    for how in ("npy", "npz"):
        path = write(tmp_path / how, how, {"rgb": rgb, "depth": depth, "K": K})
        camera = "200,200,80,60"
        open_sequence(path, camera=camera)  # what is loaded once does not count
        tracemalloc.start()
        sequence = open_sequence(path, camera=camera)
        for i in range(0, 200, 20):
            sequence[i]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 0.1 * (rgb.nbytes + depth.nbytes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rgb": None}, "no array 'rgb'"),
        ({"K": None}, "no array 'K'"),
        ({"K": np.eye(4)}, "K: (Camera|expected)"),
        ({"rgb": np.zeros((N, *SIZE, 4), np.uint8)}, "rgb: expected"),
        ({"rgb": np.zeros((N, *SIZE, 3), np.float32)}, "of uint8"),
        ({"depth": np.ones((N, 12, 16), np.float32)}, "as rgb has"),
        ({"timestamps": np.arange(N - 1)}, "expected 4 numbers"),
        ({"timestamps": np.zeros(N)}, "timestamps must be finite and increase"),
        ({"poses": np.zeros((N, 4, 4), "M8[s]")}, "poses: expected numbers"),
        ({"poses": np.zeros((N, 4, 4))}, "rigid"),
        ({"depth_scale": np.array(-1.0)}, "depth_scale: expected one number"),
    ],
)
@pytest.mark.parametrize("how", ["npz", "packed"])
def test_what_cannot_be_is_one_line(
    change: dict[str, Any], words: str, how: str, tmp_path: Path
) -> None:
    arrays = {k: v for k, v in (stacks() | change).items() if v is not None}
    path = write(tmp_path, how, arrays)
    with pytest.raises(InputError, match=words) as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)


def test_python_objects_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.npz"
    np.savez(path, rgb=np.array([{"a": 1}], dtype=object), depth=np.ones(3))
    with pytest.raises(FormatError, match="Python objects"):
        open_sequence(path)
    whole = write(tmp_path / "whole", "packed", stacks()).read_bytes()
    rng = np.random.default_rng(0)
    for cut in (0, 10, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:cut])
        with pytest.raises(FormatError, match="damaged"):
            open_sequence(path)
    for _ in range(30):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 20).tolist():
            data[place] = int(rng.integers(0, 256))
        path.write_bytes(data)
        try:
            open_sequence(path)
        except InputError:
            continue


def test_the_command_takes_a_stack(tmp_path: Path) -> None:
    path = write(tmp_path, "npz", stacks())
    out = tmp_path / "out"
    run = ["run", str(path), "--method", "identity", "--out", str(out), "-q"]
    assert main(run) == 0
    assert len((out / "trajectory.tum").read_text().splitlines()) == N
