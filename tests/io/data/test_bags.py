"""Bags of ROS 1 and ROS 2: what is in them comes out, whatever way it is stored."""

from __future__ import annotations

import contextlib
import json
import re
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridvo import InputError, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.io.data.bags import messages as ros
from hybridvo.io.data.bags.rvl import decode_rvl
from hybridvo.io.data.bags.topics import TopicSummary, choose_topics
from hybridvo.run.cli import main
from hybridvo.run.commands.arguments import build_parser
from tests import bags


def refused(path: Path, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        open_sequence(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_a_bag_reads_back_in_any_order(kind: str, tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path / "a", kind)
    # what means something in a URI
    odd = path.parent.rename(tmp_path / "50% #1?")
    sequence = open_sequence(odd / path.name)
    assert (sequence.kind, len(sequence)) == ("bag", bags.FRAMES)
    camera = sequence.camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == bags.K
    stamps = [bags.stamp(i) / 1e9 for i in range(bags.FRAMES)]
    np.testing.assert_allclose(sequence.timestamps, stamps, rtol=0, atol=1e-6)
    for i in (0, 1, 2, 3, 4, 1, 4, 0, 3):
        frame = sequence[i]
        np.testing.assert_array_equal(frame.rgb, bags.rgb(i))
        np.testing.assert_allclose(frame.depth, bags.millimetres(i) / 1000)
    assert bags.RGB in sequence.warnings[0] and "guessed" in sequence.warnings[0]


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_topics_that_are_named(kind: str, tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, kind)
    for i in range(2):
        for name, shade in (("left", 10), ("right", 20)):
            grey = np.full(bags.SIZE, shade + i, np.uint8)
            image = writer.image(grey, "mono8", bags.stamp(i))
            writer.write(f"/{name}/image_raw", image, bags.stamp(i))
            writer.write(f"/{name}/camera_info", writer.info(), bags.stamp(i))
        metres = np.full(bags.SIZE, 2.5, np.float32)
        image = writer.image(metres, "32FC1", bags.stamp(i))
        writer.write("/map/image", image, bags.stamp(i))
    path = writer.close()
    names = {"topic_rgb": "/right/image_raw", "topic_depth": "/map/image"}
    sequence = open_sequence(path, **names, topic_info="/left/camera_info")
    assert (sequence[1].rgb == 21).all()
    assert float(sequence[0].depth[3, 4]) == 2.5
    assert not any("guessed" in text for text in sequence.warnings)
    assert "'/nowhere' is not there" in refused(path, topic_rgb="/nowhere")
    wrong_type = refused(path, topic_rgb="/left/camera_info")
    assert "is of type sensor_msgs/msg/CameraInfo" in wrong_type
    folder = tmp_path / "folder"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    assert "--topic-rgb" in refused(folder, topic_rgb="/a")


def facts(*names: str) -> list[TopicSummary]:
    """Topics of a type that their name tells, as real drivers name them."""
    kinds = {"camera_info": ros.INFO_TYPE, "odom": "nav_msgs/msg/Odometry"}
    found = []
    for name in names:
        last = name.rpartition("/")[2]
        is_compressed = last.startswith("compressed")
        kind = ros.COMPRESSED_TYPE if is_compressed else ros.IMAGE_TYPE
        encoding = "16uc1" if "depth" in name.lower() else "rgb8"
        encoding = "mono8" if "infra" in name else encoding
        found.append(TopicSummary(name, kinds.get(last, kind), 5, encoding))
    return found


def test_topics_of_known_drivers_are_found() -> None:
    realsense = facts(
        "/camera/infra1/image_rect_raw",
        "/camera/depth/image_rect_raw",
        "/camera/depth/camera_info",
        "/camera/color/image_raw",
        "/camera/color/image_raw/compressed",
        "/camera/color/camera_info",
        "/camera/aligned_depth_to_color/image_raw",
        "/camera/aligned_depth_to_color/image_raw/compressedDepth",
        "/camera/aligned_depth_to_color/camera_info",
        "/odom",
    )
    found = choose_topics(realsense)
    assert found.rgb == "/camera/color/image_raw"
    assert found.depth == "/camera/aligned_depth_to_color/image_raw"
    assert found.rgb_info == "/camera/color/camera_info"
    assert found.depth_info == "/camera/aligned_depth_to_color/camera_info"
    assert found.truth == ""  # odometry of a robot is no truth

    two_cameras = facts(
        "/front/rgb/image_raw",
        "/back/rgb/image_raw",
        "/back/rgb/camera_info",
        "/back/depth_registered/image_raw",
    )
    assert choose_topics(two_cameras).rgb == "/back/rgb/image_raw"

    guessed = choose_topics(two_cameras).guessed
    assert guessed.startswith(
        "2 cameras: /back/rgb/image_raw, /front/rgb/image_raw; "
    )
    assert choose_topics(two_cameras, rgb="/front/rgb/image_raw").rgb == (
        "/front/rgb/image_raw"
    )
    assert "cameras" not in choose_topics(realsense).guessed

    zed = facts(
        "/zed/zed_node/left/image_rect_color",
        "/zed/zed_node/rgb/image_rect_color",
        "/zed/zed_node/rgb/camera_info",
        "/zed/zed_node/depth/depth_registered",
    )
    found = choose_topics(zed)
    assert found.rgb == "/zed/zed_node/rgb/image_rect_color"
    assert found.depth == "/zed/zed_node/depth/depth_registered"
    assert found.rgb_info == "/zed/zed_node/rgb/camera_info"

    no_depth = facts("/camera/image_raw", "/camera/camera_info")
    with pytest.raises(InputError, match="no topic with images of depth"):
        choose_topics(no_depth)


def test_masks_are_taken_in_their_order(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "ros1")
    masks = tmp_path / "masks"
    masks.mkdir()
    for i in range(bags.FRAMES):
        mask = np.full(bags.SIZE, 255, np.uint8)
        mask[:, : i + 1] = 0
        (masks / f"{i}.png").write_bytes(bags.png_bytes(mask))
    sequence = open_sequence(path, mask=masks)
    assert np.isnan(sequence[2].depth[:, :3]).all()
    assert (sequence[2].depth[:, 3:] > 0).all()
    (masks / "0.png").unlink()
    with pytest.raises(InputError, match="4 files for 5 frames"):
        open_sequence(path, mask=masks)


# -- encodings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_encodings_of_colour(kind: str, tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, kind)
    colour = bags.rgb(1)
    bgr = np.ascontiguousarray(colour[:, :, ::-1])
    grey = colour[:, :, 0]
    image = writer.image(bgr, "bgr8", 0, padding=5)
    np.testing.assert_array_equal(ros.colour_image(image), colour)
    image = writer.image(np.dstack([colour, grey]), "rgba8", 0)
    np.testing.assert_array_equal(ros.colour_image(image), colour)
    image = writer.image(grey, "mono8", 0, padding=3)
    np.testing.assert_array_equal(ros.colour_image(image), grey)
    wide = grey.astype(np.uint16) * 256 + 7
    for big_endian in (False, True):
        image = writer.image(wide, "mono16", 0, big_endian=big_endian)
        np.testing.assert_array_equal(ros.colour_image(image), grey)
    png = writer.compressed(bags.png_bytes(bgr), "rgb8; png compressed bgr8", 0)
    np.testing.assert_array_equal(ros.colour_image(png), colour)
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    jpeg = cv2.imencode(".jpg", smooth[:, :, ::-1])[1].tobytes()
    decoded = ros.colour_image(writer.compressed(jpeg, "jpeg", 0))
    assert np.abs(decoded.astype(int) - smooth).max() <= 3
    with pytest.raises(FormatError, match="encoding '64fc4' of colour is not read"):
        ros.colour_image(writer.image(colour, "64FC4", 0))
    writer.close()


@pytest.mark.parametrize(
    ("pattern", "first_row", "second_row"),
    [
        ("rggb", "rg", "gb"),
        ("bggr", "bg", "gr"),
        ("gbrg", "gb", "rg"),
        ("grbg", "gr", "bg"),
    ],
)
def test_bayer_patterns_give_the_colours_of_their_names(
    pattern: str, first_row: str, second_row: str, tmp_path: Path
) -> None:
    level = {"r": 200, "g": 100, "b": 30}
    tile = [[level[c] for c in row] for row in (first_row, second_row)]
    mosaic = np.tile(np.array(tile, np.uint8), (8, 8))
    writer = bags.Writer(tmp_path, "ros1")
    image = ros.colour_image(writer.image(mosaic, f"bayer_{pattern}8", 0))
    writer.close()
    np.testing.assert_array_equal(
        image[4:12, 4:12], np.full((8, 8, 3), (200, 100, 30))
    )


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_encodings_of_depth(kind: str, tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, kind)
    stored = bags.millimetres(2)
    for encoding in ("16UC1", "mono16"):
        for big_endian in (False, True):
            image = writer.image(
                stored, encoding, 0, padding=6, big_endian=big_endian
            )
            np.testing.assert_array_equal(ros.depth_image(image), stored)
    header = struct.pack("<iff", 0, 0.0, 0.0)
    packed = {
        "16UC1; compressedDepth": header + bags.png_bytes(stored),
        "16UC1; compressedDepth png": header + bags.png_bytes(stored),
        "16UC1; compressedDepth rvl": header + bags.rvl_bytes(stored),
        "16UC1; png compressed ": bags.png_bytes(stored),
    }
    for form, data in packed.items():
        message = writer.compressed(data, form, 0)
        np.testing.assert_array_equal(ros.depth_image(message), stored)
    # floats: stored = a / depth + b, worked backwards by hand
    quantised = np.array([[0, 1100, 600]], np.uint16)
    header = struct.pack("<iff", 0, 2000.0, 100.0)
    form = "32FC1; compressedDepth png"
    message = writer.compressed(header + bags.png_bytes(quantised), form, 0)
    np.testing.assert_array_equal(ros.depth_image(message), [[np.nan, 2.0, 4.0]])
    picture = writer.compressed(bags.png_bytes(stored.astype(np.uint8)), "png", 0)
    with pytest.raises(FormatError, match="expected depth of 16 bits, got uint8"):
        ros.depth_image(picture)
    with pytest.raises(FormatError, match="encoding 'rgb8' of depth is not read"):
        ros.depth_image(writer.image(bags.rgb(0), "rgb8", 0))
    writer.close()


def test_rvl_by_hand_and_damaged() -> None:
    # two zeros, then 5 and 4: differences 5 and -1, coded 10 and 1
    # nibbles: 2 | 2 | 10 = 001 010 -> 1010 0001 | 1 | then a run of no zeros is not needed
    word = 0x22A11000
    data = struct.pack("<iiI", 4, 1, word)
    np.testing.assert_array_equal(decode_rvl(data, "test"), [[0, 0, 5, 4]])
    depth = np.random.default_rng(3).integers(0, 65536, (31, 17)).astype(np.uint16)
    depth[depth < 20000] = 0
    code = bags.rvl_bytes(depth)
    np.testing.assert_array_equal(decode_rvl(code, "test"), depth)
    with pytest.raises(FormatError, match=r"damaged: .* of 527 pixels"):
        decode_rvl(code[:-40], "test")
    with pytest.raises(FormatError, match="declares"):
        decode_rvl(struct.pack("<ii", 2**30, 2**30) + code, "test")
    for seed in range(50):
        noise = np.random.default_rng(seed).bytes(200)
        try:
            decode_rvl(struct.pack("<ii", 20, 20) + noise, "test")
        except FormatError:
            continue


def test_an_image_that_declares_more_than_it_holds_is_refused(
    tmp_path: Path,
) -> None:
    writer = bags.Writer(tmp_path, "sqlite3")
    image = writer.image(bags.rgb(0), "rgb8", 0)
    for name, value in (("height", 25), ("step", 10**6), ("width", 2**31 - 1)):
        kept = getattr(image, name)
        object.__setattr__(image, name, value)
        with pytest.raises(FormatError, match="expected"):
            ros.colour_image(image)
        object.__setattr__(image, name, kept)
    bomb = bytearray(bags.png_bytes(bags.rgb(0)))
    bomb[16:24] = struct.pack(">II", 30000, 30000)
    with pytest.raises(FormatError):
        ros.colour_image(writer.compressed(bytes(bomb), "png", 0))
    writer.close()


# -- cameras ---------------------------------------------------------------------------------------


def test_cameras_with_binning_and_with_lenses(tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, "ros1")
    binned = ros.camera_info(writer.info((40, 40, 15.5, 11.5), binning=2), "test")
    camera = binned.lens.camera
    # 32 pixels become 16; the centre of the image stays the centre of the image
    assert (camera.width, camera.height, camera.fx) == (16, 12, 20)
    assert (camera.cx, camera.cy) == (7.5, 5.5)
    for model, d in (
        ("plumb_bob", (0.1, -0.05, 0.001, 0.002, 0.01)),
        ("rational_polynomial", (0.1, -0.05, 0.001, 0.002, 0.01, 0.2, 0.1, 0.02)),
        ("equidistant", (0.05, -0.01, 0.002, -0.001)),
    ):
        lens = ros.camera_info(writer.info(d=d, model=model), "test").lens
        u, v = lens.maps()
        ray = np.array([[[(20 - 15.5) / 40, (5 - 11.5) / 41]]])
        K, D = lens.camera.K, np.array(d)
        if model == "equidistant":
            expected, _ = cv2.fisheye.projectPoints(
                np.dstack([ray, np.ones((1, 1))]), np.zeros(3), np.zeros(3), K, D
            )
        else:
            point = np.append(ray.reshape(2), 1.0)
            expected, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, D)
        np.testing.assert_allclose(
            (u[5, 20], v[5, 20]), expected.reshape(2), atol=1e-3
        )
    with pytest.raises(FormatError, match="distortion model 'omnidirectional'"):
        ros.camera_info(writer.info(d=(1.0,) * 4, model="omnidirectional"), "test")
    empty = writer.info((0, 0, 0, 0))
    with pytest.raises(FormatError, match="holds no calibration"):
        ros.camera_info(empty, "test")
    writer.close()


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_distortion_is_taken_out_of_colour_and_depth(
    kind: str, tmp_path: Path
) -> None:
    d = (0.2, -0.05, 0.0, 0.0, 0.0)
    writer = bags.Writer(tmp_path, kind)
    for i in range(2):
        writer.write(bags.INFO, writer.info(d=d), bags.stamp(i))
        writer.write(
            bags.RGB,
            writer.image(bags.rgb(i), "rgb8", bags.stamp(i)),
            bags.stamp(i),
        )
        depth = writer.image(bags.millimetres(i), "16UC1", bags.stamp(i))
        writer.write(bags.DEPTH, depth, bags.stamp(i))
    sequence = open_sequence(writer.close())
    K = sequence.camera(0).K
    expected = cv2.undistort(bags.rgb(0), K, np.array(d))
    difference = np.abs(sequence[0].rgb.astype(int) - expected)
    assert np.median(difference) <= 2  # both interpolate, in fixed point
    assert any(
        "distortion (plumb_bob) is taken out" in w for w in sequence.warnings
    )
    # a camera that the user gives has no distortion
    plain = open_sequence(sequence.root, camera="40,41,15.5,11.5")
    np.testing.assert_array_equal(plain[0].rgb, bags.rgb(0))


def test_a_bag_without_a_camera_asks_for_one(tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, "sqlite3")
    image = writer.image(bags.rgb(0), "rgb8", bags.stamp(0))
    writer.write(bags.RGB, image, bags.stamp(0))
    depth = writer.image(bags.millimetres(0), "16UC1", bags.stamp(0))
    writer.write(bags.DEPTH, depth, bags.stamp(0))
    path = writer.close()
    assert "no CameraInfo for" in refused(path)
    assert open_sequence(path, camera="40,41,15.5,11.5").camera(0).fx == 40
    wrong = tmp_path / "camera.yaml"
    wrong.write_text("fx: 9\nfy: 9\ncx: 4\ncy: 4\nwidth: 9\nheight: 9\n")
    assert "images of /camera/color/image_raw are 32x24" in refused(
        path, camera=wrong
    )


# -- time ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_colour_and_depth_are_matched_by_the_stamps_of_their_headers(
    kind: str, tmp_path: Path
) -> None:
    """Depth comes at half the rate, late, and one image comes before an earlier one."""
    writer = bags.Writer(tmp_path, kind)
    messages = []
    for i in range(6):
        late = 90_000_000 if i == 2 else 1_000_000
        image = writer.image(bags.rgb(i), "rgb8", bags.stamp(i))
        messages.append((bags.stamp(i) + late, bags.RGB, image))
        if i % 2 == 0:
            shifted = bags.stamp(i) + 7_000_000
            depth = writer.image(bags.millimetres(i), "16UC1", shifted)
            messages.append((shifted + 120_000_000, bags.DEPTH, depth))
    messages.append((bags.stamp(0), bags.INFO, writer.info()))
    for time, topic, message in sorted(messages, key=lambda each: each[0]):
        writer.write(topic, message, time)
    sequence = open_sequence(writer.close())
    assert len(sequence) == 3
    for k, i in enumerate((0, 2, 4)):
        frame = sequence[k]
        np.testing.assert_array_equal(frame.rgb, bags.rgb(i))
        np.testing.assert_allclose(frame.depth, bags.millimetres(i) / 1000)
    assert any("3 of 6 colour images have no depth" in w for w in sequence.warnings)


def test_stamps_of_recording_stand_in_for_empty_headers(tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, "ros1")
    for i in range(3):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", 0), time)
        writer.write(
            bags.DEPTH, writer.image(bags.millimetres(i), "16UC1", 0), time
        )
    sequence = open_sequence(writer.close())
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30, rtol=1e-4)
    assert any("headers have no stamps" in text for text in sequence.warnings)


# -- places ----------------------------------------------------------------------------------------

HALF_TURN_ABOUT_Z = (0.0, 0.0, 1.0, 0.0)


def unregistered(
    root: Path, kind: str, with_tf: bool = True, size: tuple[int, int] = bags.SIZE
) -> Path:
    """Depth of a plane 2 m away, of a camera that stands 10 cm to the left of colour."""
    writer = bags.Writer(root, kind)
    if with_tf:
        # both hang below a link, as a driver publishes them; the link itself is turned
        places = {"depth": (-0.05, 0, 0), "color": (0.05, 0, 0)}
        for name, place in places.items():
            xyz = -np.array(place)  # the half turn
            edge = writer.transform("link", name, xyz, HALF_TURN_ABOUT_Z)
            writer.write("/tf_static", writer.tf(edge), bags.stamp(0))
    depth_info = "/camera/depth/camera_info"
    for i in range(2):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(depth_info, writer.info(frame="depth", size=size), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", time), time)
        metres = np.full(size, 2000, np.uint16)
        metres[:, 10] = 1000
        image = writer.image(metres, "16UC1", time, frame="depth")
        writer.write("/camera/depth/image_rect_raw", image, time)
    return writer.close()


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_depth_is_registered_by_tf_static(kind: str, tmp_path: Path) -> None:
    """40 px focal length, 0.1 m to the right: 2 px at 2 m, 4 px at 1 m, both to the left."""
    sequence = open_sequence(unregistered(tmp_path, kind))
    depth = sequence[1].depth
    row = np.full(32, 2.0, np.float32)
    row[6] = 1.0  # was column 10; the plane behind it moved by 2 px only
    row[8] = 0.0  # what the near column hid
    row[30:] = 0.0  # what the depth camera does not see
    np.testing.assert_array_equal(depth, np.tile(row, (24, 1)))
    assert any("depth is registered to colour" in w for w in sequence.warnings)
    assert any("10 cm" in text for text in sequence.warnings)


def test_depth_without_an_extrinsic(tmp_path: Path) -> None:
    sequence = open_sequence(unregistered(tmp_path / "a", "ros1", with_tf=False))
    assert "taken as registered to colour" in sequence.assumed[0]
    small = unregistered(tmp_path / "b", "ros1", with_tf=False, size=(12, 16))
    assert "depth is 16x12, colour 32x24 pixels" in refused(small)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_true_poses_of_a_body_become_those_of_the_camera(
    kind: str, tmp_path: Path
) -> None:
    """The camera sits 0.2 m in front of the body, and looks where the body goes."""
    turn = np.array(
        [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    )  # optical axes in the body
    xyzw = Rotation.from_matrix(turn).as_quat()
    writer = bags.Writer(tmp_path, kind)
    edge = writer.transform("base", "color", (0.2, 0, 0), xyzw)
    writer.write("/tf_static", writer.tf(edge), bags.stamp(0))
    for i in range(bags.FRAMES):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", time), time)
        depth = writer.image(bags.millimetres(i), "16UC1", time)
        writer.write(bags.DEPTH, depth, time)
        odometry = writer.odometry(
            (0.1 * i, 0, 0), (0, 0, 0, 1), time + 10**6, "base"
        )
        writer.write("/ground_truth/odom", odometry, time)
        wheels = writer.odometry((9.0, 9.0, 9.0), (0, 0, 0, 1), time, "base")
        writer.write("/odom", wheels, time)
    sequence = open_sequence(writer.close())
    assert sequence.topics.truth == "/ground_truth/odom"
    np.testing.assert_allclose(sequence.poses[:, :3, :3], np.tile(turn, (5, 1, 1)))
    np.testing.assert_allclose(sequence.poses[:, 0, 3], 0.2 + 0.1 * np.arange(5))
    named = open_sequence(sequence.root, topic_truth="/odom")
    assert named.poses[2, 0, 3] == pytest.approx(9.2)


def test_true_poses_of_a_frame_that_is_not_named(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path / "a", "sqlite3")
    assert open_sequence(path).poses is None
    writer = bags.Writer(tmp_path / "b", "sqlite3")
    for i in range(3):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", time), time)
        depth = writer.image(bags.millimetres(i), "16UC1", time)
        writer.write(bags.DEPTH, depth, time)
        pose = writer.pose((i, 0, 0), (0, 0, 0, 1), time)
        writer.write("/vrpn_client_node/cam/pose", pose, time)
    sequence = open_sequence(writer.close())
    np.testing.assert_allclose(sequence.poses[:, 0, 3], [0, 1, 2])
    assert "a frame that is not named" in sequence.assumed[0]


def test_transforms_are_chained_and_moving_ones_are_not_used() -> None:
    step = np.eye(4)
    step[0, 3] = 1.0
    edges = {("a", "b"): step, ("b", "c"): step, ("d", "c"): step}
    found = ros.transform_between(edges, "a", "d")
    np.testing.assert_allclose(found[:3, 3], [1, 0, 0])  # + 1 + 1 - 1
    assert ros.transform_between(edges, "a", "nowhere") is None


# -- recordings of RealSense's tools ---------------------------------------------------------------


def realsense_ros1(root: Path) -> Path:
    """As SDK 2.56 records: ROS 1 with images that have four bytes more than they should."""
    writer = bags.Writer(root, "ros1")
    depth_stream = "/device_0/sensor_0/Depth_0"
    colour_stream = "/device_0/sensor_1/Color_0"
    unit = writer.make("std_msgs/msg/Float32", data=0.0001)
    writer.write("/device_0/sensor_0/option/Depth_Units/value", unit, 1)
    for stream, x in ((depth_stream, 0.0), (colour_stream, -0.1)):
        info = writer.info(frame="", model="Brown Conrady", d=(0.0,) * 5)
        object.__setattr__(info, "P", np.zeros(12))
        writer.write(f"{stream}/info/camera_info", info, 1)
        transform = writer.make(
            "geometry_msgs/msg/Transform",
            translation=writer.vector((x, 0, 0)),
            rotation=writer.quaternion((0, 0, 0, -1)),
        )
        writer.write(f"{stream}/tf/1", transform, 1)
    for i in range(2):
        image = writer.image(bags.rgb(i), "rgb8", bags.stamp(i), frame="0")
        writer.write(f"{colour_stream}/image/data", image, 2 + i, b"\0\0\0\0")
        depth = np.full(bags.SIZE, 20000, np.uint16)
        image = writer.image(depth, "mono16", bags.stamp(i), frame="0")
        appended = struct.pack("<f", 0.0001)
        writer.write(f"{depth_stream}/image/data", image, 2 + i, appended)
    return writer.close()


def realsense_ros2(root: Path) -> Path:
    """As SDK 2.59 records: ROS 2, compressed, with /tf_static and options as texts."""
    writer = bags.Writer(root, "sqlite3")
    unit = writer.make("std_msgs/msg/String", data="0.000100")
    writer.write("/device_0/sensor_0/option/Depth_Units/value", unit, 1)
    streams = {"Depth": "sensor_0/Depth_0", "Color": "sensor_1/Color_0"}
    for (frame, stream), x in zip(streams.items(), (0.0, 0.1), strict=True):
        edge = writer.transform("ref_1", frame, (x, 0, 0), (0, 0, 0, 1))
        writer.write("/tf_static", writer.tf(edge), 1)
        stream = f"/device_0/{stream}"
        text = writer.make("std_msgs/msg/String", data="width=32;height=24")
        writer.write(f"{stream}/camera_info", text, 1)
        for i in range(2):
            info = writer.info(frame=frame)
            writer.write(f"{stream}/image/camera_info", info, 2 + i)
            if frame == "Depth":
                depth = np.full(bags.SIZE, 20000, np.uint16)
                data = struct.pack("<iff", 0, 0.0, 0.0) + bags.png_bytes(depth)
                form = "16UC1; compressedDepth png"
                topic = f"{stream}/image/data/compressedDepth"
            else:
                data = bags.png_bytes(bags.rgb(i)[:, :, ::-1])
                form = "rgb8; png compressed bgr8"
                topic = f"{stream}/image/data/compressed"
            message = writer.compressed(data, form, bags.stamp(i), frame)
            writer.write(topic, message, 2 + i)
    return writer.close()


@pytest.mark.parametrize("record", [realsense_ros1, realsense_ros2])
def test_a_recording_of_realsense_tools(record, tmp_path: Path) -> None:
    sequence = open_sequence(record(tmp_path))
    assert len(sequence) == 2
    np.testing.assert_array_equal(sequence[1].rgb, bags.rgb(1))
    depth = sequence[0].depth
    # 20000 units of 0.1 mm; points lie 0.1 m further left for colour: 2 px at 2 m
    assert (depth[:, :30] == 2.0).all() and (depth[:, 30:] == 0.0).all()


# -- damage ----------------------------------------------------------------------------------------


LARGE = (120, 160)
"""Of a frame 96 kB: the writers' chunks of a megabyte hold eleven."""


def storage(path: Path) -> Path:
    """The file in which the messages of a bag lie."""
    if path.is_file():
        return path
    return next(file for file in path.iterdir() if file.suffix != ".yaml")


@pytest.mark.parametrize("kind", bags.FORMATS)
@pytest.mark.parametrize("fraction", [0.5, 0.8, 0.98])
def test_a_bag_that_was_cut_off_gives_what_it_holds(
    kind: str, fraction: float, tmp_path: Path
) -> None:
    frames = 40
    path = bags.plain_bag(tmp_path, kind, frames, LARGE)
    file = storage(path)
    if kind == "sqlite3":
        # newer versions of SQLite add statistics at the end, which no recorder writes
        with contextlib.closing(sqlite3.connect(file)) as database:
            database.execute("DROP TABLE IF EXISTS sqlite_stat1")
            database.commit()
    data = file.read_bytes()
    file.write_bytes(data[: int(fraction * len(data))])
    if kind != "ros1":
        (path / "metadata.yaml").unlink()
    sequence = open_sequence(path)
    assert fraction * frames - 12 < len(sequence) <= fraction * frames + 1
    for i in range(len(sequence)):
        np.testing.assert_array_equal(sequence[i].rgb, bags.rgb(i, LARGE))
        expected = bags.millimetres(i, LARGE) / 1000
        np.testing.assert_allclose(sequence[i].depth, expected)
    assert any("cut off" in text for text in sequence.warnings)


@pytest.mark.parametrize("is_indexed", [True, False])
def test_reading_goes_on_behind_damage_and_says_how_much(
    is_indexed: bool, tmp_path: Path
) -> None:
    frames = 60
    path = bags.plain_bag(tmp_path, "ros1", frames, LARGE)
    data = bytearray(path.read_bytes())
    mark = b"\x04\x00\x00\x00op=\x05"
    chunks = [at.start() for at in re.finditer(re.escape(mark), data)]
    assert len(chunks) > 3
    # the header of a chunk, and what stands around it
    data[chunks[1] - 2000 : chunks[1] + 2000] = b"\xff" * 4000
    if not is_indexed:
        del data[chunks[-1] + 50_000 :]
    path.write_bytes(data)
    sequence = open_sequence(path)
    numbers = np.rint((sequence.timestamps - bags.START / 1e9) * 30).astype(int)
    assert numbers[0] == 0 and numbers[-1] > 50
    for i in (0, len(sequence) - 1):
        np.testing.assert_array_equal(sequence[i].rgb, bags.rgb(numbers[i], LARGE))
    damage, used = sequence.warnings[:2]
    assert "damaged or cut off: " in damage and "()" not in damage
    seconds = f"seconds 0.0 to {(numbers[-1]) / 30:.1f}"
    if is_indexed:
        images = f"{len(sequence)} of {frames} colour images"
        assert numbers[-1] == frames - 1
        seconds += " of 2.0"
    else:
        images = f"{len(sequence)} colour images"
    assert used.startswith("drive.bag: what is whole is used: ")
    assert images in used and used.endswith(f"{seconds}.")


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_the_topics_of_a_bag_are_listed(kind: str, tmp_path: Path, capsys) -> None:
    path = bags.plain_bag(tmp_path, kind)
    assert main(["topics", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in report["topics"]}
    assert set(rows) == {bags.RGB, bags.DEPTH, bags.INFO}
    assert rows[bags.DEPTH]["taken_for"] == "depth"
    assert rows[bags.INFO]["taken_for"] == "camera of colour, camera of depth"
    assert rows[bags.RGB]["encoding"] == "rgb8"
    assert rows[bags.RGB]["messages"] == bags.FRAMES
    assert report["problem"] == ""
    assert main(["topics", str(path)]) == 0
    text = capsys.readouterr().out
    assert bags.RGB in text and "topics are guessed" in text


def test_the_topics_of_a_bag_that_lacks_depth(tmp_path: Path, capsys) -> None:
    writer = bags.Writer(tmp_path, "mcap")
    writer.write("/left/image", writer.image(bags.rgb(0), "rgb8", 1), 1)
    path = writer.close()
    assert main(["topics", str(path)]) == 0
    text = capsys.readouterr().out
    assert "/left/image" in text and "no topic with images of depth" in text
    assert main(["topics", str(tmp_path)]) == 2
    assert "expected a bag" in capsys.readouterr().err


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_a_bag_with_a_damaged_part_gives_the_rest(
    kind: str, tmp_path: Path
) -> None:
    frames = 60
    path = bags.plain_bag(tmp_path, kind, frames, LARGE)
    file = storage(path)
    data = bytearray(file.read_bytes())
    place = len(data) // 3
    data[place : place + 60_000] = b"\xff" * 60_000
    file.write_bytes(data)
    sequence = open_sequence(path)
    right = list[int]()
    for i in range(len(sequence)):
        k = round((sequence.timestamps[i] - bags.START / 1e9) * 30)
        try:
            frame = sequence[i]
        except InputError:
            continue
        if (frame.rgb == bags.rgb(k, LARGE)).all():
            right.append(k)
    # a chunk of mcap holds eleven frames; SQLite finds nothing behind a lost page of its tree
    assert len([k for k in right if k < frames // 3]) >= frames // 3 - 12
    if kind != "sqlite3":
        assert len([k for k in right if k > frames // 3]) >= 2 * frames // 3 - 12


@pytest.mark.parametrize(
    "content",
    [b"", b"#ROSBAG V2.0\n", b"#ROSBAG V2.0\n" + b"\xff" * 500, b"noise" * 99],
)
@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "drive.db3"])
def test_what_is_no_bag_is_refused_in_one_line(
    content: bytes, name: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert "drive" in refused(path)


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_memory_does_not_grow_with_the_bag(kind: str, tmp_path: Path) -> None:
    peaks = []
    for frames in (30, 120):
        path = bags.plain_bag(tmp_path / str(frames), kind, frames, LARGE)
        open_sequence(path)[0]  # what is loaded once does not count
        tracemalloc.start()
        sequence = open_sequence(path)
        for i in range(frames):
            sequence[i]
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


@pytest.mark.parametrize(
    ("old", "new"), [(f"name: {bags.RGB}", "name: 7"), ("count: 5", "count: '9'")]
)
def test_metadata_that_names_no_text_is_left_aside(
    old: str, new: str, tmp_path: Path
) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    metadata = path / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8")
    assert old in text
    metadata.write_text(text.replace(old, new), encoding="utf-8")
    sequence = open_sequence(path, trust=True)
    assert len(sequence) == bags.FRAMES


@pytest.mark.usefixtures("read_here")
def test_without_rosbags_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bags.plain_bag(tmp_path, "ros1", frames=1)
    monkeypatch.setattr("hybridvo.io.data.bags.source.find_spec", lambda name: None)
    assert "pip install 'hybridvo[bags]'" in refused(path)


def test_real_frames_are_the_same_from_a_bag(
    shared_data: Path, tmp_path: Path
) -> None:
    folder = open_sequence(
        shared_data / "tum" / "rgbd_dataset_freiburg1_xyz_first10",
        camera="517.3,516.5,318.6,255.3",
    )
    writer = bags.Writer(tmp_path, "mcap")
    info = writer.info((517.3, 516.5, 318.6, 255.3), (480, 640))
    for i in range(3):
        time = round(1e9 * folder.timestamps[i])
        colour = cv2.imread(str(folder.rgb_files[i]))
        stored = cv2.imread(str(folder.depth_files[i]), cv2.IMREAD_UNCHANGED)
        writer.write(bags.INFO, info, time)
        writer.write(bags.RGB, writer.image(colour, "bgr8", time), time)
        header = struct.pack("<iff", 0, 0.0, 0.0)
        data = header + bags.png_bytes(stored)
        depth = writer.compressed(data, "16UC1; compressedDepth", time)
        writer.write("/camera/depth_registered/compressedDepth", depth, time)
    sequence = open_sequence(writer.close(), depth_scale=5000)
    for i in range(3):
        np.testing.assert_array_equal(sequence[i].rgb, folder[i].rgb)
        np.testing.assert_array_equal(sequence[i].depth, folder[i].depth)


# -- the command line ------------------------------------------------------------------------------


def test_the_commands_take_a_bag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    out = tmp_path / "out"
    given = [str(path), "--topic-rgb", bags.RGB, "--topic-depth", bags.DEPTH]
    run = ["run", *given, "--method", "identity", "--out", str(out)]
    assert main(run) == 0
    assert len((out / "trajectory.tum").read_text().splitlines()) == bags.FRAMES
    assert main([*run, "--topic-info", "/nowhere", "--overwrite"]) == 2
    assert "'/nowhere' is not there" in capsys.readouterr().err
    compared = ["compare", *given, "--methods", "identity"]
    assert main([*compared, "--out", str(tmp_path / "compared")]) == 0
    assert build_parser().parse_args(["doctor", *given]).topic_rgb == bags.RGB


# -- an inertial sensor, a clock and a body beside the camera ------------------------------

IMU_XYZW = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
"""A quarter turn about z, from the axes of the IMU to those of ``base``."""
RATES = (0.3, 0.0, 0.0)


def robot(
    root: Path,
    imu: str,
    frame: str = "imu",
    depth_late_ns: int = 0,
    tf: bool = True,
) -> Path:
    """A bag of a camera and an IMU on a base, and depth whose clock may be late."""
    writer = bags.Writer(root, "mcap")
    if tf:
        fixed = writer.tf(
            writer.transform("base_link", "color", (0.2, 0, 0), (0, 0, 0, 1)),
            writer.transform("base_link", "imu", (0, 0.1, 0), IMU_XYZW),
        )
        writer.write("/tf_static", fixed, bags.START)
    for i in range(bags.FRAMES):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", time), time + 1)
        late = time + depth_late_ns
        depth = writer.image(bags.millimetres(i), "16UC1", late)
        writer.write(bags.DEPTH, depth, late + 2)
    for k in range(20):
        time = bags.START + k * 10_000_000
        zero = np.zeros(9)
        message = writer.make(
            "sensor_msgs/msg/Imu",
            header=writer.header(time, frame),
            orientation=writer.quaternion((0, 0, 0, 1)),
            orientation_covariance=zero,
            angular_velocity=writer.vector(RATES),
            angular_velocity_covariance=zero,
            linear_acceleration=writer.vector((0, 0, 0)),
            linear_acceleration_covariance=zero,
        )
        for topic in (imu, "/other/imu"):
            if topic == imu or k % 2:
                writer.write(topic, message, time + 3)
    return writer.close()


@pytest.mark.parametrize(
    "topic", ["/imu/data", "/oak/imu/data", "/oak/imu", "/imu"]
)
def test_an_imu_is_used_whatever_its_topic_is_called(
    topic: str, tmp_path: Path
) -> None:
    path = robot(tmp_path, topic)
    sequence = open_sequence(path)
    assert sequence.topics.imu == topic
    assert f"IMU {topic}" in sequence.warnings[0]
    samples = sequence.imu(sequence.timestamps[0], sequence.timestamps[1])
    assert samples is not None
    turned = samples.rates[0] @ samples.R_cam_imu.T
    np.testing.assert_allclose(turned, (0, 0.3, 0), atol=1e-9)
    assert open_sequence(path, topic_imu="/other/imu").topics.imu == "/other/imu"
    said = refused(path, topic_imu=bags.RGB)
    assert "--topic-imu" in said and topic in said


def test_topics_names_the_gyroscope(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = robot(tmp_path, "/imu/data")
    assert main(["topics", str(path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["topics"]
    taken = {row["name"]: row["taken_for"] for row in rows}
    assert taken["/imu/data"] == "gyroscope" and taken["/other/imu"] == ""


def test_the_rotation_of_an_imu_without_transforms_is_stated(
    tmp_path: Path,
) -> None:
    path = robot(tmp_path, "/imu/data", frame="", tf=False)
    sequence = open_sequence(path)
    assert sequence.imu_samples is None
    assert "--imu-rotation" in " ".join(sequence.warnings)
    quarter = ",".join(str(value) for value in IMU_XYZW)
    sequence = open_sequence(path, imu_rotation=quarter)
    turned = sequence.imu(*sequence.timestamps[:2])
    assert turned is not None
    np.testing.assert_allclose(turned.R_cam_imu @ RATES, (0, 0.3, 0), atol=1e-9)
    # of the two quaternions of a rotation, the one that begins with a minus
    opposite = ",".join(str(-value) for value in (0.5, 0.5, -0.5, 0.5))
    args = build_parser().parse_args(["run", "x", "--imu-rotation", opposite])
    assert args.imu_rotation == opposite
    for wrong in ("0,0,0", "1,1,1,1", "a,b,c,d"):
        assert "x,y,z,w" in refused(path, imu_rotation=wrong)


@pytest.mark.parametrize("trust", [True, False])
def test_depth_of_a_late_clock_is_matched(trust: bool, tmp_path: Path) -> None:
    late_ms = 100.0
    path = robot(tmp_path, "/imu", depth_late_ns=int(1e6 * late_ms))
    sequence = open_sequence(path, depth_offset_ms=late_ms, trust=trust)
    assert len(sequence) == bags.FRAMES
    np.testing.assert_allclose(
        sequence.depth_timestamps, sequence.timestamps, atol=1e-6
    )
    for i in range(bags.FRAMES):
        np.testing.assert_allclose(sequence[i].depth, bags.millimetres(i) / 1000)
    assert sequence.opened_with()["depth_offset_ms"] == "100.0"
    # without it, three frames later
    assert len(open_sequence(path, trust=trust)) < bags.FRAMES


def test_the_path_of_the_base_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = robot(tmp_path, "/imu")
    T = np.eye(4)
    T[0, 3] = -0.2
    np.testing.assert_allclose(
        open_sequence(path, frame="/base_link").T_cam_frame, T
    )
    command = ["run", str(path), "-q", "--method", "identity", "--frame"]
    out = ["--out", str(tmp_path / "out")]
    assert (
        main([*(word for word in command if word != "-q"), "base_link", *out]) == 0
    )
    assert "path of" in capsys.readouterr().out
    said = refused(path, frame="map")
    assert "--frame map" in said and "'color'" in said and "base_link" in said
    assert main([*command, "map", "--out", str(tmp_path / "no")]) == 2
