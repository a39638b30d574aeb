"""Image, flow, depth and camera files: exact bytes, exact values, and nothing but FormatError."""

from __future__ import annotations

import resource
import struct
import time
import warnings
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridvo.data import image_io as io
from hybridvo.errors import FormatError, InputError

TAG = b"PIEH"
RELAXED = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def flo_bytes(width: int = 3, height: int = 2) -> bytes:
    values = np.arange(2 * width * height, dtype="<f4") / 4
    return TAG + struct.pack("<ii", width, height) + values.tobytes()


def dpt_bytes() -> bytes:
    return TAG + struct.pack("<ii", 3, 2) + np.arange(6, dtype="<f4").tobytes()


def cam_bytes() -> bytes:
    K = np.array([[1120, 0, 511.5], [0, 1120, 217.5], [0, 0, 1.0]])
    Rt = np.hstack([np.eye(3), [[1.0], [2.0], [3.0]]])
    return TAG + K.astype("<f8").tobytes() + Rt.astype("<f8").tobytes()


def npy_bytes() -> bytes:
    import io as stdio

    buffer = stdio.BytesIO()
    np.save(buffer, np.arange(12, dtype=np.float32).reshape(2, 3, 2), allow_pickle=False)
    return buffer.getvalue()


def encoded(extension: str, array: np.ndarray) -> bytes:
    return cv2.imencode(extension, array)[1].tobytes()


GRID = np.arange(20 * 24).reshape(20, 24)
FILES = {
    "flo": (flo_bytes(), io.read_flo),
    "dpt": (dpt_bytes(), io.read_dpt),
    "cam": (cam_bytes(), io.read_cam),
    "npy": (npy_bytes(), lambda p: io.read_npy(p, channels=2)),
    "png": (encoded(".png", np.dstack([GRID % 251] * 3).astype(np.uint8)), io.read_rgb),
    "jpg": (encoded(".jpg", np.dstack([GRID % 251] * 3).astype(np.uint8)), io.read_rgb),
    "png16": (encoded(".png", (GRID * 100).astype(np.uint16)), io.read_png16),
    "kitti": (
        encoded(".png", np.dstack([GRID % 2, GRID, GRID]).astype(np.uint16)),
        io.read_flow_kitti_png,
    ),
    "rgba": (
        encoded(".png", np.ones((4, 5), "<f4").view(np.uint8).reshape(4, 5, 4)),
        io.read_depth_rgba_png,
    ),
}


def read(path: Path, data: bytes, reader):
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", io.HybridVOWarning)
        return reader(path)


def test_layouts_by_hand(tmp_path):
    flow = read(tmp_path / "a.flo", flo_bytes(), io.read_flo)
    assert flow.shape == (2, 3, 2) and flow.dtype == np.float32
    assert flow[1, 2].tolist() == [10 / 4, 11 / 4]
    depth = read(tmp_path / "a.dpt", dpt_bytes(), io.read_dpt)
    assert depth.tolist() == [[0, 1, 2], [3, 4, 5]]
    K, T = read(tmp_path / "a.cam", cam_bytes(), io.read_cam)
    assert (K[0, 0], K[0, 2], K[1, 2]) == (1120, 511.5, 217.5)
    assert T[:3, 3].tolist() == [1, 2, 3] and T[3].tolist() == [0, 0, 0, 1]
    # published sizes of Sintel's files at 1024x436
    assert 12 + 8 * 1024 * 436 == 3_571_724 and 4 + 21 * 8 == 172 == len(cam_bytes())


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (7, 3)])
def test_write_then_read(shape, tmp_path, rng):
    flow = rng.normal(size=(*shape, 2)).astype(np.float32)
    io.write_flo(tmp_path / "a.flo", flow)
    np.testing.assert_array_equal(io.read_flo(tmp_path / "a.flo", strict=True), flow)
    np.testing.assert_array_equal(cv2.readOpticalFlow(str(tmp_path / "a.flo")), flow)
    io.write_dpt(tmp_path / "a.dpt", flow[..., 0])
    np.testing.assert_array_equal(io.read_dpt(tmp_path / "a.dpt", strict=True), flow[..., 0])
    io.write_cam(tmp_path / "a.cam", np.diag([2.0, 3.0, 1.0]), np.eye(4))
    K, T = io.read_cam(tmp_path / "a.cam", strict=True)
    assert K.tolist() == np.diag([2.0, 3.0, 1.0]).tolist() and T.tolist() == np.eye(4).tolist()


def test_kitti_flow_layout(tmp_path):
    # R = u, G = v, B = valid: OpenCV writes B, G, R
    bgr = np.zeros((1, 2, 3), np.uint16)
    bgr[0, 0] = (1, 32768 + 64, 32768 - 32)
    flow, valid = read(tmp_path / "a.png", encoded(".png", bgr), io.read_flow_kitti_png)
    assert flow[0, 0].tolist() == [-0.5, 1.0] and np.isnan(flow[0, 1]).all()
    assert valid.tolist() == [[True, False]]
    io.write_flow_kitti_png(tmp_path / "b.png", flow)
    again, again_valid = io.read_flow_kitti_png(tmp_path / "b.png")
    np.testing.assert_array_equal(again, flow)
    np.testing.assert_array_equal(again_valid, valid)


@pytest.mark.parametrize("name", FILES)
@RELAXED
@given(data=st.data())
def test_cut_files_raise_format_error(name, tmp_path, data):
    content, reader = FILES[name]
    length = data.draw(st.integers(0, len(content) - 1))
    with pytest.raises(FormatError, match=name[:2]):
        read(tmp_path / f"{name}.bin", content[:length], reader)


@pytest.mark.parametrize("name", FILES)
@RELAXED
@given(data=st.data())
def test_flipped_bytes_raise_nothing_else(name, tmp_path, data):
    content, reader = FILES[name]
    broken = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        broken[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    for path_reader in (reader, io.image_size):
        try:
            read(tmp_path / "x.bin", bytes(broken), path_reader)
        except FormatError as error:
            assert "x.bin" in str(error)


@RELAXED
@given(content=st.binary(max_size=300), magic=st.sampled_from([b"", TAG, b"\x93NUMPY\x01\x00"]))
def test_arbitrary_bytes_raise_nothing_else(tmp_path, content, magic):
    for _, reader in FILES.values():
        try:
            read(tmp_path / "x.bin", magic + content, reader)
        except FormatError:
            pass


def test_every_flipped_png_byte_is_found(tmp_path):
    content, reader = FILES["png16"]
    for position in range(len(content)):
        broken = bytearray(content)
        broken[position] ^= 0x10
        with pytest.raises(FormatError):
            read(tmp_path / "x.png", bytes(broken), reader)


@pytest.mark.parametrize(
    ("width", "height"),
    [(0, 2), (2, 0), (-1, 5), (2_000_000_000, 1), (50_000, 50_000), (65_536, 65_536), (2**14,) * 2],
)
def test_absurd_headers_cost_nothing(width, height, tmp_path):
    heads = {
        "a.flo": TAG + struct.pack("<ii", width, height) + bytes(100),
        "a.npy": _npy_head(height, width) + bytes(100),
        "a.png": _png_head(width % 2**32, height % 2**32),
    }
    before = psutil.Process().memory_info().rss
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.perf_counter()
    for name, head in heads.items():
        (tmp_path / name).write_bytes(head)
        readers = {"a.flo": (io.read_flo, io.read_dpt), "a.npy": (io.read_npy,)}
        for reader in readers.get(name, (io.read_rgb, io.read_png16)):
            with pytest.raises(FormatError, match=name):
                reader(tmp_path / name)
    assert time.perf_counter() - began < 1.0  # the files are 100 bytes; a loaded machine
    assert psutil.Process().memory_info().rss - before < 50e6
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < 50e3  # kB


def _npy_head(height: int, width: int) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def _png_head(width: int, height: int) -> bytes:
    import zlib

    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    )


def test_wrong_magic_and_swaps(tmp_path):
    big_endian = TAG[::-1] + flo_bytes()[4:]
    with pytest.raises(FormatError, match="big-endian"):
        read(tmp_path / "a.flo", big_endian, io.read_flo)
    with pytest.raises(FormatError, match="expected the tag"):
        read(tmp_path / "a.flo", b"JUNK" + flo_bytes()[4:], io.read_flo)
    with pytest.raises(FormatError, match="truncated"):  # a .dpt has half the bytes of a .flo
        read(tmp_path / "a.flo", dpt_bytes(), io.read_flo)
    (tmp_path / "a.dpt").write_bytes(flo_bytes())
    with pytest.raises(FormatError, match="trailing"):
        io.read_dpt(tmp_path / "a.dpt", strict=True)


@pytest.mark.parametrize("name", ["flo", "dpt", "cam", "npy"])
def test_trailing_bytes_warn_or_raise(name, tmp_path):
    content, reader = FILES[name]
    path = tmp_path / f"a.{name}"
    path.write_bytes(content + b"x")
    with pytest.warns(io.HybridVOWarning, match="1 trailing bytes"):
        reader(path)
    strict = {"flo": io.read_flo, "dpt": io.read_dpt, "cam": io.read_cam}.get(name)
    with pytest.raises(FormatError, match="1 trailing bytes"):
        strict(path, strict=True) if strict else io.read_npy(path, channels=2, strict=True)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 0.99])
@pytest.mark.parametrize("name", ["png", "jpg"])
def test_truncated_images(name, share, tmp_path):
    content, reader = FILES[name]
    with pytest.raises(FormatError, match=r"truncated|expected a PNG"):
        read(tmp_path / f"a.{name}", content[: int(len(content) * share)], reader)


def test_wrong_dtypes(tmp_path):
    eight = encoded(".png", (GRID % 200).astype(np.uint8))
    with pytest.raises(FormatError, match="16-bit depth"):
        read(tmp_path / "a.png", eight, io.read_png16)
    with pytest.raises(FormatError, match="channels"):
        read(tmp_path / "a.png", eight, io.read_flow_kitti_png)
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="objects"):
        io.read_npy(tmp_path / "o.npy")
    np.save(tmp_path / "chw.npy", np.zeros((2, 4, 5), np.float32))
    with pytest.raises(FormatError, match="expected an array of shape"):
        io.read_npy(tmp_path / "chw.npy", channels=2)
    np.save(tmp_path / "half.npy", np.asfortranarray(np.arange(6, dtype=np.float16).reshape(2, 3)))
    half = io.read_npy(tmp_path / "half.npy")
    assert half.dtype == np.float32 and half.tolist() == [[0, 1, 2], [3, 4, 5]]
    np.save(tmp_path / "big.npy", np.arange(6, dtype=">f8").reshape(2, 3))
    assert io.read_npy(tmp_path / "big.npy").tolist() == [[0, 1, 2], [3, 4, 5]]
    for write, bad in ((io.write_flo, np.zeros((2, 3))), (io.write_dpt, np.zeros((2, 3, 2)))):
        with pytest.raises(InputError, match="shape"):
            write(tmp_path / "w", bad)


def test_image_sizes_and_names(tmp_path):
    folder = tmp_path / "with space \N{CAMERA}"
    folder.mkdir()
    for name, (content, _) in FILES.items():
        if name != "cam":
            path = folder / name
            path.write_bytes(content)
            expected = {"flo": (2, 3), "dpt": (2, 3), "npy": (2, 3), "rgba": (4, 5)}
            assert io.image_size(path) == expected.get(name, (20, 24))
    path = Path(bytes(folder / "x").decode() + "\udcff.png")  # a name that is not UTF-8
    path.write_bytes(FILES["png"][0])
    assert io.read_rgb(path).shape == (20, 24, 3)
    with pytest.raises(FileNotFoundError):
        io.read_flo(folder / "none.flo")
    with pytest.raises(FormatError, match="folder"):
        io.read_flo(folder)


def test_rgb_order_and_grey(tmp_path):
    bgr = np.zeros((2, 2, 3), np.uint8)
    bgr[0, 0] = (1, 2, 3)
    rgb = read(tmp_path / "a.png", encoded(".png", bgr), io.read_rgb)
    assert rgb[0, 0].tolist() == [3, 2, 1]
    grey = read(tmp_path / "g.png", encoded(".png", bgr[..., 1]), io.read_rgb)
    assert grey[0, 0].tolist() == [2, 2, 2]
