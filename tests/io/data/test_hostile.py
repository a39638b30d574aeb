"""Files that a stranger made to cost memory, time or secrets: refused before they can."""

from __future__ import annotations

import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import FormatError, InputError, OutputError, printable
from hybridvo.core.files import parse_yaml, read_bytes, read_rows, read_text
from hybridvo.core.options import load_options
from hybridvo.core.types import Camera
from hybridvo.io.data import image_io as io
from hybridvo.io.data.camera_file import read_camera_file
from hybridvo.io.data.open import open_sequence
from hybridvo.run.cli import main
from tests import sequences as write

# what can be printed


def test_messages_hold_nothing_that_a_terminal_obeys():
    name = "a\x1b]0;owned\x07\x9b2J\rb\u202e\udcff\N{CAMERA} ü"
    plain = "a\\x1b]0;owned\\x07\\x9b2J\\rb\\u202e\\udcff\N{CAMERA} ü"
    assert printable(name) == plain
    for kind in (InputError, FormatError, OutputError):
        assert str(kind(f"{name}: no.")) == f"{plain}: no."
    assert printable(plain) == plain  # a message may pass twice


def test_a_name_makes_no_line_of_its_own(tmp_path, caplog, capsys):
    forged = "a\nhybridvo: all is well\tb"
    plain = "a\\nhybridvo: all is well\\tb"
    assert printable(forged) == plain
    assert str(InputError(forged)) == plain
    path = write.WRITERS["folder"](tmp_path / "plain").path.rename(
        tmp_path / forged
    )
    sequence = open_sequence(path)
    sequence.rgb_files[1].unlink()
    told = [sequence.name, *open_sequence(path).warnings]
    assert plain in told[0] and len(told) > 1
    assert not any("\n" in text for text in told)
    assert main(["run", str(tmp_path / "no" / forged)]) == 2
    assert plain in capsys.readouterr().err
    assert main(["run", f"--{forged}"]) == 2
    assert "\nhybridvo: all is well" not in capsys.readouterr().err


def test_messages_are_cut():
    assert len(str(InputError("x" * 10**6))) < 2100


@pytest.mark.parametrize("kind", ["tum", "tartanair-v1", "folder"])
def test_odd_names_of_folders_are_read_and_told_in_plain_characters(kind, tmp_path):
    odd = tmp_path / "esc\x1b[2J\udcff\u202e"
    (write.WRITERS[kind](tmp_path / "plain").path).rename(odd)
    sequence = open_sequence(odd)
    assert sequence[1].rgb is not None and sequence[1].depth is not None
    assert sequence.name == "esc\\x1b[2J\\udcff\\u202e"
    sequence.depth_files[0].unlink()
    told = open_sequence(odd).warnings
    assert told and all(printable(text) == text for text in told)
    sequence.rgb_files[1].write_bytes(b"no image")
    with pytest.raises(FormatError) as caught:
        sequence[1]
    assert "\\x1b" in str(caught.value) and str(caught.value).isprintable()
    str(caught.value).encode("utf-8")


# YAML

LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    "key", ["fx", "width", "distortion", "depth_scale", "model", "<<"]
)
def test_aliases_in_a_camera_file_are_refused(key, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(LAUGHS + f"{key}: *a9\n")
    with pytest.raises(FormatError, match=r"camera\.yaml:2: .*aliases"):
        read_camera_file(path, [])


def test_aliases_in_options_are_refused(tmp_path):
    path = tmp_path / "options.yaml"
    path.write_text(LAUGHS + "run:\n  method: *a9\n")
    with pytest.raises(FormatError, match="aliases"):
        load_options(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("".join(f"k{i}: 1\n" for i in range(6000)), "more than 10000 keys"),
        ("x: '" + "y" * 2**20 + "'", "1048576 characters"),
        ("fx: 1" + ":59" * 20_000, "a number of 60001 characters"),
        ("fx: 1" + ":59" * 20_000 + ".5", "a number of 60003 characters"),
        ("fx: 0x" + "f" * 50_000, "a number of 50002 characters"),
        ("[" * 5000, "not a YAML file"),
    ],
)
def test_yaml_that_would_last_is_refused(text, reason):
    with pytest.raises(FormatError, match=reason):
        parse_yaml(text, "camera.yaml")


def test_yaml_of_use_is_read_as_before():
    text = "a: 1:30\nb: &anchor [1, 2.5]\nc: 0x1f\nd: 1e-3\ne: 2020-01-01\n"
    found = parse_yaml(text, "x")
    assert (found["a"], found["b"], found["c"], found["d"]) == (
        90,
        [1, 2.5],
        31,
        "1e-3",
    )


def test_a_value_of_any_length_makes_a_short_message():
    with pytest.raises(InputError) as caught:
        load_options(None, ["run.start=" + "x" * 10**5])
    assert len(str(caught.value)) < 2100


# lists


def test_lists_are_read_to_a_limit(tmp_path):
    path = tmp_path / "list.txt"
    path.write_text("\n" * (2**20 + 1))
    with pytest.raises(FormatError, match="at most 1048576 lines"):
        read_rows(path, "stamp")
    path.write_text("1 " * 100)
    with pytest.raises(FormatError, match=r"list\.txt:1: expected 'stamp'"):
        read_rows(path, "stamp")


# images and maps that promise more than they are


def png_of(width: int, height: int, rows: int = 4, bits: int = 8) -> bytes:
    """A grey PNG that declares a size and holds some rows of zeros, its checksums right."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content)
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", checksum)
        )

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    pixels = zlib.compress(bytes((1 + width * bits // 8) * rows), 9)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def jpeg_of(width: int, height: int) -> bytes:
    """A JPEG of 16x16 pixels whose header declares another size."""
    content = bytearray(
        cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    )
    at = content.index(b"\xff\xc0") + 5
    content[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(content)


@pytest.fixture
def decoder_is_not_asked(monkeypatch):
    def refuse(*_):
        pytest.fail("decoded before its header was looked at")

    monkeypatch.setattr(cv2, "imdecode", refuse)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.jpg", jpeg_of(32767, 32767), "the header declares 32767x32767"),
        ("a.jpg", jpeg_of(8000, 8000), "bytes cannot hold the 8000x8000 pixels"),
        ("a.jpg", jpeg_of(16, 0), "the header declares 16x0"),
        ("a.png", png_of(16384, 16384), "the header declares 16384x16384"),
        ("a.png", png_of(8000, 8000), "bytes cannot hold the 8000x8000 pixels"),
    ],
)
def test_a_header_is_looked_at_before_pixels_are_decoded(
    name, content, reason, tmp_path, decoder_is_not_asked
):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FormatError, match=reason):
        io.read_rgb(path)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1024, 2048), np.uint8),
        np.zeros((480, 640), np.uint16),
        np.zeros((300, 3000, 3), np.uint8),
        np.zeros((300, 300, 4), np.uint8),
    ],
)
def test_images_of_one_value_are_whole_though_they_are_small(image, tmp_path):
    """The smallest files that encoders write stay above what a byte can hold."""
    png = (".png", [cv2.IMWRITE_PNG_COMPRESSION, 9])
    best = [cv2.IMWRITE_JPEG_QUALITY, 1, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    jpeg = (".jpg", [*best, cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    for ending, options in (png, jpeg) if image.dtype == np.uint8 else (png,):
        path = tmp_path / f"a{ending}"
        colours = image[:, :, :3] if image.ndim == 3 and ending == ".jpg" else image
        path.write_bytes(cv2.imencode(ending, colours, options)[1].tobytes())
        assert io.read_rgb(path).shape[:2] == image.shape[:2] == io.image_size(path)


def test_the_file_of_a_matrix_holds_a_matrix_alone(tmp_path):
    path = tmp_path / "1.txt"
    path.write_text("1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1\n")
    np.testing.assert_array_equal(io.read_matrix(path), np.eye(4))
    path.write_text("1 " * 10_000)
    with pytest.raises(FormatError, match="at most 4096 bytes"):
        io.read_matrix(path)


@pytest.mark.parametrize("count", [2, 200])
def test_a_jpeg_of_many_scans(count, tmp_path):
    """Each scan is some bytes, and a walk of the decoder over all of the image."""
    image = np.full((48, 64, 3), 90, np.uint8)
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    whole = cv2.imencode(".jpg", image, progressive)[1].tobytes()
    last = whole[whole.rindex(b"\xff\xda") : -2]
    path = tmp_path / "a.jpg"
    path.write_bytes(whole[:-2] + count * last + whole[-2:])
    if count == 2:
        np.testing.assert_allclose(io.read_rgb(path), image, atol=3)
        return
    with pytest.raises(FormatError, match="at most 100 scans"):
        io.read_rgb(path)
    with pytest.raises(FormatError, match="at most 100 scans"):
        io.decode_bytes(path.read_bytes(), cv2.IMREAD_COLOR, "a topic")


def test_notes_before_the_size_of_a_jpeg(tmp_path):
    """Cameras write kilobytes of notes, fill bytes and thumbnails before the frame."""
    whole = cv2.imencode(".jpg", np.zeros((24, 40, 3), np.uint8))[1].tobytes()
    thumbnail = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    notes = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    path = tmp_path / "a.jpg"
    path.write_bytes(whole[:2] + notes + b"\xff" + whole[2:])
    assert io.image_size(path) == (24, 40)
    assert io.read_rgb(path).shape == (24, 40, 3)


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        *((kind, "rgb") for kind in ("folder", "kitti", "tartanair-v1", "sintel")),
        *(
            (kind, "depth")
            for kind in ("folder", "kitti", "tartanair-v1", "sintel")
        ),
        *((kind, "flow") for kind in ("folder", "tartanair-v1", "sintel")),
    ],
)
def test_files_of_another_size_than_the_camera_cost_nothing(
    kind, what, tmp_path, monkeypatch
):
    sequence = open_sequence(write.WRITERS[kind](tmp_path).path)
    path = getattr(sequence, f"{what}_files")[1]
    big = (900, 1100)
    if path.suffix == ".png":
        path.write_bytes(
            png_of(big[1], big[0], rows=900, bits=16 if what == "depth" else 8)
        )
    elif path.suffix == ".npy":
        write.npy(path, np.zeros((*big, 2) if what == "flow" else big, np.float32))
    else:
        write.tagged(path, np.zeros((*big, 2) if what == "flow" else big))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    if what == "depth":
        sequence.rgb_files[1].unlink()
    with pytest.raises(
        FormatError, match=rf"{path.name}.*as the camera has.*1100x900"
    ):
        sequence.flow(1) if what == "flow" else sequence[1]


@pytest.mark.parametrize(
    "ending", [".png", ".jpg", ".npy", ".flo", ".dpt", ".txt", ".yaml"]
)
def test_a_file_without_end_is_judged_before_it_is_read(
    ending, tmp_path, monkeypatch
):
    path = tmp_path / f"a{ending}"
    beginnings = {
        ".png": png_of(64, 48, rows=48),
        ".jpg": jpeg_of(16, 16),
        ".npy": b"\x93NUMPY\x02\0" + struct.pack("<I", 2**32 - 2),
        ".flo": b"PIEH" + struct.pack("<ii", 64, 48),
        ".dpt": b"PIEH" + struct.pack("<ii", 64, 48),
    }
    path.write_bytes(beginnings.get(ending, b"# stamps\n"))
    os.truncate(path, 3 * 2**30)  # sparse: takes no room
    readers = {".flo": io.read_flow, ".txt": read_text, ".yaml": read_text}
    reader = readers.get(
        ending, io.read_depth if ending in (".npy", ".dpt") else io.read_rgb
    )
    counts = []
    real = read_bytes.__globals__["read_head"]

    def counted(path, count):
        counts.append(count)
        return real(path, count)

    monkeypatch.setattr("hybridvo.core.files.read_head", counted)
    monkeypatch.setattr("hybridvo.io.data.image_io.read_head", counted)
    with pytest.raises(FormatError, match=path.name):
        reader(path)
    assert max(counts, default=0) <= 2**20


# pipes and devices


@pytest.mark.parametrize(
    "name", ["a.png", "a.jpg", "a.npy", "a.flo", "a.dpt", "a.cam", "a.yaml"]
)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_not_opened(name, kind, tmp_path):
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    readers = {
        ".flo": io.read_flow,
        ".npy": io.read_npy,
        ".dpt": io.read_depth,
        ".cam": io.read_cam,
        ".yaml": lambda path: read_camera_file(path, []),
    }
    with pytest.raises(FormatError, match="a pipe or a device"):
        readers.get(path.suffix, io.read_rgb)(path)


def test_a_pipe_in_a_sequence_costs_its_frame(tmp_path):
    root = write.write_folder(tmp_path).path
    (root / "rgb" / "f9.png").unlink()
    os.mkfifo(root / "rgb" / "f9.png")
    sequence = open_sequence(root)
    assert sequence[0].rgb is not None
    with pytest.raises(FormatError, match=r"f9\.png.*a pipe or a device"):
        sequence[1]
    (root / "camera.yaml").unlink()
    os.mkfifo(root / "camera.yaml")
    with pytest.raises(FormatError, match=r"camera\.yaml.*a pipe or a device"):
        open_sequence(root)


# lists that name files elsewhere


@pytest.fixture
def tum(tmp_path):
    """A sequence in TUM's layout beside a secret image."""
    root = write.write_tum(tmp_path / "data").path
    for name, depth in (("colour", np.uint8), ("depth", np.uint16)):
        write.png(
            tmp_path / "secret" / f"{name}.png", np.full((480, 640), 7, depth)
        )
    return root


def renamed(root, listed_in: str, old: str, new: str) -> None:
    path = root / listed_in
    path.write_text(path.read_text().replace(old, new))


def as_associations(root) -> None:
    """The same sequence by ICL-NUIM's list."""
    rows = [f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(write.N)]
    (root / "associations.txt").write_text("".join(rows))
    (root / "rgb.txt").unlink()


@pytest.mark.parametrize(
    ("listed_in", "name", "secret"),
    [
        ("rgb.txt", "rgb/0.png", "colour"),
        ("depth.txt", "depth/0.png", "depth"),
        ("associations.txt", "rgb/0.png", "colour"),
        ("associations.txt", "depth/0.png", "depth"),
    ],
)
@pytest.mark.parametrize("way", ["absolute", "up", "through", "link", "etc"])
def test_a_list_cannot_name_files_outside(
    listed_in, name, secret, way, tum, tmp_path
):
    outside = tmp_path / "secret" / f"{secret}.png"
    if listed_in == "associations.txt":
        as_associations(tum)
    if way == "link":
        (tum / name).unlink()
        (tum / name).symlink_to(outside)
    names = {
        "absolute": str(outside),
        "up": f"../../../secret/{secret}.png",
        "through": f"rgb/../../../../secret/{secret}.png",
        "etc": "/etc/passwd",
    }
    renamed(tum, listed_in, name, names.get(way, name))
    with pytest.raises(
        FormatError, match=rf"{listed_in}: expected a file below the sequence"
    ):
        open_sequence(tum)


@pytest.mark.parametrize("name", ["", ".", "rgb/a\0b.png", "rgb/ring/x.png"])
def test_a_list_cannot_name_what_is_no_file(name, tum):
    (tum / "rgb" / "ring").symlink_to("ring")
    renamed(tum, "rgb.txt", "rgb/0.png", name)
    with pytest.raises(FormatError, match=r"rgb\.txt"):
        open_sequence(tum)


def test_whole_folders_may_be_links(tum, tmp_path):
    """Data sets are linked as a whole, or by their folders of images."""
    link = tmp_path / "link"
    link.symlink_to(tum)
    assert len(open_sequence(link)) == write.N
    (tum / "rgb").rename(tmp_path / "images")
    (tum / "rgb").symlink_to(tmp_path / "images")
    sequence = open_sequence(link)
    assert sequence[0].rgb is not None
    assert not any("links to outside" in told for told in sequence.warnings)
    # an absolute name that leads inside is none that leads outside
    renamed(tum, "depth.txt", "depth/0.png", str(tum / "depth" / "0.png"))
    assert open_sequence(tum)[0].depth is not None


def test_files_of_a_folder_that_are_links_are_told(tmp_path):
    root = write.write_folder(tmp_path / "data").path
    (root / "rgb" / "f8.png").rename(tmp_path / "elsewhere.png")
    (root / "rgb" / "f8.png").symlink_to(tmp_path / "elsewhere.png")
    (root / "rgb" / "f9.png").rename(root / "inside.png")
    (root / "rgb" / "f9.png").symlink_to(root / "inside.png")
    (root / "rgb" / "f10.png").unlink()
    (root / "rgb" / "f10.png").symlink_to("f10.png")  # a ring
    sequence = open_sequence(root)
    assert sequence[0].rgb is not None and sequence[2].rgb is None
    told = [text for text in sequence.warnings if "links" in text]
    assert len(told) == 1 and "1 files" in told[0] and "elsewhere.png" in told[0]


# numbers in names


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("kitti", "image_2/{:06d}.png"),
        ("kitti", "depth/{:06d}.png"),
        ("tartanair-v1", "image_left/{:06d}_left.png"),
        ("sintel", "frame_{:04d}.png"),
        ("7scenes", "frame-{:06d}.color.png"),
    ],
)
def test_a_huge_number_in_a_name_costs_nothing(kind, pattern, tmp_path):
    root = write.WRITERS[kind](tmp_path).path
    first = 1 if kind == "sintel" else 0
    content = (root / pattern.format(first)).read_bytes()
    (root / pattern.format(9_999_999_999)).write_bytes(content)
    if kind == "kitti":
        (root / "times.txt").unlink()
        other = {"image_2": "depth", "depth": "image_2"}[
            pattern[: pattern.index("/")]
        ]
        copied = (root / other / "000000.png").read_bytes()
        (root / other / "9999999999.png").write_bytes(copied)
    sequence = open_sequence(root)
    assert len(sequence) == write.N + 1
    told = "\n".join(sequence.warnings)
    missing = range(first + write.N, first + write.N + 8)
    assert f"frame numbers {', '.join(map(str, missing))}, ... are missing" in told
    (root / pattern.format(10**30)).write_bytes(content)
    with pytest.raises(InputError, match="a frame number of at most"):
        open_sequence(root)


@pytest.mark.parametrize("size", ["-8", "x", "0", "9" * 400])
def test_a_size_that_is_text_is_one_line(size: str) -> None:
    with pytest.raises(InputError, match="height: expected a positive integer"):
        Camera(40, 40, 15.5, 11.5, height=size, width=32)
