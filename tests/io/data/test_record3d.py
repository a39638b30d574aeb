"""Record3D: an archive as the app writes it, with maps packed by LZFSE."""

from __future__ import annotations

import json
import struct
import sys
import types
import zipfile
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo import Camera, InputError, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.io.data.confined import limits

DEPTH_SIZE = (8, 6)
SIZE = (24, 18)
"""Upright images of three times the pixels of depth."""


def packed(data: bytes) -> bytes:
    """A stream of LZFSE whose one block is stored as it is."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def unpacked(data: bytes) -> bytes:
    """What such a stream holds; stands in where the library is not installed."""
    if data[:4] != b"bvx-" or data[-4:] != b"bvx$":
        raise ValueError("no stream of LZFSE")
    return data[8:-4]


@pytest.fixture(autouse=True)
def lzfse(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("liblzfse") is None:
        module = types.ModuleType("liblzfse")
        module.__spec__ = ModuleSpec("liblzfse", None)
        module.decompress = unpacked
        monkeypatch.setitem(sys.modules, "liblzfse", module)
        # a child process knows nothing of it
        monkeypatch.setattr(limits, "is_available", lambda: False)


def metadata(**changes: object) -> dict[str, object]:
    """What the app writes of a phone that stands, then goes one metre ahead."""
    ahead = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0]  # ARKit looks along -z
    content = {
        "h": SIZE[0],
        "w": SIZE[1],
        "dh": DEPTH_SIZE[0],
        "dw": DEPTH_SIZE[1],
        "fps": 60,
        # column by column
        "K": [30.0, 0, 0, 0, 33.0, 0, 8.5, 11.5, 1],
        "poses": [[0.0, 0, 0, 1, 0, 0, 0], ahead, ahead],
        "cameraType": 1,
    }
    return {name: value for name, value in (content | changes).items() if value}


def parts(**changes: object) -> dict[str, bytes]:
    files = {"metadata": json.dumps(metadata(**changes)).encode()}
    for i in range(3):
        image = np.full((*SIZE, 3), (10, 120, 240), np.uint8)
        depth = np.full(DEPTH_SIZE, 1.5 + i, "<f4")
        depth[0, 0] = np.nan
        confidence = np.full(DEPTH_SIZE, 2, np.uint8)
        confidence[1, 1] = 0
        files[f"rgbd/{i}.jpg"] = cv2.imencode(".jpg", image)[1].tobytes()
        files[f"rgbd/{i}.depth"] = packed(depth.tobytes())
        files[f"rgbd/{i}.conf"] = packed(confidence.tobytes())
    return files


def stating(**changes: object) -> dict[str, bytes]:
    return {"metadata": json.dumps(metadata(**changes)).encode()}


def every(ending: str, content: bytes) -> dict[str, bytes]:
    return {f"rgbd/{i}.{ending}": content for i in range(3)}


def archive(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as zipped:
        for name, data in files.items():
            zipped.writestr(name, data)
    return path


def folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path


@pytest.mark.parametrize("make", [archive, folder])
def test_what_the_app_writes(make, tmp_path: Path) -> None:
    path = make(tmp_path / "scan.r3d", parts())
    sequence = open_sequence(path)
    assert (sequence.kind, len(sequence)) == ("record3d", 3)
    np.testing.assert_allclose(sequence.timestamps, np.arange(3) / 60)
    # twice the pixels of depth: two thirds of those of the image
    camera = sequence.camera(0)
    assert camera.shape == (16, 12)
    np.testing.assert_allclose([camera.fx, camera.fy], [20, 22])
    np.testing.assert_allclose([camera.cx, camera.cy], [5.5, 7.5])
    frame = sequence[1]
    np.testing.assert_allclose(frame.rgb[8, 6], (240, 120, 10), atol=3)
    assert (frame.depth[4:, 4:] == 2.5).all()
    # a pixel of no confidence, and one that is no number
    assert (frame.depth[2:4, 2:4] == 0).all()
    assert not (frame.depth[:2, :2] > 0).any()
    # one metre ahead is along z of a camera that looks along z
    T = np.linalg.inv(sequence.poses[0]) @ sequence.poses[1]
    np.testing.assert_allclose(T[:3, 3], [0, 0, 1], atol=1e-12)
    # y of the camera is down, where the world's y is up
    np.testing.assert_allclose(sequence.poses[0][:3, 1], [0, -1, 0], atol=1e-12)
    assert path in sequence.files() or path / "metadata" in sequence.files()


def test_a_camera_and_a_time_for_each_frame(tmp_path: Path) -> None:
    each = [[30.0 + 3 * i, 30, 8.5, 11.5] for i in range(3)]
    changes = {"perFrameIntrinsicCoeffs": each, "frameTimestamps": [5.0, 5.1, 5.3]}
    sequence = open_sequence(archive(tmp_path / "a.r3d", parts(**changes)))
    np.testing.assert_allclose(
        [sequence[i].camera.fx for i in range(3)], [20, 22, 24]
    )
    np.testing.assert_allclose(sequence.timestamps, [5, 5.1, 5.3])
    given = open_sequence(tmp_path / "a.r3d", camera="60,60,8.5,11.5")
    assert given.camera(2).fx == 40
    rolling = Camera(
        60, 60, 8.5, 11.5, height=SIZE[0], width=SIZE[1], readout_ms=20
    )
    given = open_sequence(tmp_path / "a.r3d", camera=rolling)
    assert given.camera(2).readout_ms == 20


def test_older_metadata_has_no_size_of_depth(tmp_path: Path) -> None:
    files = parts(dw=None, dh=None, fps=None, poses=None)
    depth = packed(np.full((256, 192), 2, "<f4").tobytes())
    files = {name: data for name, data in files.items() if ".conf" not in name}
    files |= {name: depth for name in files if name.endswith(".depth")}
    image = cv2.imencode(".jpg", np.zeros((960, 720, 3), np.uint8))[1].tobytes()
    files |= {name: image for name in files if name.endswith(".jpg")}
    sequence = open_sequence(archive(tmp_path / "a.r3d", files))
    assert sequence.camera(0).shape == (512, 384)
    assert sequence.poses is None
    assert "30 frames a second assumed" in " ".join(sequence.warnings)
    files["rgbd/0.depth"] = packed(bytes(100))
    with pytest.raises(FormatError, match="100 bytes fit to none"):
        open_sequence(archive(tmp_path / "b.r3d", files))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"metadata": b"{}"}, "192 bytes fit to none"),
        ({"metadata": b"[1]"}, "expected a JSON object"),
        ({"metadata": b"\xff"}, "expected a JSON object"),
        (stating(K=[1, 2]), "9 numbers"),
        (stating(K=[0.0] * 8 + [1]), "camera"),
        (stating(poses=[[1, 2]]), "rows of 7"),
        (stating(poses="north"), "poses"),
        (stating(dw=7), "of one shape"),
        (stating(dw=6 * 10**6, dh=8 * 10**6), "depth of fewer pixels"),
        (every("jpg", b"no image"), "PNG or JPEG"),
        (every("depth", b"no stream"), r"0\.depth: damaged"),
        (every("depth", packed(b"123")), "expected 192 bytes"),
        (every("depth", bytes(10**5)), "at most 4288 bytes"),
        (every("conf", packed(b"1")), "expected 48 bytes"),
    ],
)
def test_damage_is_one_line(change: dict, words: str, tmp_path: Path) -> None:
    path = archive(tmp_path / "a.r3d", parts() | change)
    with pytest.raises(InputError, match=words) as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value) and "a.r3d" in str(caught.value)


def test_files_that_are_no_archive(tmp_path: Path) -> None:
    path = tmp_path / "a.r3d"
    whole = archive(path, parts()).read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(FormatError, match="which is a zip archive"):
            open_sequence(path)
    with pytest.raises(FormatError, match="expected a file 'metadata'"):
        open_sequence(archive(path, {"rgbd/0.jpg": b""}))
    with pytest.raises(InputError, match=r"no frames: expected rgbd/0\.jpg"):
        open_sequence(archive(path, {"metadata": b"{}"}))
    # a byte in the middle of an image
    damaged = bytearray(whole)
    place = whole.index(b"rgbd/1.jpg") + 200
    damaged[place] ^= 255
    path.write_bytes(damaged)
    sequence = open_sequence(path)
    with pytest.raises(FormatError, match=r"rgbd/1\.jpg: damaged"):
        sequence[1]


def test_maps_that_the_library_itself_has_packed(tmp_path: Path) -> None:
    lzfse = pytest.importorskip("liblzfse")
    if not hasattr(lzfse, "compress"):
        pytest.skip("the library is a stand-in")
    files = parts()
    depth = np.tile(np.linspace(1, 2, 6, dtype="<f4"), (8, 1))
    for i in range(3):
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.tobytes())
    assert not files["rgbd/0.depth"].startswith(b"bvx-")
    sequence = open_sequence(archive(tmp_path / "a.r3d", files))
    np.testing.assert_array_equal(sequence[0].depth[4::2, ::2], depth[2:])
