"""Image, flow, depth and camera files: exact bytes, exact values, and nothing but FormatError."""

from __future__ import annotations

import io as stdio
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridvo.core.errors import FormatError
from hybridvo.io.data import image_io as io

TAG = b"PIEH"
RELAXED = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
GRID = np.arange(20 * 24).reshape(20, 24)


def tagged(array: np.ndarray) -> bytes:
    return (
        TAG
        + struct.pack("<ii", array.shape[1], array.shape[0])
        + array.astype("<f4").tobytes()
    )


def cam_bytes() -> bytes:
    K = np.array([[1120, 0, 511.5], [0, 1120, 217.5], [0, 0, 1.0]])
    Rt = np.hstack([np.eye(3), [[1.0], [2.0], [3.0]]])
    return TAG + K.astype("<f8").tobytes() + Rt.astype("<f8").tobytes()


def npy_bytes(array: np.ndarray, allow_pickle: bool = False) -> bytes:
    buffer = stdio.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


def encoded(extension: str, array: np.ndarray) -> bytes:
    return cv2.imencode(extension, array)[1].tobytes()


RGB = np.dstack([GRID % 251] * 3).astype(np.uint8)
FLOW = np.arange(12, dtype=np.float32).reshape(2, 3, 2) / 4
FILES = {
    "flow.flo": (tagged(FLOW), io.read_flow),
    "depth.dpt": (tagged(FLOW[..., 0]), io.read_depth),
    "camera.cam": (cam_bytes(), io.read_cam),
    "flow.npy": (npy_bytes(FLOW), lambda p: io.read_npy(p, channels=2)),
    "image.png": (encoded(".png", RGB), io.read_rgb),
    "image.jpg": (encoded(".jpg", RGB), io.read_rgb),
    "depth.png": (encoded(".png", (GRID * 100).astype(np.uint16)), io.read_depth),
    "kitti.png": (
        encoded(".png", np.dstack([GRID % 2, GRID, GRID]).astype(np.uint16)),
        io.read_flow,
    ),
    "rgba.png": (
        encoded(".png", np.ones((4, 5), "<f4").view(np.uint8).reshape(4, 5, 4)),
        lambda p: io.read_png(p, np.uint8, 4, "a float32 depth PNG"),
    ),
}
"""File name -> whole content and its reader."""


def written(folder: Path, name: str, data: bytes) -> Path:
    (folder / name).write_bytes(data)
    return folder / name


def test_layouts_by_hand(tmp_path):
    flow, _ = io.read_flow(written(tmp_path, "a.flo", FILES["flow.flo"][0]))
    assert flow.shape == (2, 3, 2) and flow.dtype == np.float32
    assert flow[1, 2].tolist() == [10 / 4, 11 / 4]
    depth = io.read_depth(
        written(tmp_path, "a.dpt", tagged(np.arange(6.0).reshape(2, 3)))
    )
    assert depth.tolist() == [[0, 1, 2], [3, 4, 5]]
    K, T = io.read_cam(written(tmp_path, "a.cam", cam_bytes()))
    assert (K[0, 0], K[0, 2], K[1, 2]) == (1120, 511.5, 217.5)
    assert T[:3, 3].tolist() == [1, 2, 3] and T[3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (7, 3)])
def test_write_then_read(shape, tmp_path, rng):
    flow = rng.normal(size=(*shape, 2)).astype(np.float32)
    io.write_flo(tmp_path / "a.flo", flow)
    np.testing.assert_array_equal(io.read_flow(tmp_path / "a.flo")[0], flow)
    np.testing.assert_array_equal(
        cv2.readOpticalFlow(str(tmp_path / "a.flo")), flow
    )
    io.write_dpt(tmp_path / "a.dpt", flow[..., 0])
    np.testing.assert_array_equal(io.read_depth(tmp_path / "a.dpt"), flow[..., 0])
    io.write_cam(tmp_path / "a.cam", np.diag([2.0, 3.0, 1.0]), np.eye(4))
    K, T = io.read_cam(tmp_path / "a.cam")
    assert (
        K.tolist() == np.diag([2.0, 3.0, 1.0]).tolist()
        and T.tolist() == np.eye(4).tolist()
    )


def test_kitti_flow_layout(tmp_path):
    # R = u, G = v, B = valid: OpenCV writes B, G, R
    bgr = np.zeros((1, 2, 3), np.uint16)
    bgr[0, 0] = (1, 32768 + 64, 32768 - 32)
    flow, valid = io.read_flow(written(tmp_path, "a.png", encoded(".png", bgr)))
    assert flow[0, 0].tolist() == [-0.5, 1.0] and np.isnan(flow[0, 1]).all()
    assert valid.tolist() == [[True, False]]


def test_unknown_flow_of_middlebury_is_not_valid(tmp_path):
    flow = FLOW.copy()
    flow[0, 1] = 1.5e9
    _, valid = io.read_flow(written(tmp_path, "a.flo", tagged(flow)))
    assert not valid[0, 1] and valid.sum() == 5


@pytest.mark.parametrize("name", FILES)
@RELAXED
@given(data=st.data())
def test_cut_files_raise_format_error(name, tmp_path, data):
    content, reader = FILES[name]
    # the last bytes of a PNG or JPEG hold no pixels
    length = data.draw(
        st.integers(0, len(content) - 1 - 12 * name.endswith((".png", ".jpg")))
    )
    with pytest.raises(FormatError, match=name):
        reader(written(tmp_path, name, content[:length]))


@pytest.mark.parametrize("name", FILES)
@RELAXED
@given(data=st.data())
def test_flipped_bytes_raise_nothing_else(name, tmp_path, data):
    content, reader = FILES[name]
    broken = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        broken[data.draw(st.integers(0, len(content) - 1))] = data.draw(
            st.integers(0, 255)
        )
    path = written(tmp_path, name, bytes(broken))
    try:
        reader(path)
    except FormatError as error:
        assert name in str(error)


@pytest.mark.parametrize(
    ("width", "height"), [(0, 2), (2, 0), (-1, 5), (50_000, 50_000)]
)
def test_sizes_that_no_image_has_are_refused_by_the_header(width, height, tmp_path):
    chunk = b"IHDR" + struct.pack(
        ">IIBBBBB", width % 2**32, height % 2**32, 16, 0, 0, 0, 0
    )
    for name, head in {
        "flow.flo": TAG + struct.pack("<ii", width, height) + bytes(100),
        "depth.dpt": TAG + struct.pack("<ii", width, height) + bytes(100),
        "image.png": b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + chunk
        + bytes(4),
    }.items():
        with pytest.raises(FormatError, match=rf"{name}.*declares"):
            FILES[name][1](written(tmp_path, name, head))


def test_wrong_tags_types_and_shapes(tmp_path):
    flo = FILES["flow.flo"][0]
    eight = encoded(".png", (GRID % 200).astype(np.uint8))
    cases = [
        ("x.flo", TAG[::-1] + flo[4:], "little-endian"),
        ("x.flo", b"JUNK" + flo[4:], "that starts with"),
        ("x.flo", FILES["depth.dpt"][0], "truncated"),  # half the bytes
        ("x.dpt", flo, "trailing"),
        ("depth.png", eight, "16-bit depth PNG"),
        ("kitti.png", eight, "3 channels"),
        (
            "x.npy",
            npy_bytes(np.array([{}], dtype=object), allow_pickle=True),
            "objects",
        ),
        ("x.npy", npy_bytes(np.zeros((2, 4, 5), np.float32)), "shape"),
        ("x.npy", npy_bytes(np.zeros((0, 5), np.float32)), "expected"),
    ]
    for name, content, message in cases:
        reader = io.read_flow if name in ("x.flo", "kitti.png") else io.read_depth
        with pytest.raises(FormatError, match=message):
            reader(written(tmp_path, name, content))


def test_arrays_of_other_types_are_converted(tmp_path):
    half = np.asfortranarray(np.arange(6, dtype=np.float16).reshape(2, 3))
    read = io.read_npy(written(tmp_path, "half.npy", npy_bytes(half)))
    assert read.dtype == np.float32 and read.tolist() == [[0, 1, 2], [3, 4, 5]]
    big = np.arange(6, dtype=">f8").reshape(2, 3)
    assert (
        io.read_npy(written(tmp_path, "big.npy", npy_bytes(big))).tolist()
        == big.tolist()
    )
    units = np.arange(6, dtype=np.uint16).reshape(2, 3)
    assert (
        io.read_depth(written(tmp_path, "units.npy", npy_bytes(units))).dtype
        == np.uint16
    )


def test_sizes_names_and_what_is_no_file(tmp_path):
    folder = tmp_path / "with space \N{CAMERA}"
    folder.mkdir()
    for name, (content, reader) in FILES.items():
        reader(written(folder, name, content))
    # a name that is not UTF-8
    path = written(folder, "\udcff.png", FILES["image.png"][0])
    assert io.read_rgb(path).shape == (20, 24, 3)
    with pytest.raises(FileNotFoundError):
        io.read_flow(folder / "none.flo")
    for odd in (folder, folder / ("x" * 300), "a\0b"):
        with pytest.raises(FormatError, match="cannot be read"):
            io.read_flow(odd)


def test_rgb_order_grey_and_mask(tmp_path):
    bgr = np.zeros((2, 2, 3), np.uint8)
    bgr[0, 0] = (1, 2, 3)
    rgb = io.read_rgb(written(tmp_path, "a.png", encoded(".png", bgr)))
    assert rgb[0, 0].tolist() == [3, 2, 1]
    grey = written(tmp_path, "g.png", encoded(".png", bgr[..., 1]))
    assert io.read_rgb(grey)[0, 0].tolist() == [2, 2, 2]
    assert io.read_mask_png(grey).tolist() == [[True, False], [False, False]]
