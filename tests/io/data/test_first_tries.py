"""What people hand in first: folders that are nearly right, and recordings of other kinds."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.lists import poses_at
from hybridvo.io.data.open import iter_pairs, open_sequence
from hybridvo.io.data.resize import resize_camera, resize_frame
from tests import bags
from tests import sequences as write
from tests.doors import refuses


@pytest.fixture
def mine(tmp_path):
    """A whole recording of one's own, without flow."""
    root = write.write_folder(tmp_path).path
    for path in (root / "flow").iterdir():
        path.unlink()
    (root / "flow").rmdir()
    return root


def refused(path, **options) -> str:
    with pytest.raises(InputError) as caught:
        open_sequence(path, **options)
    message = str(caught.value)
    assert "\n" not in message and message[-1] in ".?" and message.count(". ") <= 4
    return message


# folders that are nearly right


def renamed(folder, suffix):
    for path in folder.iterdir():
        path.rename(path.with_suffix(suffix))


def swapped(mine):
    (mine / "rgb").rename(mine / "x")
    (mine / "depth").rename(mine / "rgb")
    (mine / "x").rename(mine / "depth")


def of_eight_bits(mine):
    for path in (mine / "depth").iterdir():
        write.png(path, np.full((6, 10), 90, np.uint8))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda mine: (mine / "rgb").rename(mine / "pictures"),
            "pictures/ with images",
        ),
        (lambda mine: renamed(mine / "rgb", ".bmp"), "rgb/ holds 3 .bmp files"),
        (lambda mine: renamed(mine / "depth", ".exr"), "depth/ holds 3 .exr files"),
        (swapped, "Are the images and the depth maps swapped?"),
        (of_eight_bits, "8 bits are a picture of depth"),
    ],
)
def test_a_folder_that_is_nearly_right_says_what_is_wrong(change, words, mine):
    change(mine)
    assert words in refused(mine)


def test_a_part_of_a_sequence_and_a_file_of_it(mine):
    assert f"give the folder above it, {mine}" in refused(mine / "rgb")
    assert "of no kind in .bag" in refused(mine / "camera.yaml")


def test_lists_of_images_that_are_all_missing(tmp_path):
    root = write.write_tum(tmp_path).path
    for path in (root / "depth").iterdir():
        path.unlink()
    assert "none of 3 has depth" in refused(root)


def test_an_assumed_camera_is_kept_for_the_summary(tmp_path):
    assumed = open_sequence(write.write_tum(tmp_path, "desk").path)
    assert len(assumed.assumed) == 1 and "525.0" in assumed.assumed[0]
    assert assumed.assumed[0] in assumed.warnings
    assert open_sequence(assumed.root, camera="500,501,320,240").assumed == ()
    assert open_sequence(write.write_tum(tmp_path, "fr1_desk").path).assumed == ()


# stamps


@pytest.mark.parametrize(
    ("apart", "belongs"), [(0.019, True), (0.021, False), (0.15, False)]
)
def test_what_belongs_together_is_within_a_fiftieth_of_a_second(
    apart, belongs, tmp_path
):
    stamps = np.arange(3.0)
    warnings: list[str] = []
    poses = poses_at(
        stamps, stamps + apart, np.tile(np.eye(4), (3, 1, 1)), tmp_path, warnings
    )
    assert np.isfinite(poses).all() == belongs == (not warnings)
    root = write.write_tum(tmp_path).path
    for name, late in (("rgb", 0.0), ("depth", apart)):
        rows = [f"{100 + i + late:.6f} {name}/{i}.png\n" for i in range(write.N)]
        (root / f"{name}.txt").write_text("".join(rows))
    if belongs:
        assert len(open_sequence(root)) == write.N
    else:
        assert "within 0.02 s" in refused(root)


# cameras

MATRIX = [20.0, 0, 0, 0, 21.0, 0, 4.5, 2.5, 1]


def test_intrinsics_of_open3d_and_numpy(mine):
    intrinsic = {"height": 6, "width": 10, "intrinsic_matrix": MATRIX}
    path = mine.parent / "camera.json"
    for content in (intrinsic, {"extrinsic": [1.0] * 16, "intrinsic": intrinsic}):
        path.write_text(json.dumps(content))
        assert open_sequence(mine, camera=path).camera(0) == Camera(
            20, 21, 4.5, 2.5, height=6, width=10
        )
    by_rows = np.reshape(MATRIX, (3, 3)).T
    path.write_text(
        json.dumps(intrinsic | {"intrinsic_matrix": by_rows.ravel().tolist()})
    )
    assert "column by column" in refused(mine, camera=path)
    path = mine.parent / "K.npy"
    np.save(path, by_rows)
    assert open_sequence(mine, camera=path).camera(0) == Camera(
        20, 21, 4.5, 2.5, height=6, width=10
    )
    np.save(path, by_rows.T)
    assert "[fx, 0, cx]" in refused(mine, camera=path)


# recordings of other kinds


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["drive.bag", "notes.txt"], ("holds sequences: give one, such as",)),
        (["cam0/data.csv"], ("EuRoC", "cam1")),
        (["000000.npy"], ("numpy", "vo.track")),
        (["scene.svo2"], ("ZED", "depth/")),
    ],
)
def test_recordings_that_are_known_are_named_with_what_to_do(
    names, words, tmp_path
):
    for name in names:
        write.text(tmp_path / name, "x")
    for word in words:
        assert word in refused(tmp_path)
        if len(names) == 1 and "/" not in names[0]:
            assert word in refused(tmp_path / names[0])
            assert word in refused(tmp_path / names[0], dataset="folder")


# arguments

TINY = {
    "rgb": None,
    "depth": np.ones((4, 5)),
    "camera": Camera(9, 9, 2, 2, height=4, width=5),
}

test_arguments = refuses(
    [
        *((f"path {v!r}", lambda v=v: open_sequence(v), InputError, ("open_sequence", "path"))
          for v in (5, None, 1.5, b"x", ["x"])),
        *((f"mask {v!r}", lambda v=v: open_sequence(".", mask=v), InputError, ("mask",))
          for v in (5, ["x"], True)),
        *((f"camera {v!r}", lambda v=v: open_sequence(".", camera=v), InputError, ("camera",))
          for v in (5, ["x"], np.eye(3))),
        *((f"scale {v!r}", lambda v=v: open_sequence(".", depth_scale=v), InputError,
           ("depth_scale",)) for v in ("x", [1], np.nan, -1, 10**400)),
        *((f"dataset {v!r}", lambda v=v: open_sequence(".", v), InputError, ("dataset",))
          for v in (5, ["tum"], "x")),
        *((f"size {v!r}", lambda v=v: resize_camera(TINY["camera"], *v), InputError, ("Camera",))
          for v in ((0, 5), (1.5, 5), ("x", 5), (None, 5))),
        *((f"frame of {v!r}", lambda v=v: resize_frame(hvo.Frame(**TINY), *v), InputError,
           ("Camera",)) for v in ((0, 5), (1.5, 5), ("x", 5), (None, 5))),
        ("no camera", lambda: resize_camera(None, 4, 5), InputError, ("resize_camera",)),
        ("no frame", lambda: resize_frame(None, 4, 5), InputError, ("resize_frame",)),
        ("no sequence", lambda: iter_pairs(None), InputError, ("iter_pairs",)),
    ]
)  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        *(({"start": value}, "start") for value in (1.5, "0", None, True)),
        *(({"stop": value}, "stop") for value in (1.5, "2", [3])),
        *(({"stride": value}, "stride") for value in (1.5, "1", None, 0)),
        *(({"flow": value}, "flow") for value in (5, "dis", np.zeros((6, 10, 2)))),
    ],
)
def test_arguments_of_pairs(arguments, word, tmp_path):
    sequence = open_sequence(write.write_folder(tmp_path).path)
    with pytest.raises(InputError, match=f"iter_pairs.*{word}"):
        iter_pairs(sequence, **arguments)
    assert len(list(iter_pairs(sequence, start=np.int64(1), stop=np.int64(3)))) == 1
    with pytest.raises(InputError, match="one frame"):
        sequence[0:2]


def test_a_folder_beside_recordings_is_no_part_of_them(tmp_path):
    K = np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]])
    rgb = np.zeros((3, 12, 16, 3), np.uint8)
    np.savez(tmp_path / "walk.npz", rgb=rgb, depth=np.ones((3, 12, 16)), K=K)
    bags.plain_bag(tmp_path, "mcap")
    (tmp_path / "drive" / "drive.mcap").rename(tmp_path / "drive.mcap")
    captures = tmp_path / "captures"
    captures.mkdir()
    for names in ((), ("color_0.png", "depth_0.png")):
        for name in names:
            cv2.imwrite(str(captures / name), rgb[0])
        with pytest.raises(InputError) as caught:
            open_sequence(captures)
        assert "folder above" not in str(caught.value)
        assert "rgb/" in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((640, 480), ("Camera(height=640, width=480)?", "mirror")),
        ((240, 320), ("registered", "register_depth")),
    ],
)
def test_depth_of_another_size_names_what_helps(shape, words):
    camera = Camera(fx=500, fy=500, cx=319.5, cy=239.5, height=480, width=640)
    rgb = np.zeros((480, 640, 3), np.uint8)
    with pytest.raises(InputError) as caught:
        Frame(rgb, np.ones(shape, np.float32), camera)
    said = str(caught.value)
    assert all(word in said for word in words)
    assert "transpose it:" not in said and "Resize" not in said


def test_an_image_of_another_size_names_the_camera():
    camera = Camera(fx=500, fy=500, cx=319.5, cy=239.5, height=480, width=640)
    with pytest.raises(InputError, match=r"resize_camera"):
        Frame(np.zeros((240, 320, 3), np.uint8), None, camera)
