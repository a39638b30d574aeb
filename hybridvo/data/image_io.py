"""Readers and writers of image, depth, flow and camera files; damaged ones are a FormatError."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.checks import as_rigid
from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write, file_size, read_bytes, read_head
from hybridvo.geometry import pose_matrix
from hybridvo.trajectory import FILE_TOLERANCE

TAG_BYTES = struct.pack("<f", 202021.25)  # how .flo, .dpt and .cam files begin
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8"
UNKNOWN_FLOW = 1e9  # px, Middlebury's mark: longer flow is unknown

# What an image may cost before it is known to be one of the sequence.
LARGEST_IMAGE = 2**26  # pixels: 8192x8192, 200 MB of colour
# bytes in which a file must state its size; a camera's notes stand before it
HEAD = 2**20
PIXELS_OF_JPEG_BYTE = 512  # at most: a block of 8x8 pixels takes a bit or more
BITS_OF_PNG_BYTE = 8 * 1032  # at most: the limit of deflate

Size = tuple[int, int] | None
"""Height and width that a file must have, in pixels; None where they are not known."""


class ImageHeader(NamedTuple):
    """What a PNG or JPEG says of itself before its pixels."""

    height: int  # px
    width: int  # px
    bits: int  # of a value
    channels: int
    pixels_of_byte: float  # that a byte of the file can stand for, at most


def image_size(path: str | Path) -> tuple[int, int]:
    """Return height and width of an image or a map, px, from the header of its file."""
    suffix = Path(path).suffix.lower()
    if suffix in (".dpt", ".flo"):
        height, width = _tagged_size(path)
    elif suffix == ".npy":
        height, width = (*_npy_header(path).shape, 0, 0)[:2]
    else:
        height, width = read_header(path)[:2]
    _check_size(path, height, width, None)
    return height, width


def read_header(path: str | Path, size: Size = None) -> ImageHeader:
    """Return what a PNG or JPEG states; a FormatError if it has another size, or one of no use."""
    head = read_head(path, HEAD)
    if head.startswith(PNG_MAGIC) and len(head) >= 33:
        header = _png_header(head)
    elif head.startswith(JPEG_MAGIC):
        header = _jpeg_header(path, head)
    else:
        raise FormatError(
            f"{path}: expected a whole PNG or JPEG image, got {head[:8]!r}."
        )
    _check_size(path, header.height, header.width, size)
    if header.height * header.width > file_size(path) * header.pixels_of_byte:
        many = f"the {header.width}x{header.height} pixels that the header declares"
        raise FormatError(
            f"{path}: truncated: {file_size(path)} bytes cannot hold {many}."
        )
    return header


def read_rgb(path: str | Path, size: Size = None) -> np.ndarray:
    """Read a PNG or JPEG as (H, W, 3) uint8 RGB; grey is repeated, alpha is dropped."""
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR, size), cv2.COLOR_BGR2RGB)


def read_mask_png(path: str | Path, size: Size = None) -> np.ndarray:
    """Read a PNG or JPEG as a mask (H, W) bool, True where it is not zero."""
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE, size) > 0)


def read_png(
    path: str | Path, dtype: type, channels: int, what: str, size: Size = None
) -> np.ndarray:
    """Read a PNG of a given dtype and number of channels, which stay in OpenCV's order."""
    # IMREAD_UNCHANGED is -1: it leaves orientation alone and cannot be combined with other flags
    image = _decode(path, cv2.IMREAD_UNCHANGED, size)
    got = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != dtype or got != channels:
        expected = f"{what} ({np.dtype(dtype)}, {channels} channels)"
        raise FormatError(
            f"{path}: expected {expected}, got {image.dtype} with {got} channels."
        )
    return image


def read_depth(path: str | Path, size: Size = None) -> np.ndarray:
    """Read depth (H, W) as stored: float32 (``.dpt``, ``.npy``) or unsigned (PNG, ``.npy``)."""
    suffix = Path(path).suffix.lower()
    if suffix == ".dpt":
        return _read_map(path, 1, size)[:, :, 0]
    if suffix != ".npy":
        header = read_header(path, size)
        if header.bits <= 8:
            got = f"8 bits with {header.channels} channels"
            why = "8 bits are a picture of depth, not metres"
            remedy = "store what the sensor measured, or .npy in metres"
            text = f"expected a 16-bit depth PNG, got {got}: {why}; {remedy}"
            raise FormatError(f"{path}: {text}.")
        return read_png(path, np.uint16, 1, "a 16-bit depth PNG", size)
    depth = read_npy(path, size=size)
    if depth.dtype.kind not in "fu":
        raise FormatError(
            f"{path}: expected depth as floating point or unsigned integers."
        )
    return depth


def read_flow(
    path: str | Path, size: Size = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read flow (H, W, 2), px, and where it is valid, (H, W) or None: .flo, .npy, KITTI's PNG."""
    suffix = Path(path).suffix.lower()
    if suffix == ".flo":
        flow = _read_map(path, 2, size)
        with np.errstate(invalid="ignore"):
            known = (np.abs(flow) < UNKNOWN_FLOW).all(axis=2)
        return flow, None if known.all() else known
    if suffix == ".npy":
        return read_npy(path, channels=2, size=size).astype(
            np.float32, copy=False
        ), None
    flow, image = read_flow_png(path, (2, 1, 0), size)
    valid: np.ndarray = image > 0
    flow[~valid] = np.nan
    return flow, valid


def read_flow_png(
    path: str | Path, order: tuple[int, int, int], size: Size = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read flow (H, W, 2), px, and mask of a 16-bit PNG; ``order``: its channels of u, v, mask."""
    image = read_png(path, np.uint16, 3, "a 16-bit flow PNG", size)
    u, v, mask = np.moveaxis(image, 2, 0)[[*order]]
    return (np.dstack([u, v]).astype(np.float32) - np.float32(32768)) / np.float32(
        64
    ), mask


def read_cam(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the intrinsics K (3, 3) and T_cam_world (4, 4) of a Sintel ``.cam`` file."""
    values = _read_tagged(path, "<f8", start=4, count=21)
    if not np.isfinite(values[:9]).all():
        raise FormatError(
            f"{path}: expected finite intrinsics, got {values[:9].tolist()}."
        )
    return values[:9].reshape(3, 3), as_pose(values[9:].reshape(3, 4), str(path))


def as_pose(stored: np.ndarray, where: str) -> np.ndarray:
    """Check the pose (3, 4) of a file and return it as (4, 4) with an exact rotation."""
    try:
        return pose_matrix(
            as_rigid(np.vstack([stored, (0, 0, 0, 1)]), where, FILE_TOLERANCE)[:3]
        )
    except InputError as error:
        raise FormatError(str(error)) from None


def read_npy(
    path: str | Path, *, channels: int | None = None, size: Size = None
) -> np.ndarray:
    """Read (H, W) or (H, W, channels) from a ``.npy`` file, floats as float32; never unpickles."""
    header = _npy_header(path)
    last = () if channels is None else (channels,)
    is_number = header.dtype.kind in "fiub"
    if (
        not is_number
        or len(header.shape) != 2 + len(last)
        or header.shape[2:] != last
    ):
        wanted = f"an array of numbers of shape (H, W{', 2' * bool(channels)})"
        got = (
            "Python objects"
            if header.dtype.hasobject
            else f"{header.dtype} {header.shape}"
        )
        raise FormatError(f"{path}: expected {wanted}, got {got}.")
    height, width = header.shape[:2]
    _check_size(path, height, width, size)
    values = height * width * (channels or 1)
    _check_length(path, header.offset + values * header.dtype.itemsize)
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    target = (
        np.dtype(np.float32)
        if header.dtype.kind == "f"
        else header.dtype.newbyteorder("=")
    )
    # float64 beyond float32 becomes inf
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=target, order="C", subok=False)


def write_flo(path: str | Path, flow: np.ndarray) -> None:
    """Write flow (H, W, 2), px, as ``.flo``, or depth (H, W), m, as ``.dpt``: they look alike."""
    size = struct.pack("<ii", flow.shape[1], flow.shape[0])
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + size + flow.astype("<f4").tobytes())


write_dpt = write_flo


def write_cam(path: str | Path, K: np.ndarray, T_cam_world: np.ndarray) -> None:
    """Write intrinsics K (3, 3) and T_cam_world (4, 4) as a Sintel ``.cam`` file."""
    with atomic_write(path, "wb") as file:
        file.write(TAG_BYTES + np.asarray(K, "<f8").tobytes())
        file.write(np.asarray(T_cam_world, "<f8")[:3].tobytes())


def _check_size(path: object, height: int, width: int, size: Size) -> None:
    """Refuse what a header declares if the sequence has another size, or no image is as large."""
    declares = f"the header declares {width}x{height}"
    if height <= 0 or width <= 0 or height * width > LARGEST_IMAGE:
        expected = f"expected an image of 1 to {LARGEST_IMAGE} pixels"
        raise FormatError(f"{path}: {expected}, {declares}.")
    if size is not None and (height, width) != size:
        expected = f"expected {size[1]}x{size[0]} pixels, as the camera has"
        raise FormatError(f"{path}: {expected}; {declares}.")


def _check_length(path: str | Path, expected: int) -> None:
    """Refuse a file that does not have as many bytes as its header says."""
    got = file_size(path)
    if got != expected:
        problem = "truncated" if got < expected else "trailing bytes"
        raise FormatError(
            f"{path}: {problem}: expected {expected} bytes, got {got}."
        )


class _NpyHeader(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int  # bytes before the values


def _npy_header(path: str | Path) -> _NpyHeader:
    head = io.BytesIO(read_head(path, 2**16))
    try:
        version = np.lib.format.read_magic(head)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(head)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(head)
    # numpy raises errors of many kinds for a damaged header
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise FormatError(
            f"{path}: expected a whole .npy file of one array ({reason})."
        ) from None
    return _NpyHeader(shape, dtype, head.tell())


def _tagged_size(path: str | Path) -> tuple[int, int]:
    """Height and width that a .flo or .dpt states, px."""
    head = read_head(path, 12)
    if not head.startswith(TAG_BYTES):
        expected = f"a little-endian file that starts with {TAG_BYTES!r}"
        raise FormatError(f"{path}: expected {expected}, got {head[:4]!r}.")
    width, height = struct.unpack("<ii", head[4:].ljust(8, b"\0"))
    return height, width


def _read_map(path: str | Path, channels: int, size: Size) -> np.ndarray:
    """The values of a .flo or .dpt, (H, W, channels) float32."""
    height, width = _tagged_size(path)
    _check_size(path, height, width, size)
    values = _read_tagged(path, "<f4", start=12, count=height * width * channels)
    return values.reshape(height, width, channels)


def _read_tagged(
    path: str | Path, dtype: str, start: int, count: int
) -> np.ndarray:
    """A number of values from a place on, which must be all of the file."""
    _tagged_size(path)  # looks at the tag
    length = start + count * np.dtype(dtype).itemsize
    _check_length(path, length)
    data = read_bytes(path, length)
    return np.frombuffer(data, dtype, count, start).astype(dtype[1:])


def _png_header(head: bytes) -> ImageHeader:
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    stored = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 1)  # values a pixel
    channels = 3 if colour == 3 else stored  # a palette stands for colours
    return ImageHeader(
        height, width, bits, channels, BITS_OF_PNG_BYTE / max(bits * stored, 1)
    )


def _jpeg_header(path: str | Path, head: bytes) -> ImageHeader:
    """Walk the segments to the one that starts the frame, as a decoder does."""
    at = 2
    while (at := head.find(b"\xff", at)) >= 0 and len(head) >= at + 10:
        marker = head[at + 1]
        starts_frame = 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)
        if starts_frame:
            bits, height, width, channels = struct.unpack(
                ">BHHB", head[at + 4 : at + 10]
            )
            return ImageHeader(height, width, bits, channels, PIXELS_OF_JPEG_BYTE)
        if marker in (0xD9, 0xDA):  # the end, or pixels without a size
            break
        # fill, and what has no content
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:
            at += 1 if marker == 0xFF else 2
        else:
            at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    raise FormatError(
        f"{path}: truncated or damaged: the JPEG does not state its size."
    )


def _decode(path: str | Path, flags: int, size: Size) -> np.ndarray:
    """Decoded PNG or JPEG in OpenCV's channel order, after a look at its two ends."""
    header = read_header(path, size)
    # four values of 16 bits, stored as they are, and notes
    data = read_bytes(path, header.height * header.width * 8 + HEAD)
    return _decode_whole(path, data, flags)


def decode_bytes(
    data: bytes, flags: int, where: str, size: Size = None
) -> np.ndarray:
    """Decode the bytes of a PNG or JPEG in OpenCV's channel order; ``where`` is for messages."""
    if data.startswith(PNG_MAGIC) and len(data) >= 33:
        header = _png_header(data[:HEAD])
    elif data.startswith(JPEG_MAGIC):
        header = _jpeg_header(where, data[:HEAD])
    else:
        raise FormatError(
            f"{where}: expected a whole PNG or JPEG image, got {data[:8]!r}."
        )
    _check_size(where, header.height, header.width, size)
    if header.height * header.width > len(data) * header.pixels_of_byte:
        many = f"{header.width}x{header.height} pixels that the header declares"
        raise FormatError(f"{where}: truncated: {len(data)} bytes for the {many}.")
    return _decode_whole(where, data, flags)


def _decode_whole(path: str | Path, data: bytes, flags: int) -> np.ndarray:
    """Decoded PNG or JPEG, after a look at its end."""
    # OpenCV fills what is missing of a JPEG with grey: look for the closing marker after the pixels
    is_png = data.startswith(PNG_MAGIC)
    pixels, closing = (b"IDAT", b"IEND") if is_png else (b"\xff\xda", b"\xff\xd9")
    if data.rfind(closing) <= data.rfind(pixels):
        raise FormatError(f"{path}: truncated: {len(data)} bytes end too early.")
    # orientation is ignored: the intrinsics belong to the pixels as they are stored
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        image = None
    if image is None:
        raise FormatError(f"{path}: damaged: the image cannot be decoded.")
    return image
