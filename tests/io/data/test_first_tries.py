"""What people hand in first: folders that are nearly right, and recordings of other kinds."""

from __future__ import annotations

import json

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.types import Camera
from hybridvo.io.data.lists import poses_at
from hybridvo.io.data.open import iter_pairs, open_sequence
from hybridvo.io.data.resize import resize_camera, resize_frame
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


def test_images_in_a_folder_of_another_name(mine):
    (mine / "rgb").rename(mine / "color")
    assert open_sequence(mine)[0].rgb is not None
    (mine / "camera.yaml").unlink()
    assert "without camera_intrinsic.json" in refused(mine)
    (mine / "color").rename(mine / "pictures")
    assert "there is pictures/ with images" in refused(mine)


def test_images_of_another_kind(mine):
    for path in (mine / "rgb").iterdir():
        path.rename(path.with_suffix(".bmp"))
    assert "no PNG or JPEG in rgb/; rgb/ holds 3 .bmp files" in refused(mine)


def test_images_in_the_folder_itself(mine):
    for path in (mine / "rgb").iterdir():
        path.rename(mine / path.name)
    assert "rgb/ is empty; mine/ itself holds images" in refused(mine)


def test_a_part_of_a_sequence(mine):
    message = refused(mine / "rgb")
    assert message.endswith(f"give the folder above it, {mine}.")


def test_what_a_run_has_written(tmp_path):
    for name in ("run.json", "steps.csv", "steps.npz", "trajectory.tum"):
        (tmp_path / name).write_text("")
    assert "what 'hybridvo run' has written" in refused(tmp_path)


def test_a_file_that_is_no_recording(mine):
    message = refused(mine / "camera.yaml")
    assert "got a file, of no kind in .bag" in message


def test_a_video_beside_depth(mine):
    (mine / "rgb").rename(mine.parent / "frames")
    (mine / "color.mp4").write_bytes(b"video")
    assert "color.mp4: no frames: OpenCV cannot decode" in refused(mine)


def test_images_are_not_needed_where_there_is_flow(tmp_path):
    root = write.write_folder(tmp_path).path
    (root / "rgb").rename(root / "pictures")
    sequence = open_sequence(root)
    assert sequence[0].rgb is None and sequence.has_flow
    assert "there is pictures/ with images. Flow and depth alone" in "\n".join(
        sequence.warnings
    )


def test_lists_of_images_that_are_all_missing(tmp_path):
    root = write.write_tum(tmp_path).path
    for path in (root / "rgb").iterdir():
        path.rename(path.with_suffix(".jpg"))
    assert "none of 3 has image" in refused(root) and "rgb/0.png" in refused(root)
    for path in (root / "rgb").iterdir():
        path.rename(path.with_suffix(".png"))
    for path in (root / "depth").iterdir():
        path.unlink()
    assert "none of 3 has depth" in refused(root)


def test_depth_of_another_kind(mine):
    for path in (mine / "depth").iterdir():
        path.rename(path.with_suffix(".exr"))
    assert "depth/ holds 3 .exr files" in refused(mine)


def test_swapped_folders(mine):
    (mine / "rgb").rename(mine / "x")
    (mine / "depth").rename(mine / "rgb")
    (mine / "x").rename(mine / "depth")
    assert "got 8 bits with 3 channels" in refused(mine)
    assert "Are the images and the depth maps swapped?" in refused(mine)


def test_depth_of_eight_bits(mine):
    for path in (mine / "depth").iterdir():
        write.png(path, np.full((6, 10), 90, np.uint8))
    message = refused(mine)
    assert "8 bits are a picture of depth, not metres" in message
    assert "swapped" not in message


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


def test_poses_of_another_clock(mine):
    (mine / "timestamps.txt").write_text("10.0\n10.5\n11.0\n")
    poses = mine / "poses.txt"
    poses.write_text("".join(write.tum_row(5011.0 + i, i) for i in range(3)))
    sequence = open_sequence(mine)
    assert np.isnan(sequence.poses).all()
    told = [text for text in sequence.warnings if "overlap" in text]
    assert len(told) == 1 and "poses.txt: no pose belongs to a frame" in told[0]
    assert "5000 s apart" in told[0] and "from 10 to 11 s" in told[0]
    poses.write_text("".join(write.tum_row(9.7 + 0.5 * i, i) for i in range(4)))
    told = "\n".join(open_sequence(mine).warnings)
    assert "the nearest is 0.2 s away, 0.02 s are allowed" in told


# cameras

MATRIX = [20.0, 0, 0, 0, 21.0, 0, 4.5, 2.5, 1]


def test_intrinsics_of_open3d_and_numpy(mine):
    intrinsic = {"height": 6, "width": 10, "intrinsic_matrix": MATRIX}
    path = mine.parent / "camera.json"
    for content in (intrinsic, {"extrinsic": [1.0] * 16, "intrinsic": intrinsic}):
        path.write_text(json.dumps(content))
        assert open_sequence(mine, camera=path).camera(0) == Camera(
            20, 21, 4.5, 2.5, 6, 10
        )
    by_rows = np.reshape(MATRIX, (3, 3)).T
    path.write_text(
        json.dumps(intrinsic | {"intrinsic_matrix": by_rows.ravel().tolist()})
    )
    assert "column by column" in refused(mine, camera=path)
    path = mine.parent / "K.npy"
    np.save(path, by_rows)
    assert open_sequence(mine, camera=path).camera(0) == Camera(
        20, 21, 4.5, 2.5, 6, 10
    )
    np.save(path, by_rows.T)
    assert "[fx, 0, cx]" in refused(mine, camera=path)


# recordings of other kinds


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["drive.bag", "notes.txt"], ("ROS 1 bag", "hybridvo run")),
        (["color.mp4", "notes.txt"], ("video", "depth/")),
        (["mav0/cam0/data.csv"], ("EuRoC", "cam1")),
        (["cam0/data.csv"], ("EuRoC", "cam1")),
        (["000000.npz", "000001.npz"], ("numpy", "vo.track")),
        (["000000.npy"], ("numpy", "vo.track")),
        (["scan.r3d", "notes.txt"], ("Record3D", "hybridvo run")),
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

TINY = {"rgb": None, "depth": np.ones((4, 5)), "camera": Camera(9, 9, 2, 2, 4, 5)}

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


def test_a_damaged_map_is_a_format_error_at_opening(mine):
    for path in (mine / "depth").iterdir():
        np.save(path.with_suffix(".npy"), np.zeros(5, np.float32))
        path.unlink()
    with pytest.raises(FormatError, match=r"f8\.npy: expected an image"):
        open_sequence(mine)
