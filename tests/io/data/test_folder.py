"""A user's own folder: what belongs together, stamps, units, masks and camera files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.core.depth_units import depth_unit_fix, typical_depth
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.trajectory import stamp_unit
from hybridvo.core.types import Camera
from hybridvo.io.data.camera_file import read_camera_file, write_camera_template
from hybridvo.io.data.image_io import write_flo
from hybridvo.io.data.lists import associate, to_seconds
from hybridvo.io.data.open import open_sequence
from tests import sequences as write

CAMERA = (
    "fx: 20\nfy: 20\ncx: 15.5\ncy: 11.5\nwidth: 32\nheight: 24\ndepth_scale: 1000\n"
)
SIZE = (24, 32)


def own(
    root: Path, images: list, depths: list | None = None, units: int = 2000
) -> Path:
    """A sequence of kind 'folder' with files of these names, depth 2 m."""
    write.text(root / "camera.yaml", CAMERA)
    for name in images:
        write.png(root / "rgb" / f"{name}.png", write.image(0, *SIZE))
    for name in images if depths is None else depths:
        write.png(root / "depth" / f"{name}.png", np.full(SIZE, units, np.uint16))
    return root


def told(path: Path, **options) -> str:
    return "\n".join(open_sequence(path, **options).warnings)


# what belongs together


@pytest.mark.parametrize(
    ("images", "depths", "found"),
    [
        # equal names; what has no partner is told
        (["0", "1", "2"], ["1", "2", "7"], [None, "1", "2"]),
        # else stamps within 20 ms; colour without depth is left out
        (
            ["5.000", "5.100", "5.200"],
            ["5.104", "5.190", "5.300"],
            ["5.104", "5.190"],
        ),
        # else order
        (["a", "b"], ["x", "y"], ["x", "y"]),
    ],
)
def test_colour_and_depth_that_belong_together(images, depths, found, tmp_path):
    root = own(tmp_path, images, depths)
    sequence = open_sequence(root)
    assert [None if p is None else p.stem for p in sequence.depth_files] == found
    assert len(sequence) == len(found)
    warnings = "\n".join(sequence.warnings)
    if images[0] == "0":
        assert "1 frames without depth: 0" in warnings
        assert sequence[0].depth is None and sequence[1].depth is not None
        np.testing.assert_allclose(sequence.timestamps, np.arange(3) / 30)
    if images[0] == "5.000":
        assert "1 of 3 colour images have no depth" in warnings
        np.testing.assert_allclose(sequence.timestamps, [5.1, 5.2])


def test_lists_of_stamps_say_what_belongs_together(tmp_path):
    root = own(tmp_path, ["a", "b", "c"], ["x", "y"])
    write.text(root / "timestamps.txt", "5.0\n5.1\n5.2\n")
    write.text(root / "depth_timestamps.txt", "5.01\n5.21\n")
    sequence = open_sequence(root)
    assert [path.stem for path in sequence.depth_files] == ["x", "y"]
    np.testing.assert_allclose(sequence.timestamps, [5.0, 5.2])
    write.text(root / "depth_timestamps.txt", "7\n8\n")
    with pytest.raises(InputError, match="same clock"):
        open_sequence(root)


def test_stamps_of_another_count_are_refused(tmp_path):
    root = own(tmp_path, ["c1", "c2", "c3"], ["d1", "d2"])
    (root / "timestamps.txt").write_text("1\n2\n")
    expected = r"timestamps\.txt: 2 stamps for 3 files: expected a line for each"
    with pytest.raises(InputError, match=expected):
        open_sequence(root)


def test_images_without_depth_say_that_depth_is_needed(tmp_path):
    write.png(tmp_path / "a" / "0.png", write.image(0, *SIZE))
    write.png(tmp_path / "b" / "rgb" / "0.png", write.image(0, *SIZE))
    for name in "ab":
        with pytest.raises(InputError, match="needs metric depth"):
            open_sequence(tmp_path / name)
    with pytest.raises(InputError, match="of metric depth"):
        open_sequence(own(tmp_path / "c", ["0"], []))


def test_depth_of_another_size_must_be_registered(tmp_path):
    root = own(tmp_path, ["0", "1"])
    for path in (root / "depth").iterdir():
        write.png(path, np.full((30, 40), 2000, np.uint16))
    with pytest.raises(InputError, match=r"40x30.*32x24.*registered to colour"):
        open_sequence(root)


def test_masks(tmp_path):
    root = own(tmp_path / "data", ["0", "1"])
    mask = np.zeros(SIZE, np.uint8)
    mask[3:] = 255
    for folder in (root / "mask", tmp_path / "masks"):
        write.png(folder / "1.png", mask)
    for sequence in (
        open_sequence(root),
        open_sequence(root, mask=tmp_path / "masks"),
    ):
        assert sequence[0].mask is None
        np.testing.assert_array_equal(sequence[1].mask, mask > 0)
        assert any(
            "1 frames without mask: 0" in warning for warning in sequence.warnings
        )
        assert any(path.parent.name.startswith("mask") for path in sequence.files())
    (root / "camera.yaml").write_text(CAMERA + "distortion: [-0.01, 0, 0, 0, 0]\n")
    assert (
        not open_sequence(root)[1].mask[:2].any()
        and open_sequence(root)[1].mask[4:].any()
    )
    with pytest.raises(InputError, match="0 files for 2 frames"):
        open_sequence(root, mask=tmp_path / "nowhere")


# stamps


@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=25, unique=True),
    st.lists(st.integers(0, 400), min_size=1, max_size=25, unique=True),
)
def test_association_is_greedy_one_to_one(a, b):
    first, second = np.array(a) / 1000, np.array(b) / 1000 + 0.00031
    # the definition, in its slow form
    table = sorted(
        (abs(x - y), i, j)
        for i, x in enumerate(first)
        for j, y in enumerate(second)
        if abs(x - y) < 0.02
    )
    used_a, used_b, expected = set(), set(), []
    for _, i, j in table:
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            expected.append((i, j))
    assert associate(first, second, 0.02) == sorted(expected)


EPOCH = 1_700_000_000.25


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")],
)
def test_stamps_of_todays_clocks_become_seconds(factor, unit, tmp_path):
    seconds = EPOCH + np.arange(4) / 30
    stamps = np.round(seconds * factor)
    assert stamp_unit(np.append(stamps, np.nan)) == (factor, unit)
    warnings: list[str] = []
    listed = to_seconds(stamps, "rgb.txt", warnings)
    assert unit in warnings[0] and "rgb.txt" in warnings[0]
    np.testing.assert_allclose(listed, seconds, rtol=0, atol=6e-4)
    sequence = open_sequence(own(tmp_path, [str(int(stamp)) for stamp in stamps]))
    np.testing.assert_array_equal(sequence.timestamps, listed)
    assert unit in "\n".join(sequence.warnings)


@pytest.mark.parametrize(
    "stamps",
    [[0.0, 0.1], [1.3e9], [1.3e9, 1.3e9 + 5], [0.0, 33.0, 66.0], [np.nan], []],
)
def test_a_unit_that_cannot_be_told_stays(stamps):
    assert stamp_unit(np.array(stamps, dtype=float)) == (1.0, "seconds")


def test_truth_without_a_partner_is_nan(tmp_path):
    root = own(tmp_path, ["1.0", "1.1", "1.2"])
    (root / "poses.txt").write_text(
        write.tum_row(1.001, 0) + write.tum_row(1.199, 2)
    )
    sequence = open_sequence(root)
    assert (
        np.isfinite(sequence.poses[[0, 2]]).all()
        and np.isnan(sequence.poses[1]).all()
    )
    np.testing.assert_allclose(sequence.poses[2], write.pose(2), atol=1e-12)
    assert "1 of 3 frames have no true pose" in "\n".join(sequence.warnings)


# depth units


@pytest.mark.parametrize(
    ("metres", "units", "usual", "advice"),
    [
        (0.974, 1000, None, "divide by 1000 (millimetres)"),
        (3.0, 5000, None, "divide by 5000 (TUM's unit)"),
        (12.0, 256, 256, "divide by 256 (KITTI's unit)"),
        (2.0, 5000, 5000, "divide by 5000 (TUM's unit)"),
        (2.6, 100, None, "divide by 100 (centimetres)"),
        (2.0, 1 / 1000, None, "multiply by 1000"),
        (2.0, 1, None, ""),
        (30.0, 1, None, ""),
    ],
)
def test_probable_depth_unit(metres, units, usual, advice):
    depth = np.full((4, 4), metres * units)
    depth[0] = np.nan
    assert depth_unit_fix(typical_depth(depth), usual) == advice


def test_doubtful_units_are_told_with_their_remedy(tmp_path):
    root = own(tmp_path, ["0", "1"])
    assert "median" not in told(root)
    (root / "camera.yaml").write_text(CAMERA.replace("1000", "1"))
    assert "--depth-scale" in told(root)
    assert open_sequence(root, depth_scale=1000)[0].depth[0, 0] == 2.0
    # RealSense's
    (root / "camera.yaml").write_text(CAMERA.replace("1000", "0.001"))
    assert open_sequence(root)[0].depth[0, 0] == 2.0
    assert "1000 units per metre" in told(root)
    (root / "camera.yaml").write_text(CAMERA.replace("depth_scale: 1000", ""))
    for bad in (None, 0, -1, float("nan")):
        with pytest.raises(InputError, match="depth_scale"):
            open_sequence(root, depth_scale=bad)
    # floating point is in metres, unless said otherwise
    for i in range(2):
        (root / "depth" / f"{i}.png").unlink()
        np.save(root / "depth" / f"{i}.npy", np.full(SIZE, 2000.0))
    assert "divide by 1000" in told(root)
    assert open_sequence(root, depth_scale=1000)[1].depth[0, 0] == 2.0


# cameras

ROS = """image_width: 32
image_height: 24
camera_name: camera
camera_matrix:
  rows: 3
  cols: 3
  data: [20.0, 0, 15.5, 0, 21.0, 11.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
MESSAGE = "width: 32\nheight: 24\nK: [20.0, 0, 15.5, 0, 21.0, 11.5, 0, 0, 1]\nD: [0, 0, 0, 0, 0]\n"
MESSAGE += "---\n"  # as "ros2 topic echo" ends it
REALSENSE = {
    "width": 32,
    "height": 24,
    "ppx": 15.5,
    "ppy": 11.5,
    "fx": 20.0,
    "fy": 21.0,
    "model": "distortion.inverse_brown_conrady",
    "coeffs": [0.0] * 5,
    "depth_scale": 0.0010000000474974513,
}


@pytest.mark.parametrize(
    "text", [ROS, MESSAGE, json.dumps(REALSENSE), MESSAGE.replace("K", "k")]
)
def test_camera_files_of_others(text, tmp_path):
    path = tmp_path / "info.yaml"
    path.write_text(text)
    told: list[str] = []
    found = read_camera_file(path, told)
    assert found.camera == Camera(20, 21, 15.5, 11.5, height=24, width=32)
    assert any(found.distortion) == (text is ROS) == bool(told)
    for model in ("equidistant", "rational_polynomial"):
        path.write_text(ROS.replace("plumb_bob", model))
        if model == "equidistant":
            with pytest.raises(FormatError, match="Rectify"):
                read_camera_file(path, [])
        else:
            assert len(read_camera_file(path, []).distortion) == 5


def test_a_camera_may_be_given_to_every_reader(tmp_path):
    path = tmp_path / "info.yaml"
    for kind, writer in write.WRITERS.items():
        sequence = open_sequence(writer(tmp_path / kind).path)
        height, width = sequence.height, sequence.width
        words = f"99,98,{width / 2},{height / 2}"
        expected = Camera(99, 98, width / 2, height / 2, height=height, width=width)
        path.write_text(
            f"{{fx: 99, fy: 98, cx: {width / 2}, cy: {height / 2}, width: {width}, "
            f"height: {height}}}"
        )
        for given_camera in (words, str(path), expected):
            opened = open_sequence(
                sequence.root, sequence.kind, camera=given_camera
            )
            assert opened.camera(1) == opened[1].camera == expected
    for camera, message in (
        (Camera(9, 9, 4, 3, height=6, width=8), "8x6"),
        ("1,2,3", "neither four numbers nor a file"),
        ("-1,2,3,4", "focal length"),
    ):
        with pytest.raises(InputError, match=message):
            open_sequence(sequence.root, camera=camera)


def test_a_readout_may_be_given_to_every_reader(tmp_path):
    for kind, writer in write.WRITERS.items():
        plain = open_sequence(writer(tmp_path / kind).path)
        rolling = open_sequence(plain.root, plain.kind, readout_ms=20)
        expected = replace(plain.camera(1), readout_ms=20.0)
        assert rolling.camera(1) == rolling[1].camera == expected
        assert rolling.opened_with()["readout_ms"] == 20
    for readout in (-1.0, np.nan, "fast"):
        with pytest.raises(InputError, match="readout_ms"):
            open_sequence(plain.root, readout_ms=readout)


def test_template_is_filled_in_and_read(tmp_path):
    root = own(tmp_path, ["0", "1"])
    (root / "camera.yaml").unlink()
    with pytest.raises(InputError, match=r"camera\.yaml.*hybridvo init.*--camera"):
        open_sequence(root)
    path = write_camera_template(root)
    with pytest.raises(FormatError, match=r"camera\.yaml: missing: fx, fy"):
        open_sequence(root)
    # a template that states nothing does not stand in the way of what the user gives
    given = open_sequence(root, camera="20,20,15.5,11.5", depth_scale=1000)
    assert given.camera(0).fx == 20 and given[0].depth[0, 0] == 2.0
    text = path.read_text()
    values = dict.fromkeys(("fx", "fy", "cx", "cy"), 16.5)
    values |= {"width": 32, "height": 24, "depth_scale": 1000}
    for key, value in values.items():
        text = text.replace(f"\n{key}:", f"\n{key}: {value}")
    path.write_text(text)
    assert open_sequence(root)[0].camera == Camera(
        16.5, 16.5, 16.5, 16.5, height=24, width=32
    )
    with pytest.raises(InputError, match="exists already"):
        write_camera_template(root)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (CAMERA + "distortoin: [0, 0, 0, 0, 0]\n", "did you mean 'distortion'"),
        (CAMERA + "distortion: [0, x, 0, 0, 0]\n", "distortion.1"),
        (CAMERA + "distortion: [0, 0]\n", "4, 5 or 8 numbers"),
        (CAMERA.replace("fx: 20", "fx: twenty"), "fx.*'twenty'"),
        (CAMERA.replace("fx: 20", "fx: .nan"), "fx.*nan"),
        (CAMERA.replace("fx: 20\n", ""), "missing: fx"),
        (CAMERA.replace("1000", "-1"), "depth_scale"),
        ("!!python/object/apply:os.system ['true']\n", r"camera\.yaml:1"),
        ("- 1\n- 2\n", "got a list"),
        ("fx: 1\nfy: [1\n", r"camera\.yaml:3"),
        ("", "got a NoneType"),
        ("K: [1, 2]\n", "9 numbers"),
    ],
)
def test_damaged_camera_files(text, named, tmp_path):
    root = own(tmp_path, ["0", "1"])
    (root / "camera.yaml").write_text(text)
    with pytest.raises(FormatError, match=named) as caught:
        open_sequence(root)
    assert "camera.yaml" in str(caught.value) and len(str(caught.value)) < 1000


def test_intrinsics_of_another_size_are_refused(tmp_path):
    root = own(tmp_path, ["0", "1"])
    (root / "camera.yaml").write_text(
        CAMERA.replace("fx: 20", "fx: 2e1").replace("1000", "1e3")
    )
    assert open_sequence(root).camera(0).fx == 20.0
    (root / "camera.yaml").write_text(CAMERA.replace("width: 32", "width: 64"))
    with pytest.raises(InputError, match=r"32x24.*64x24"):
        open_sequence(root)


def test_flow_of_distorted_images_is_refused(tmp_path):
    root = own(tmp_path, ["0", "1"])
    (root / "camera.yaml").write_text(CAMERA + "distortion: [0.1, 0, 0, 0]\n")
    (root / "flow").mkdir()
    write_flo(root / "flow" / "0.flo", np.zeros((*SIZE, 2), np.float32))
    with pytest.raises(InputError, match="undistort"):
        open_sequence(root)


def test_flow_by_equal_names_or_by_order(tmp_path):
    for names in (("a", "b"), ("x", "y"), ("b",)):
        root = own(tmp_path / "".join(names), ["a", "b", "c"])
        (root / "flow").mkdir()
        for number, name in enumerate(names):
            write_flo(
                root / "flow" / f"{name}.flo",
                np.full((*SIZE, 2), number, np.float32),
            )
        sequence = open_sequence(root)
        assert sequence.has_flow and sequence.flow(1)[0].max() == len(names) - 1
    with pytest.raises(FileNotFoundError, match="no flow file from frame 0"):
        sequence.flow(0)


@pytest.mark.parametrize(
    ("images", "flows", "kept"),
    [
        ((0, 1, 2, 3), (0, 1, 2), (0, 1, 2)),
        ((0, 2, 3, 4), (0, 1, 2, 3), (2, 3)),  # one image deleted
        ((0, 2, 3, 4), (0, 2, 3), (2, 3)),  # and its flow with it
        ((0, 10, 20, 30), (0, 10, 20), (0, 10, 20)),  # flow over ten frames
        # every second image of a sequence with its flow
        ((0, 2, 4, 6), (0, 1, 2, 3, 4, 5), ()),
        ((0, 1, 5, 6), (0, 1, 5), (0, 5)),
    ],
)
def test_flow_that_led_to_a_missing_image_is_not_used(
    tmp_path, images, flows, kept
):
    root = own(tmp_path, [f"{i:04d}" for i in images])
    (root / "flow").mkdir()
    for number in flows:
        write_flo(
            root / "flow" / f"{number:04d}.flo",
            np.full((*SIZE, 2), number, np.float32),
        )
    sequence = open_sequence(root)
    led = [i for i, path in enumerate(sequence.flow_files) if path is not None]
    assert [sequence.flow(i)[0].max() for i in led] == list(kept)
    is_told = any("is not used" in warning for warning in sequence.warnings)
    assert is_told == (len(kept) < len(set(flows) & set(images)))


def test_intrinsics_of_another_resolution_are_a_warning(tmp_path):
    path = own(tmp_path, ["0", "1"])
    assert "principal point" not in told(path)
    assert "for 64x48?" in told(path, camera="40,40,31.5,23.5")
    assert "principal point" in told(path, camera="20,20,21,8")
    assert "principal point" not in told(path, camera="20,20,19,9")
