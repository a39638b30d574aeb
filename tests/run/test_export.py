"""``hybridvo run --export``: what other programs read, read back by small parsers."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from hybridvo import Camera, Frame, open_sequence
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.io.masks import mask_of
from hybridvo.run.cli import main
from hybridvo.run.commands.export.colmap import write_colmap
from hybridvo.run.commands.export.euroc import write_euroc
from hybridvo.run.commands.export.run_export import RunExport
from hybridvo.run.commands.export.transforms import write_transforms
from hybridvo.run.commands.export.views import ColouredPoints, PosedImage, points_of
from hybridvo.tracking.depth_scale import scale_factors

CAMERA = Camera(fx=100.0, fy=110.0, cx=31.5, cy=23.5, height=48, width=64)
TURNED = np.array([[0.0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])
"""A camera at (1, 2, 3) that is turned by a quarter about y: it looks along the world's x."""
TWO = ColouredPoints(
    np.array([[1.5, -2, 3], [0, 0, 1]]), np.uint8([[255, 0, 9], [1, 2, 3]])
)


class Image(NamedTuple):
    name: str
    camera: int
    wxyz: list[float]
    t: list[float]

    @property
    def T_cam_world(self) -> np.ndarray:
        """By the formula of COLMAP's documentation, written out."""
        w, x, y, z = self.wxyz
        T = np.eye(4)
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = self.t
        return T


class Model(NamedTuple):
    cameras: dict[int, tuple]
    images: list[Image]
    points: list[list[float]]


def lines_of(path: Path) -> list[str]:
    lines = path.read_text().split("\n")
    assert lines.pop() == ""
    return [line for line in lines if not line.startswith("#")]


def read_colmap(folder: Path) -> Model:
    cameras: dict[int, tuple] = {}
    for line in lines_of(folder / "cameras.txt"):
        number, model, width, height, *values = line.split()
        numbers = [float(value) for value in values]
        cameras[int(number)] = (model, int(width), int(height), *numbers)
    lines = lines_of(folder / "images.txt")
    # every second line holds the points of an image
    assert len(lines) % 2 == 0 and not any(lines[1::2])
    images = []
    for k, line in enumerate(lines[::2], start=1):
        number, *values, camera, name = line.split()
        assert int(number) == k
        pose = [float(value) for value in values]
        images.append(Image(name, int(camera), pose[:4], pose[4:]))
    points = [
        [float(word) for word in line.split()]
        for line in lines_of(folder / "points3D.txt")
    ]
    return Model(cameras, images, points)


# -- conventions, by hand --------------------------------------------------------------


def test_colmap_by_hand(tmp_path: Path) -> None:
    """World to camera: R^T = a quarter about -y, and -R^T (1, 2, 3) = (3, -2, -1)."""
    other = Camera(fx=50.0, fy=50.0, cx=15.5, cy=11.5, height=24, width=32)
    views = [
        PosedImage("a.png", CAMERA, np.eye(4)),
        PosedImage("b.png", CAMERA, TURNED),
        PosedImage("c.png", other, np.eye(4)),
    ]
    write_colmap(tmp_path, views, TWO)
    model = read_colmap(tmp_path)
    # the corner of the first pixel is (0, 0): half a pixel more than here
    assert model.cameras[1] == ("PINHOLE", 64, 48, 100, 110, 32, 24)
    assert model.cameras[2] == ("PINHOLE", 32, 24, 50, 50, 16, 12)
    first, second, third = model.images
    assert (first.wxyz, first.t) == ([1, 0, 0, 0], [0, 0, 0])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(second.wxyz, [half, 0, -half, 0], atol=1e-15)
    np.testing.assert_allclose(second.t, [3, -2, -1], atol=1e-15)
    # a point one metre before the camera, along the world's x
    seen = second.T_cam_world @ [2, 2, 3, 1]
    np.testing.assert_allclose(seen, [0, 0, 1, 1], atol=1e-12)
    assert [image.camera for image in model.images] == [1, 1, 2]
    assert [image.name for image in model.images] == ["a.png", "b.png", "c.png"]
    assert third.wxyz == [1, 0, 0, 0]
    # number, place, colour, error
    assert model.points == [[1, 1.5, -2, 3, 255, 0, 9, 0], [2, 0, 0, 1, 1, 2, 3, 0]]


def test_transforms_by_hand(tmp_path: Path) -> None:
    """Camera to world; the camera's x is right, y up, z backward."""
    views = [
        PosedImage("a.png", CAMERA, np.eye(4)),
        PosedImage("b.png", CAMERA, TURNED),
    ]
    write_transforms(tmp_path, views, TWO, "images", "masks")
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (content["fl_x"], content["fl_y"]) == (100, 110)
    assert (content["cx"], content["cy"]) == (32, 24)
    assert (content["w"], content["h"]) == (64, 48)
    first, second = content["frames"]
    assert first["file_path"] == "images/a.png"
    assert first["mask_path"] == "masks/a.png.png"
    assert first["transform_matrix"] == np.diag([1.0, -1, -1, 1]).tolist()
    T = np.array(second["transform_matrix"])
    # right is the world's -z, up its -y, backward its -x
    expected = [[0, 0, -1, 1], [0, -1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_array_equal(T, expected)
    np.testing.assert_array_equal(T @ [0, 0, -1, 1], [2, 2, 3, 1])
    cloud = (tmp_path / content["ply_file_path"]).read_text().splitlines()
    assert cloud[:3] == ["ply", "format ascii 1.0", "element vertex 2"]
    assert cloud[-2:] == ["1.5 -2 3 255 0 9", "0 0 1 1 2 3"]
    # cameras that differ stand beside their frames
    other = Camera(fx=50.0, fy=50.0, cx=15.5, cy=11.5, height=24, width=32)
    views.append(PosedImage("c.png", other, np.eye(4)))
    write_transforms(tmp_path, views, ColouredPoints.joined([]), "images", "masks")
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert "fl_x" not in content and "ply_file_path" not in content
    assert [frame["fl_x"] for frame in content["frames"]] == [100, 100, 50]


def test_euroc_by_hand(tmp_path: Path) -> None:
    stamps = np.array([1403715274.312143104, 1403715275.5])
    path = tmp_path / "euroc.csv"
    write_euroc(path, Trajectory(stamps, np.stack([np.eye(4), TURNED])))
    header, first, second = path.read_text().splitlines()
    assert header.startswith("#timestamp [ns],p_RS_R_x [m]")
    words = first.split(",")
    # doubles resolve a quarter of a microsecond there
    assert abs(int(words[0]) - 1403715274312143104) < 300
    assert [float(word) for word in words[1:]] == [0, 0, 0, 1, 0, 0, 0]
    values = [float(word) for word in second.split(",")]
    assert values[:4] == [1403715275.5e9, 1, 2, 3]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(values[4:], [half, 0, half, 0], atol=1e-15)


def test_evo_reads_euroc(tmp_path: Path) -> None:
    files = pytest.importorskip("evo.tools.file_interface")
    path = tmp_path / "euroc.csv"
    write_euroc(
        path, Trajectory(np.array([1.0, 2.5]), np.stack([np.eye(4), TURNED]))
    )
    found = files.read_euroc_csv_trajectory(str(path))
    np.testing.assert_allclose(found.timestamps, [1, 2.5])
    np.testing.assert_allclose(found.poses_se3[1], TURNED, atol=1e-12)


def test_masks_by_hand() -> None:
    """A square of small weights moves; single ones are noise, and no depth is no reason."""
    depth = np.full((96, 128), 2.0, np.float32)
    depth[:, 100:] = 0
    weights = np.ones((96, 128), np.float32)
    weights[::4, ::4] = 0
    weights[30:60, 20:60] = 0
    weights[:, 100:] = 0
    camera = Camera(100.0, 100.0, 63.5, 47.5, height=96, width=128)
    own = np.full((96, 128), True)
    own[:5] = False
    frame = Frame(None, depth, camera, mask=own)
    mask = mask_of(frame, weights)
    assert not mask[32:58, 22:58].any() and not mask[:5].any()
    mask[28:62, 18:62] = True
    assert mask[5:].all()
    assert mask_of(frame, None)[5:].all()


def test_points_by_hand() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, :] = 1, 2, 3
    mask = np.full((48, 64), False)
    mask[23, [31, 41]] = True
    found = points_of(Frame(rgb, depth, CAMERA), mask, TURNED, 10)
    # 0.5 px left of and above the centre: x = -.5 / 100 * 2; 9.5 px right of it
    expected = [[3, 2 - 1 / 110, 3 + 0.01], [3, 2 - 1 / 110, 3 - 0.19]]
    np.testing.assert_allclose(found.xyz, expected, atol=1e-6)
    np.testing.assert_array_equal(found.rgb, [[1, 2, 3]] * 2)


# -- a run -----------------------------------------------------------------------------


def run(sequence: Path, out: Path, *options: str) -> int:
    given = ["--method", "classical", "--flow", "file", "-q"]
    return main(["run", str(sequence), "--out", str(out), *given, *options])


def check(out: Path, sequence: Path) -> Model:
    """The export of a run of six frames fits to its other files."""
    root = out / "export"
    poses = read_trajectory(out / "trajectory.tum").T_world_cam
    names = [f"{i:06d}.png" for i in range(6)]
    assert sorted(path.name for path in (root / "images").iterdir()) == names
    masks = sorted(path.name for path in (root / "masks").iterdir())
    assert masks == [f"{name}.png" for name in names]
    model = read_colmap(root / "sparse" / "0")
    assert [image.name for image in model.images] == names
    content = json.loads((root / "transforms.json").read_text())
    truth = open_sequence(sequence)
    for i, image in enumerate(model.images):
        expected = np.linalg.inv(poses[i])
        np.testing.assert_allclose(image.T_cam_world, expected, atol=1e-9)
        frame = content["frames"][i]
        T = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(T, poses[i], atol=1e-12)
        bgr = cv2.imread(str(root / frame["file_path"]))
        np.testing.assert_array_equal(bgr[:, :, ::-1], truth[i].rgb)
        mask = cv2.imread(str(root / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert mask.shape == truth[i].camera.shape
        assert set(np.unique(mask)) <= {0, 255}
        # nothing moves there
        assert (mask == 255).mean() > 0.8
    return model


@pytest.mark.slow
def test_a_run_is_exported(dataset: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    kinds = "colmap,transforms,euroc,g2o"
    assert run(dataset, out, "--export", kinds, "--json") == 0
    summary = json.loads(capsys.readouterr().out)["export"]
    assert (summary["images"], summary["left_out"]) == (6, 0)
    model = check(out, dataset)
    assert len(model.points) == summary["points"] > 10_000
    # points that are seen lie where depth has them
    frame = open_sequence(dataset)[0]
    points = np.array([row[1:4] for row in model.points[:500]])
    u = frame.camera.fx * points[:, 0] / points[:, 2] + frame.camera.cx
    v = frame.camera.fy * points[:, 1] / points[:, 2] + frame.camera.cy
    depth = frame.depth[np.rint(v).astype(int), np.rint(u).astype(int)]
    np.testing.assert_allclose(points[:, 2], depth, rtol=1e-4)
    rows = (out / "export" / "euroc.csv").read_text().splitlines()
    assert len(rows) == 7
    graph = (out / "export" / "graph.g2o").read_text().splitlines()
    assert [line.split()[0] for line in graph] == [
        *["VERTEX_SE3:QUAT"] * 6,
        "FIX",
        *["EDGE_SE3:QUAT"] * 5,
    ]
    # the path that the motions lead along
    poses = read_trajectory(out / "trajectory.tum").T_world_cam
    for line in graph[7:]:
        start, end, *numbers = line.split()[1:]
        T_start_end = invert(poses[int(start)]) @ poses[int(end)]
        moved = [float(number) for number in numbers[:3]]
        np.testing.assert_allclose(moved, T_start_end[:3, 3], atol=1e-8)


def test_the_graph_of_depth_with_a_scale_of_its_own(tmp_path: Path) -> None:
    """Its motions are as long as those of the path, and as uncertain."""
    scales = np.array([1.0, 1.2, 0.9])
    changes = np.array([1.0, 1.1, 1.0])
    factors = scale_factors(scales, changes)
    assert factors[1] != 1
    ahead = se3_exp(np.array([0, 0, -1.0, 0, 0, 0]))
    columns = {
        "index": np.arange(3),
        "edge_start": np.array([0, 0, 1]),
        "T_curr_start": np.stack([np.eye(4), ahead, ahead]),
        "edge_covariance": np.stack([np.eye(6)] * 3),
        "depth_scale": scales,
        "scale_change": changes,
        "status": np.array(["ok"] * 3),
    }
    np.savez(tmp_path / "steps.npz", **columns)
    path = Trajectory(np.arange(3.0), np.stack([np.eye(4)] * 3))
    path.save(tmp_path / "trajectory.tum")
    sequence = SimpleNamespace(T_cam_frame=None)
    RunExport(tmp_path, ["g2o"], sequence, "new").finish()
    lines = (tmp_path / "export" / "graph.g2o").read_text().splitlines()
    for line, factor in zip(lines[4:], factors[1:], strict=True):
        numbers = [float(number) for number in line.split()[3:]]
        np.testing.assert_allclose(numbers[:3], [0, 0, factor], atol=1e-12)
        diagonal = np.array(numbers[7:])[[0, 15]]
        np.testing.assert_allclose(diagonal, [1 / factor**2, 4.0])


def test_what_is_exported_is_the_cameras_path(tmp_path: Path) -> None:
    """Also where the path of another frame was asked for, such as the robot's base."""
    T_cam_frame = se3_exp(np.array([0.1, 0, -0.3, 0, 0.5, 0]))
    camera = Trajectory(np.arange(2.0), np.stack([np.eye(4), TURNED]))
    camera.of_frame(T_cam_frame).save(tmp_path / "trajectory.tum")
    sequence = SimpleNamespace(T_cam_frame=T_cam_frame)
    RunExport(tmp_path, ["euroc"], sequence, "new").finish()
    last = (tmp_path / "export" / "euroc.csv").read_text().splitlines()[-1]
    place = [float(number) for number in last.split(",")[1:4]]
    np.testing.assert_allclose(place, TURNED[:3, 3], atol=1e-6)


@pytest.mark.slow
def test_resume_and_overwrite(dataset: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(dataset, out, "--stop", "6") == 0
    # a finished run is exported afterwards, without masks of what moves
    assert (
        run(
            dataset, out, "--stop", "6", "--resume", "--export", "colmap,transforms"
        )
        == 0
    )
    check(out, dataset)
    # what is not ours stays
    (out / "export" / "notes.txt").write_text("mine")
    assert (
        run(dataset, out, "--stop", "3", "--overwrite", "--export", "colmap") == 0
    )
    left = {path.name for path in (out / "export").rglob("*") if path.is_file()}
    assert "000005.png" not in left and "transforms.json" not in left
    assert {"000002.png", "000002.png.png", "images.txt", "notes.txt"} <= left
    # an old export does not outlive the run that it was of
    assert run(dataset, out, "--stop", "2", "--overwrite") == 0
    left = {path.name for path in (out / "export").rglob("*") if path.is_file()}
    assert left == {"notes.txt"}


def test_what_cannot_be_exported(dataset: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(dataset, out, "--export", "colmap,ply") == 2
    text = "--export ply: expected some of colmap, transforms, euroc"
    assert text in capsys.readouterr().err
    assert not out.exists()
    (out / "export").mkdir(parents=True)
    (out / "export" / "transforms.json").write_text("{}")
    assert run(dataset, out, "--export", "colmap") == 2
    assert "holds an export (transforms.json)" in capsys.readouterr().err


@pytest.mark.slow
def test_frames_that_failed_are_left_out(own: Path, tmp_path: Path, capsys) -> None:
    """A frame without a file has no pose of its own, and no image."""
    for folder in ("clean", "depth"):
        ending = "png" if folder == "clean" else "dpt"
        path = own.parents[1] / folder / own.name / f"frame_0003.{ending}"
        path.write_bytes(b"damaged")
    out = tmp_path / "out"
    options = ["--export", "colmap,euroc", "--max-failed", "1", "--json"]
    words = ["run", str(own), "--out", str(out), "--method", "classical", "-q"]
    assert main([*words, *options]) == 0
    summary = json.loads(capsys.readouterr().out)["export"]
    assert (summary["images"], summary["left_out"]) == (5, 1)
    model = read_colmap(out / "export" / "sparse" / "0")
    assert [image.name for image in model.images] == [
        f"{i:06d}.png" for i in (0, 1, 3, 4, 5)
    ]
    assert len((out / "export" / "euroc.csv").read_text().splitlines()) == 7
