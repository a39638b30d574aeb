"""KITTI raw, Virtual KITTI 2, OpenLORIS, RGB-D Scenes: trees in their formats, by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo import InputError, open_sequence
from hybridvo.io.data.published.kitti_raw import oxts_poses
from tests import sequences as write

HEIGHT = 48
WIDTH = 160


def texts(path: Path, lines: list[str]) -> None:
    write.text(path, "\n".join(lines) + "\n")


def damaged(root: Path, names: list[str], content: str = "one two 3\n") -> None:
    """Every file, damaged, is one line that names it."""
    for name in names:
        path = root / name
        before = path.read_bytes()
        for wrong in (content.encode(), b"\xff\xfe\x00"):
            path.write_bytes(wrong)
            with pytest.raises(InputError, match=path.name) as caught:
                open_sequence(root)
            assert "\n" not in str(caught.value)
        path.write_bytes(before)


# -- KITTI raw -------------------------------------------------------------------------


def kitti_raw(day: Path, count: int = 3) -> Path:
    """A drive through a plane at 10 m: 12 px of disparity at 240 px and .5 m."""
    root = day / "2011_09_26_drive_0001_sync"
    rng = np.random.default_rng(4)
    noise = rng.integers(0, 256, (HEIGHT, WIDTH + 40), np.uint8)
    wide = cv2.GaussianBlur(noise, (0, 0), 1.5)
    for i in range(count):
        name = f"{i:010d}"
        write.png(root / "image_02" / "data" / f"{name}.png", wide[:, 20:180])
        write.png(root / "image_03" / "data" / f"{name}.png", wide[:, 32:192])
        # east by 1e-5 degrees at the equator: 6378137 m pi / 180 1e-5 = 1.1131949 m
        oxts = [0.0, 1e-5 * i, 100.0 + i, 0.0, 0.0, 0.0, *[0.5] * 24]
        texts(root / "oxts" / "data" / f"{name}.txt", [" ".join(map(str, oxts))])
    stamps = [f"2011-09-26 13:02:25.{964389445 + i}" for i in range(count)]
    stamps[1:] = [f"2011-09-26 13:02:{26 + i}.000000000" for i in range(count - 1)]
    for camera in ("image_02", "image_03"):
        texts(root / camera / "timestamps.txt", stamps)
    # cameras 2 and 3 stand 0.1 m and -0.4 m to the left of camera 0: P = K [I | place]
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    lines.append("R_rect_00: 1 0 0 0 1 0 0 0 1")
    for camera, place in (("02", 0.1), ("03", -0.4)):
        P = f"240 0 80 {240 * place} 0 240 24 0 0 0 1 0"
        lines += ["S_rect_" + camera + ": 160 48", "P_rect_" + camera + ": " + P]
    texts(day / "calib_cam_to_cam.txt", lines)
    # camera: x right, y down, z forward; laser and IMU: x forward, y left, z up
    turned = "R: 0 -1 0 0 0 -1 1 0 0"
    for name, R, T in (
        ("velo_to_cam", turned, "T: 0 -0.08 -0.27"),
        ("imu_to_velo", "R: 1 0 0 0 1 0 0 0 1", "T: -0.81 0.32 -0.8"),
    ):
        texts(day / f"calib_{name}.txt", ["calib_time: 15-Mar-2012", R, T])
    return root


def test_kitti_raw(tmp_path: Path) -> None:
    sequence = open_sequence(kitti_raw(tmp_path / "2011_09_26"))
    assert (sequence.kind, len(sequence)) == ("kitti-raw", 3)
    assert sequence.depth_source == "stereo"
    camera = sequence.camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (240, 240, 80, 24)
    steps = np.diff(sequence.timestamps)
    np.testing.assert_allclose(steps, [0.035610555, 1], atol=1e-6)
    # 2011-09-26 13:02:25 UTC
    assert int(sequence.timestamps[0]) == 1317042145
    frame = sequence[1]
    found = frame.depth > 0
    assert found.mean() > 0.6
    assert np.median(np.abs(frame.depth[found] - 10)) < 0.05
    assert np.isfinite(frame.depth_variance).all()
    # the car drives east, where it looks, and rises by a metre
    T = np.linalg.inv(sequence.poses[0]) @ sequence.poses[1]
    np.testing.assert_allclose(T[:3, 3], [0, -1, 1.1131949], atol=1e-6)
    # IMU to camera 2: forward -.81 - .27, left .32 and 0.1 to the right, up -.8 + .08
    place = sequence.poses[0][:3, 3]
    np.testing.assert_allclose(place, [1.08, -0.32 + 0.1, 0.72], atol=1e-9)
    names = {path.name for path in sequence.files()}
    assert {"calib_cam_to_cam.txt", "timestamps.txt", "0000000000.txt"} <= names


def test_oxts_by_hand() -> None:
    """At 60 degrees a degree of longitude is half as long, one of latitude is not."""
    step = 1e-5
    rows = np.zeros((3, 6))
    rows[:, 0] = 60
    rows[1, 1] = step
    rows[2, 0] += step
    rows[2, 5] = np.pi / 2  # looks north
    poses = oxts_poses(rows)
    metres = 6378137 * np.pi / 180 * step
    np.testing.assert_allclose(poses[1, :3, 3], [metres / 2, 0, 0], atol=1e-6)
    np.testing.assert_allclose(poses[2, :3, 3], [0, metres, 0], atol=1e-6)
    np.testing.assert_allclose(poses[2, :3, 0], [0, 1, 0], atol=1e-12)


def test_kitti_raw_that_is_not_whole(tmp_path: Path) -> None:
    day = tmp_path / "2011_09_26"
    root = kitti_raw(day)
    (root / "image_03" / "data" / "0000000001.png").unlink()
    (root / "oxts" / "data" / "0000000002.txt").unlink()
    sequence = open_sequence(root)
    assert len(sequence) == 2
    assert np.isnan(sequence.poses[1]).all()
    assert "1 left images have no right one" in sequence.warnings[0]
    (day / "calib_imu_to_velo.txt").unlink()
    sequence = open_sequence(root)
    assert sequence.poses is None
    assert "calib_imu_to_velo.txt is not there" in " ".join(sequence.warnings)
    kitti_raw(day)
    names = ["image_02/timestamps.txt", "oxts/data/0000000001.txt"]
    calibrations = [f"../calib_{n}.txt" for n in ("cam_to_cam", "velo_to_cam")]
    damaged(root, [*names, *calibrations])
    (day / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(InputError, match=r"calib_cam_to_cam.*calib\.zip"):
        open_sequence(root)
    for path in (root / "image_03" / "data").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="no frames"):
        open_sequence(root)


# -- Virtual KITTI 2 -------------------------------------------------------------------


def virtual_kitti(root: Path, archives: bool = False) -> Path:
    """Scene01/clone; with ``archives`` each of them in a folder of its own."""

    def at(archive: str) -> Path:
        above = root / f"vkitti_2.0.3_{archive}" if archives else root
        return above / "Scene01" / "clone"

    frames = at("rgb") / "frames"
    for i in range(3):
        image = write.image(i, 6, 9)
        path = frames / "rgb" / "Camera_0" / f"rgb_{i:05d}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
        centimetres = np.full((6, 9), 1234 + i, np.uint16)
        centimetres[0] = 65535  # the sky
        depth = at("depth") / "frames" / "depth" / "Camera_0"
        write.png(depth / f"depth_{i:05d}.png", centimetres)
    # red: 2 * 49151.25 / 65535 - 1 = .5 of 8 px; green: 0 is -1 of 5 px
    bgr = np.zeros((6, 9, 3), np.uint16)
    bgr[:, :] = 1, 0, 49151
    bgr[0, 0, 0] = 0
    for i in range(2):
        flow = at("forwardFlow") / "frames" / "forwardFlow" / "Camera_0"
        write.raw_png(flow / f"flow_{i:05d}.png", bgr)
    intrinsic = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    extrinsic = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 ... 0 0 0 1"]
    for i in range(3):
        for camera in (0, 1):
            intrinsic.append(f"{i} {camera} 725.0087 725.5 {4 + camera} 2.5")
            # world to camera: the camera stands at z = i
            row = f"1 0 0 {-camera} 0 1 0 0 0 0 1 {-i} 0 0 0 1"
            extrinsic.append(f"{i} {camera} {row}")
    texts(at("textgt") / "intrinsic.txt", intrinsic)
    texts(at("textgt") / "extrinsic.txt", extrinsic)
    return at("rgb")


@pytest.mark.parametrize("archives", [False, True])
def test_virtual_kitti(archives: bool, tmp_path: Path) -> None:
    sequence = open_sequence(virtual_kitti(tmp_path, archives))
    assert (sequence.kind, sequence.name) == ("vkitti2", "Scene01_clone")
    assert (sequence.depth_source, sequence.flow_is_true) == ("true", True)
    np.testing.assert_allclose(sequence.timestamps, [0, 0.1, 0.2])
    camera = sequence.camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (725.0087, 725.5, 4, 2.5)
    frame = sequence[1]
    np.testing.assert_allclose(frame.depth[1:], 12.35)
    assert (frame.depth[0] == 0).all()
    np.testing.assert_allclose(
        sequence.poses[:, :3, 3], [(0, 0, i) for i in range(3)]
    )
    flow, valid = sequence.flow(0)
    np.testing.assert_allclose(flow[1, 1], [4, -5], atol=1e-3)
    assert not valid[0, 0] and valid.sum() == 53
    assert "extrinsic.txt" in {path.name for path in sequence.files()}


def test_virtual_kitti_that_is_damaged(tmp_path: Path) -> None:
    root = virtual_kitti(tmp_path)
    damaged(root, ["intrinsic.txt", "extrinsic.txt"])
    texts(root / "intrinsic.txt", ["frame cameraID", ""])
    with pytest.raises(InputError, match="got no row"):
        open_sequence(root)
    (root / "intrinsic.txt").unlink()
    with pytest.raises(InputError, match=r"textgt.*--camera 725\.0087"):
        open_sequence(root)
    (root / "extrinsic.txt").unlink()
    assert open_sequence(root, camera="700,700,4,2").poses is None


# -- OpenLORIS -------------------------------------------------------------------------

SENSORS = """%YAML:1.0
---
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: 9
   height: 6
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 6.1145098876953125e+02, 4.25, 6.1148571777343750e+02,
          2.75 ]
   distortion_coefficients: !!opencv-matrix
      rows: 1
      cols: 5
      dt: d
      data: [ 0., 0., 0., 0., 0. ]
"""


def trans_matrix() -> str:
    """The robot carries the depth camera 0.9 m above the floor, colour 2 cm to its right."""
    # axes of the camera on the robot: x forward is its z, y left is its -x
    turned = "0., 0., 1., 0.2, -1., 0., 0., 0., 0., -1., 0., 0.9, 0., 0., 0., 1."
    beside = "1., 0., 0., 0.02, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1."
    text = "%YAML:1.0\n---\ntrans_matrix:\n"
    for parent, child, numbers in (
        ("base_link", "d400_depth_optical_frame", turned),
        ("d400_depth_optical_frame", "d400_color_optical_frame", beside),
    ):
        text += f"   -\n      parent_frame: {parent}\n      child_frame: {child}\n"
        text += (
            "      matrix: !!opencv-matrix\n         rows: 4\n         cols: 4\n"
        )
        text += f"         dt: d\n         data: [ {numbers} ]\n"
    return text


def openloris(root: Path) -> Path:
    colour: list[str] = []
    depth: list[str] = []
    truth = ["#Time px py pz qx qy qz qw"]
    for i in range(3):
        stamp = 1560000043.053843 + i / 30
        name = f"{stamp:.6f}.png"
        write.png(root / "color" / name, write.image(i, 6, 9))
        write.png(root / "aligned_depth" / name, np.full((6, 9), 2500, np.uint16))
        colour.append(f"{stamp:.6f} color/{name}")
        depth.append(f"{stamp:.6f} aligned_depth/{name}")
        truth.append(f"{stamp:.6f} {0.1 * i} 2 0 0 0 0 1")
    texts(root / "color.txt", colour)
    texts(root / "aligned_depth.txt", depth)
    texts(root / "groundtruth.txt", truth)
    write.text(root / "sensors.yaml", SENSORS)
    write.text(root / "trans_matrix.yaml", trans_matrix())
    return root


def test_openloris(tmp_path: Path) -> None:
    sequence = open_sequence(openloris(tmp_path / "office1-1"))
    assert (sequence.kind, len(sequence)) == ("openloris", 3)
    camera = sequence.camera(0)
    # fx cx fy cy is the order of the file
    assert (camera.cx, camera.cy) == (4.25, 2.75)
    assert (camera.fx, camera.fy) == (611.45098876953125, 611.4857177734375)
    assert (sequence[0].depth == 2.5).all()
    np.testing.assert_array_equal(sequence[2].rgb, write.image(2, 6, 9))
    np.testing.assert_allclose(sequence.poses[0][:3, 3], [0.2, 2 - 0.02, 0.9])
    # the robot drives along its x, where the camera looks
    T = np.linalg.inv(sequence.poses[0]) @ sequence.poses[2]
    np.testing.assert_allclose(T[:3, 3], [0, 0, 0.2], atol=1e-12)
    assert not sequence.assumed


def test_openloris_that_is_not_whole(tmp_path: Path) -> None:
    root = openloris(tmp_path / "office1-1")
    names = ["color.txt", "aligned_depth.txt", "groundtruth.txt", "sensors.yaml"]
    damaged(root, names, "one: two\n")
    damaged(root, ["trans_matrix.yaml"], "trans_matrix: [{matrix: {data: [1, 2]}}]")
    for distortion in ("[0.1, 0.2, 0.0]", "[a, b]"):
        text = SENSORS.replace("[ 0., 0., 0., 0., 0. ]", distortion)
        write.text(root / "sensors.yaml", text)
        with pytest.raises(InputError, match="distortion_coefficients"):
            open_sequence(root)
    (root / "sensors.yaml").unlink()
    with pytest.raises(InputError, match=r"sensors\.yaml.*--camera"):
        open_sequence(root)
    (root / "trans_matrix.yaml").unlink()
    sequence = open_sequence(root, camera="600,600,4,2.5")
    assert "taken as those of the camera" in sequence.assumed[0]
    (root / "color.txt").write_text("1560000043.05 ../secret.png\n")
    with pytest.raises(InputError, match="below the sequence's folder"):
        open_sequence(root, camera="600,600,4,2.5")


# -- RGB-D Scenes v2 -------------------------------------------------------------------


def rgbd_scene(root: Path) -> Path:
    scene = root / "imgs" / "scene_01"
    for i in range(3):
        write.png(scene / f"{i:05d}-color.png", write.image(i, 480, 640))
        depth = np.full((480, 640), 1500 + i, np.uint16)
        write.png(scene / f"{i:05d}-depth.png", depth)
    # w first: half a turn about z, then a quarter about y
    half = np.sqrt(0.5)
    rows = ["1 0 0 0 0 0 0", "0 0 0 1 1 2 3", f"{half} 0 {half} 0 0 0 1"]
    texts(root / "pc" / "01.pose", rows)
    return scene


def test_rgbd_scenes(tmp_path: Path) -> None:
    root = tmp_path / "rgbd-scenes-v2"
    sequence = open_sequence(rgbd_scene(root))
    assert (sequence.kind, len(sequence)) == ("rgbd-scenes", 3)
    camera = sequence.camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (570.3, 570.3, 320, 240)
    np.testing.assert_allclose(sequence[1].depth, 1.501)
    expected = [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(sequence.poses[1], expected, atol=1e-12)
    # z of the camera is x of the world
    np.testing.assert_allclose(sequence.poses[2][:3, 2], [1, 0, 0], atol=1e-12)
    assert "estimated from the same images" in " ".join(sequence.warnings)
    # as the two archives are unpacked, each into a folder of its name
    other = tmp_path / "two"
    (other / "rgbd-scenes-v2_pc" / root.name).mkdir(parents=True)
    (other / "rgbd-scenes-v2_imgs" / root.name).mkdir(parents=True)
    (root / "pc").rename(other / "rgbd-scenes-v2_pc" / root.name / "pc")
    scenes = other / "rgbd-scenes-v2_imgs" / root.name / "imgs"
    (root / "imgs").rename(scenes)
    apart = open_sequence(scenes / "scene_01")
    np.testing.assert_array_equal(apart.poses, sequence.poses)
    assert "01.pose" in {path.name for path in apart.files()}


def test_rgbd_scenes_that_are_damaged(tmp_path: Path) -> None:
    scene = rgbd_scene(tmp_path)
    damaged(scene, ["../../pc/01.pose"])
    damaged(scene, ["../../pc/01.pose"], "1 1 0 0 0 0 0\n")
    damaged(scene, ["../../pc/01.pose"], "\n")
    (tmp_path / "pc" / "01.pose").unlink()
    assert open_sequence(scene).poses is None
