"""Recordings of scanners, recorders and apps, as those write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hybridvo import InputError, open_sequence
from hybridvo.core.errors import FormatError
from tests import bags, captures
from tests import sequences as write

N = captures.FRAMES


def refused(path: Path, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        open_sequence(path, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert "\n" not in message and len(message) < 700
    return message


def metres(i: int) -> np.ndarray:
    return captures.millimetres(i).astype(np.float32) / np.float32(1000)


# -- ScanNet -------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["folder", "file", "file in a folder"])
def test_scannet_is_read(form: str, tmp_path: Path) -> None:
    if form == "folder":
        sequence = open_sequence(captures.scannet(tmp_path / "scene0000_00"))
        assert sequence.kind == "scannet"
    else:
        path = captures.sens(tmp_path / "scene" / "a.sens")
        sequence = open_sequence(path if form == "file" else path.parent)
        assert sequence.kind == "sens"
        np.testing.assert_allclose(np.diff(sequence.timestamps), 0.05)
    assert len(sequence) == N
    assert sequence.poses is not None
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(sequence.poses[i], write.pose(i), atol=1e-6)
        # colour of twice the size is made smaller to depth's
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == captures.K
        assert frame.rgb is not None and frame.rgb.shape == (*captures.SIZE, 3)
        assert abs(int(frame.rgb.mean()) - (40 + 30 * i)) <= 2
        np.testing.assert_allclose(frame.depth, metres(i))


def test_a_lost_pose_of_scannet_is_unknown(tmp_path: Path) -> None:
    root = captures.scannet(tmp_path)
    write.text(root / "pose" / "1.txt", captures.rows(np.full((4, 4), -np.inf)))
    poses = open_sequence(root).poses
    assert poses is not None
    assert np.isnan(poses[1]).all() and np.isfinite(poses[[0, 2]]).all()


def test_a_sens_file_that_was_cut_off_is_read_as_far_as_it_goes(
    tmp_path: Path,
) -> None:
    path = captures.sens(tmp_path / "a.sens")
    path.write_bytes(path.read_bytes()[:-200])
    sequence = open_sequence(path)
    assert len(sequence) == N - 1
    assert "cut off: 2 of 3 frames" in "".join(sequence.warnings)


def test_a_sens_file_whose_depth_unpacks_to_more_is_refused(tmp_path: Path) -> None:
    import struct
    import zlib

    path = tmp_path / "a.sens"
    bomb = zlib.compress(bytes(2**24))
    head = struct.pack("<16f4Q", *np.eye(4).reshape(-1), 1, 1, 0, len(bomb))
    path.write_bytes(captures.sens_head(1) + head + bomb)
    assert "truncated" in refused(path) or "got" in refused(path)


def test_stamps_of_a_sens_file_that_stand_still_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.sens"
    frames = b"".join(captures.sens_frame(i, stamp=0) for i in range(N))
    path.write_bytes(captures.sens_head() + frames)
    sequence = open_sequence(path)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30)
    assert "no time stamps" in "".join(sequence.warnings)


# -- color/, depth/ and intrinsics ---------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["camera_intrinsic.json", "intrinsic.json", "intrinsics.json"]
)
def test_what_open3d_records_is_read(name: str, tmp_path: Path) -> None:
    sequence = open_sequence(captures.recorder(tmp_path / "room", name))
    assert (sequence.kind, len(sequence)) == ("recorder", N)
    assert "1000 units per metre" in sequence.assumed[0]
    for i, frame in enumerate(sequence):
        np.testing.assert_array_equal(frame.rgb, write.image(i, *captures.SIZE))
        np.testing.assert_allclose(frame.depth, metres(i))
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == captures.K


def test_color_and_depth_without_a_camera(tmp_path: Path) -> None:
    root = captures.recorder(tmp_path / "room")
    (root / "camera_intrinsic.json").unlink()
    assert "--camera fx,fy,cx,cy" in refused(root)
    assert len(open_sequence(root, camera="40,40,15.5,11.5")) == N


# -- Replica -------------------------------------------------------------------------------------


def test_replica_is_read(tmp_path: Path) -> None:
    scene = captures.replica(tmp_path)
    sequence = open_sequence(scene)
    assert (sequence.kind, len(sequence)) == ("replica", N)
    assert sequence.depth_source == "true"
    assert sequence.poses is not None
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(sequence.poses[i], write.pose(i), atol=1e-12)
        np.testing.assert_allclose(frame.depth, metres(i), atol=2e-4)
        assert frame.camera.cx == captures.K[2]
    (tmp_path / "cam_params.json").unlink()
    assert "no cam_params.json" in refused(scene)
    given = open_sequence(scene, camera="40,40,15.5,11.5", depth_scale=6553.5)
    np.testing.assert_allclose(given[0].depth, metres(0), atol=2e-4)


# -- transforms.json -----------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["folder", "file"])
def test_transforms_of_nerfstudio_are_read(form: str, tmp_path: Path) -> None:
    root = captures.nerfstudio(tmp_path / "capture")
    path = root if form == "folder" else root / "transforms.json"
    sequence = open_sequence(path)
    assert (sequence.kind, len(sequence), sequence.name) == (
        "transforms",
        N,
        "capture",
    )
    assert sequence.poses is not None
    fx, _, cx, cy = captures.larger()
    for i, frame in enumerate(sequence):
        # OpenGL's axes became ours, and images are sorted by their names
        np.testing.assert_allclose(sequence.poses[i], write.pose(i), atol=1e-12)
        np.testing.assert_array_equal(frame.rgb, write.image(i, 48, 64))
        assert (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (
            fx + i,
            cx,
            cy,
        )
        # each pixel of depth is four of the frame
        enlarged = np.kron(metres(i), np.ones((2, 2), np.float32))
        np.testing.assert_allclose(frame.depth, enlarged)


def test_transforms_of_nerfcapture_are_read(tmp_path: Path) -> None:
    sequence = open_sequence(captures.nerfcapture(tmp_path))
    assert len(sequence) == N
    for i, frame in enumerate(sequence):
        np.testing.assert_array_equal(frame.rgb, write.image(i, *captures.SIZE))
        np.testing.assert_allclose(frame.depth, metres(i))
        assert frame.camera.cx == captures.K[2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": []}, "expected a JSON object with 'frames'"),
        ({"frames": [1]}, "expected a JSON object with 'frames'"),
        (
            {"frames": [{"file_path": "../../etc/passwd"}]},
            "below the sequence's folder",
        ),
        ({"frames": [{"file_path": 3}]}, "expected a name"),
        ({"frames": [{"file_path": "a.png"}]}, "no depth: no frame names any"),
    ],
)
def test_transforms_that_are_damaged(
    change: dict[str, object], words: str, tmp_path: Path
) -> None:
    root = captures.nerfcapture(tmp_path / "walk")
    path = root / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises((InputError, OSError), match=words):
        open_sequence(root)


# -- Azure Kinect --------------------------------------------------------------------------------


def test_a_recording_of_an_azure_kinect_is_read(tmp_path: Path) -> None:
    pytest.importorskip("av")
    sequence = open_sequence(captures.kinect(tmp_path / "desk.mkv"))
    assert (sequence.kind, len(sequence)) == ("kinect", N)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.033, atol=1e-6)
    # the sensor's numbers, cut to 1280x720 of 1280x960; depth has half the focal length
    camera = sequence.camera(0)
    assert camera.shape == (360, 640) and camera.fx == 320
    for i in (2, 0, 1):
        frame = sequence[i]
        assert (
            frame.rgb is not None and abs(int(frame.rgb.mean()) - 40 - 30 * i) <= 2
        )
        assert frame.depth is not None
        middle = frame.depth[180, 280:320]
        np.testing.assert_allclose(middle, 1 + 0.1 * i, atol=1e-6)


# -- 7-Scenes, TUM -------------------------------------------------------------------------------


def test_lists_of_durations_are_counted(tmp_path: Path) -> None:
    root = write.write_tum(tmp_path, "fr3_desk").path
    for name in ("rgb", "depth"):
        lines = (root / f"{name}.txt").read_text().splitlines()
        files = [line.split()[1] for line in lines if not line.startswith("#")]
        durations = (0.033, 0.017, 0.034)
        rows = [f"{d} {f}\n" for d, f in zip(durations, files, strict=True)]
        (root / f"{name}.txt").write_text("".join(rows))
    sequence = open_sequence(root)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30)
    assert "give --fps" in sequence.assumed[0]
    slow = open_sequence(root, fps=10)
    np.testing.assert_allclose(slow.timestamps, [0, 0.1, 0.2])
    # what the user states is not assumed
    assert slow.assumed == sequence.assumed[1:]
    with pytest.raises(InputError, match="fps"):
        open_sequence(root, fps=0)


# -- bags ----------------------------------------------------------------------------------------


def test_a_bag_without_depth_is_opened_for_a_network(tmp_path: Path) -> None:
    writer = bags.Writer(tmp_path, "mcap")
    writer.write(bags.INFO, writer.info(), bags.START)
    for i in range(4):
        image = writer.image(bags.rgb(i), "rgb8", bags.stamp(i))
        writer.write(bags.RGB, image, bags.stamp(i))
    path = writer.close()
    assert "predict it with --depth onnx:FILE" in refused(path)
    sequence = open_sequence(path, needs_depth=False)
    assert len(sequence) == 4
    np.testing.assert_array_equal(sequence[3].rgb, bags.rgb(3))
    assert sequence[3].depth is None


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "begin"),
    [
        (("rgb.txt", "depth/"), "of kind 'tum', without depth.txt"),
        (("calib.txt", "times.txt"), "of kind 'kitti', without image_2"),
        (("rgb/",), "not a layout that is read"),
    ],
)
def test_a_refusal_names_what_is_missing_of_a_layout(
    parts: tuple[str, ...], begin: str, tmp_path: Path
) -> None:
    root = tmp_path / "walk"
    for part in parts:
        path = root / part
        if part.endswith("/"):
            path.mkdir(parents=True)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
    assert refused(root).startswith(f"{root}: {begin}")


# -- true files ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "kind", "frames"),
    [
        ("scannet_sensreader", "scannet", 11),
        ("open3d_recorder", "recorder", 8),
        ("tum_durations", "tum", 9),
        ("azure_kinect/recording.mkv", "kinect", 1),
    ],
)
def test_true_recordings_of_devices_are_read(
    name: str, kind: str, frames: int, shared_data: Path
) -> None:
    if kind == "kinect":
        pytest.importorskip("av")
    path = shared_data / "devices" / name
    if not path.exists():
        pytest.skip(f"no {path}")
    sequence = open_sequence(path)
    assert (sequence.kind, len(sequence)) == (kind, frames)
    frame = sequence[0]
    assert frame.rgb is not None and frame.depth is not None
    assert 0.1 < np.median(frame.depth[frame.depth > 0]) < 5


def test_the_cameras_of_an_azure_kinect_are_those_of_its_mode() -> None:
    from hybridvo.io.data.captures.kinect import calibration_of

    content = captures.kinect_calibration()
    colour, depth, T = calibration_of(content, (1280, 720), (640, 576), "a")
    assert colour.camera.fx == 640.0 and colour.camera.fy == 480.0
    assert (colour.camera.cx, colour.camera.cy) == (639.5, 359.5)
    assert (depth.camera.fx, depth.camera.cx) == (512.0, 319.5)
    assert depth.camera.cy == 331.5
    assert depth.distortion[0] == 0.01 and colour.is_straight
    np.testing.assert_allclose(T[:3, 3], [-0.1, 0, 0])
    with pytest.raises(FormatError, match="of no mode"):
        calibration_of(content, (1280, 721), (640, 576), "a")


def test_the_first_sequence_of_a_scene_of_7scenes(tmp_path: Path) -> None:
    written = write.write_seven_scenes(tmp_path)
    scene = written.path.parent
    sequence = open_sequence(scene)
    assert sequence.kind == "7scenes" and len(sequence) == write.N
    assert sequence.name == open_sequence(written.path).name
    (scene / "seq-99").mkdir()
    warnings = " ".join(open_sequence(scene).warnings)
    assert "of the scene is read; it also has seq-99" in warnings
