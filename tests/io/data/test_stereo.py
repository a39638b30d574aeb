"""Stereo: two cameras of one's own or of EuRoC's layout become one with depth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from hybridvo import InputError, evaluate, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.io.data.stereo import depth_from_disparity
from hybridvo.run.cli import main

HEIGHT = 120
WIDTH = 160
K_LEFT = np.array([[150.0, 0, 78.0], [0, 152.0, 61.0], [0, 0, 1]])
K_RIGHT = np.array([[148.0, 0, 81.0], [0, 149.0, 58.0], [0, 0, 1]])
D_LEFT = np.array([-0.2, 0.05, 0.001, -0.0005])
D_RIGHT = np.array([-0.18, 0.04, -0.0008, 0.0006])
DISTANCE = 1.5
"""Of a plane before the left camera, m."""


class Pair(NamedTuple):
    left: np.ndarray
    right: np.ndarray
    T_right_left: np.ndarray


def seen(K, D, T_left_camera: np.ndarray, fisheye: bool = False) -> np.ndarray:
    """The image of a plane with a random texture, from a camera with a lens. Ray by ray."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    pixels = np.dstack([columns, rows]).reshape(-1, 1, 2)
    opencv = cv2.fisheye if fisheye else cv2
    rays = opencv.undistortPoints(pixels, K, D).reshape(-1, 2)
    rays = np.column_stack([rays, np.ones(len(rays))]) @ T_left_camera[:3, :3].T
    start = T_left_camera[:3, 3]
    lengths = (DISTANCE - start[2]) / rays[:, 2]
    points = start + lengths[:, None] * rays
    noise = np.random.default_rng(1).integers(0, 256, (400, 400), dtype=np.uint8)
    texture = cv2.GaussianBlur(cv2.resize(noise, (1600, 1600)), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    # 4 m are 1600 px
    u, v = (400 * points[:, :2].T + 800).astype(np.float32)
    image = cv2.remap(texture, u, v, cv2.INTER_LINEAR)
    return image.reshape(HEIGHT, WIDTH)


def rendered(fisheye: bool = False) -> Pair:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(
        "xyz", (0.8, -1.2, 0.5), degrees=True
    ).as_matrix()
    T[:3, 3] = -0.1, 0.003, -0.004
    left = seen(K_LEFT, D_LEFT, np.eye(4), fisheye)
    right = seen(K_RIGHT, D_RIGHT, np.linalg.inv(T), fisheye)
    return Pair(left, right, T)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def numbers(K: np.ndarray) -> dict[str, float]:
    names = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {name: float(value) for name, value in names.items()}


def own_folder(root: Path, model: str = "plumb_bob", count: int = 3) -> Path:
    pair = rendered(model == "equidistant")
    for i in range(count):
        save(root / "left" / f"{i:06d}.png", pair.left)
        save(root / "right" / f"{i:06d}.png", pair.right)
    left = numbers(K_LEFT) | {"distortion": D_LEFT.tolist(), "model": model}
    right = numbers(K_RIGHT) | {"distortion": D_RIGHT.tolist(), "model": model}
    stereo = {
        "left": left,
        "right": right,
        "R_right_left": pair.T_right_left[:3, :3].tolist(),
        "t_right_left": pair.T_right_left[:3, 3].tolist(),
    }
    content = {"width": WIDTH, "height": HEIGHT, "fps": 20, "stereo": stereo}
    (root / "camera.yaml").write_text(yaml.safe_dump(content))
    return root


def plane_depth(sequence, R_rectified_left: np.ndarray) -> np.ndarray:
    """The true depth of the plane in the rectified view."""
    camera = sequence.camera(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.dstack(
        [
            (columns - camera.cx) / camera.fx,
            (rows - camera.cy) / camera.fy,
            np.ones((HEIGHT, WIDTH)),
        ]
    )
    return DISTANCE / (rays @ R_rectified_left)[:, :, 2]


def check_plane(sequence) -> None:
    frame = sequence[1]
    found = np.isfinite(frame.depth) & (frame.depth > 0)
    # the columns that only the left camera sees have none
    assert found.mean() > 0.85
    expected = plane_depth(sequence, sequence._rig.R_rectified_left)
    error = np.log(frame.depth[found] / expected[found])
    # block matching prefers whole pixels by up to 0.3 of one, of a disparity of ten
    assert abs(np.median(error)) < 0.03
    # its variance is stated: half a pixel of disparity
    stated = np.sqrt(frame.depth_variance[found])
    assert np.mean(np.abs(error) < 2 * stated) > 0.97
    baseline = np.linalg.norm([0.1, 0.003, 0.004])
    disparity = sequence.camera(0).fx * baseline / expected[found]
    ratio = stated * disparity / 0.5
    assert np.quantile(np.abs(ratio - 1), 0.99) < 0.1


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_plane_before_two_cameras_with_lenses(model: str, tmp_path: Path) -> None:
    sequence = open_sequence(own_folder(tmp_path / "mine", model))
    assert (sequence.kind, sequence.depth_source) == ("stereo", "stereo")
    np.testing.assert_allclose(sequence.timestamps, [0, 0.05, 0.1])
    check_plane(sequence)


def test_depth_and_variance_by_hand() -> None:
    disparity = np.float32([[20.0, 5.0, 0.0, -1.0]])
    depth, variance = depth_from_disparity(disparity, 10.0)
    np.testing.assert_allclose(depth, [[0.5, 2.0, 0.0, 0.0]])
    np.testing.assert_allclose(variance[0, :2], [0.025**2, 0.1**2])


# -- EuRoC -----------------------------------------------------------------------------------------

T_BODY_LEFT = np.array(
    [[0.0, 0, 1, 0.02], [-1, 0, 0, 0.05], [0, -1, 0, 0.01], [0, 0, 0, 1]]
)


def sensor_text(K: np.ndarray, D: np.ndarray, T: np.ndarray) -> str:
    data = ", ".join(str(float(value)) for value in T.reshape(-1))
    fx, fy, cx, cy = numbers(K).values()
    return f"""%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
rate_hz: 20
resolution: [{WIDTH}, {HEIGHT}]
camera_model: pinhole
intrinsics: [{fx}, {fy}, {cx}, {cy}] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {D.tolist()}
"""


def euroc_folder(root: Path, count: int = 3) -> Path:
    pair = rendered()
    places = {
        "cam0": (pair.left, K_LEFT, D_LEFT, T_BODY_LEFT),
        "cam1": (
            pair.right,
            K_RIGHT,
            D_RIGHT,
            T_BODY_LEFT @ np.linalg.inv(pair.T_right_left),
        ),
    }
    stamps = [1_403_715_274_312_143_104 + 50_000_000 * i for i in range(count)]
    for name, (image, K, D, T) in places.items():
        folder = root / "mav0" / name
        lines = ["#timestamp [ns],filename"]
        for stamp in stamps:
            save(folder / "data" / f"{stamp}.png", image)
            lines.append(f"{stamp},{stamp}.png")
        (folder / "data.csv").write_text("\r\n".join(lines) + "\r\n")
        (folder / "sensor.yaml").write_text(sensor_text(K, D, T))
    truth = root / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], ..."]
    for i, stamp in enumerate(stamps):
        rest = ",0.1" * 9
        rows.append(f"{stamp},{0.5 * i},2,3,1,0,0,0{rest}")
    (truth / "data.csv").write_text("\n".join(rows) + "\n")
    return root


def test_a_folder_of_euroc(tmp_path: Path) -> None:
    sequence = open_sequence(euroc_folder(tmp_path))
    assert (sequence.kind, len(sequence)) == ("euroc", 3)
    check_plane(sequence)
    # the body does not turn: the camera goes as it does, from its own place in it
    places = sequence.poses[:, :3, 3]
    np.testing.assert_allclose(places[0], [0.02, 2.05, 3.01])
    np.testing.assert_allclose(places[2] - places[0], [1.0, 0, 0], atol=1e-12)
    # and looks where the left camera looks, but for the rectification
    R = sequence.poses[0, :3, :3] @ sequence._rig.R_rectified_left
    np.testing.assert_allclose(R, T_BODY_LEFT[:3, :3], atol=1e-12)
    assert open_sequence(tmp_path / "mav0").kind == "euroc"


def test_a_right_image_that_is_missing_costs_its_frame(tmp_path: Path) -> None:
    root = euroc_folder(tmp_path)
    path = root / "mav0" / "cam1" / "data.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:2] + lines[3:]) + "\n")
    sequence = open_sequence(root)
    assert len(sequence) == 2
    assert any("1 left images have no right one" in w for w in sequence.warnings)


def test_a_calibration_of_kalibr(tmp_path: Path) -> None:
    root = euroc_folder(tmp_path / "a")
    pair = rendered()
    chain = {}
    for name, K, D in (("cam0", K_LEFT, D_LEFT), ("cam1", K_RIGHT, D_RIGHT)):
        chain[name] = {
            "camera_model": "pinhole",
            "distortion_coeffs": D.tolist(),
            "distortion_model": "radtan",
            "intrinsics": list(numbers(K).values()),
            "resolution": [WIDTH, HEIGHT],
        }
    chain["cam1"]["T_cn_cnm1"] = pair.T_right_left.tolist()
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(chain))
    for folder in ("cam0", "cam1"):
        (root / "mav0" / folder / "sensor.yaml").unlink()
    check_plane(open_sequence(root, camera=path))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stereo": {"baseline": -0.1}}, "baseline"),
        ({"stereo": {"left": {}}}, "left"),
        ({"stereo": None}, "expected 'stereo:'"),
        ({"t": [0, 0.1, 0]}, "to the right of the left one"),
        ({"t": None}, "stereo"),
        ({"R": np.zeros((3, 3)).tolist()}, "rigid"),
        ({"width": None}, "Camera.width"),
        ({"model": "omni"}, "distortion model 'omni'"),
    ],
)
def test_a_calibration_that_cannot_be_is_one_line(
    change: dict, words: str, tmp_path: Path
) -> None:
    root = own_folder(tmp_path, count=1)
    content = yaml.safe_load((root / "camera.yaml").read_text())
    stereo = content["stereo"]
    if "t" in change:
        stereo["t_right_left"] = change["t"]
    elif "R" in change:
        stereo["R_right_left"] = change["R"]
    elif "model" in change:
        stereo["right"]["model"] = change["model"]
    else:
        content |= change
    (root / "camera.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=words) as caught:
        open_sequence(root)
    assert "\n" not in str(caught.value)


def test_lists_that_are_damaged(tmp_path: Path) -> None:
    root = euroc_folder(tmp_path)
    path = root / "mav0" / "cam0" / "data.csv"
    path.write_text("#timestamp\nnow,1.png\n")
    with pytest.raises(FormatError, match=r"data\.csv:2: expected 'timestamp"):
        open_sequence(root)
    path.write_text("1" * 5000 + ",a.png\n")
    with pytest.raises(FormatError, match=r"data\.csv:1: expected 'timestamp"):
        open_sequence(root)
    path.write_text("1403715274312143104,../../../secret.png\n")
    with pytest.raises(FormatError, match="below the sequence's folder"):
        open_sequence(root)


def test_a_real_recording_of_euroc(shared_data: Path, tmp_path: Path) -> None:
    """A drone that all but stands: the path errs by less than a millimetre."""
    root = shared_data / "euroc_v1_01"
    out = tmp_path / "out"
    command = ["run", str(root), "--out", str(out), "--stop", "6", "-q"]
    assert main(command) == 0
    found = evaluate(out / "trajectory.tum", root / "cam0_poses.txt")
    assert found["matched"] == 6
    assert found["ate_rmse"] < 0.001


# -- --stereo --------------------------------------------------------------------------


def rectified(root: Path, camera: bool) -> Path:
    """Images of a plane at 2 m: 7 px at 140 px focal length and 0.1 m."""
    rng = np.random.default_rng(4)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (120, 200), np.uint8), (0, 0), 1.5)
    for i in range(2):
        save(root / "left" / f"{i}.png", wide[:, 20:180])
        save(root / "right" / f"{i}.png", wide[:, 27:187])
    if camera:
        text = (
            "fx: 140\nfy: 140\ncx: 80\ncy: 60\nwidth: 160\nheight: 120\nfps: 10\n"
        )
        (root / "camera.yaml").write_text(text)
    return root


@pytest.mark.parametrize("camera", [True, False])
def test_a_baseline_in_place_of_a_file(camera: bool, tmp_path: Path) -> None:
    root = rectified(tmp_path / "mine", camera)
    given = {} if camera else {"camera": "140,140,80,60"}
    sequence = open_sequence(root, stereo=0.1, **given)
    assert sequence.kind == "stereo"
    assert (sequence.camera(0).fx, sequence.camera(0).width) == (140, 160)
    np.testing.assert_allclose(sequence.timestamps[1], 0.1 if camera else 1 / 30)
    depth = sequence[0].depth
    assert np.mean(np.abs(depth[depth > 0] - 2.0) < 0.02) > 0.95
    assert sequence.opened_with()["baseline"] == 0.1


def test_stereo_where_the_sequence_states_its_baseline(
    tmp_path: Path, capsys
) -> None:
    root = euroc_folder(tmp_path / "euroc")
    assert len(open_sequence(root, stereo=True)) == 3
    with pytest.raises(InputError, match="states its own baseline"):
        open_sequence(root, stereo=0.1)
    mine = rectified(tmp_path / "mine", camera=False)
    with pytest.raises(InputError, match="--camera fx,fy,cx,cy"):
        open_sequence(mine, stereo=0.1)
    out = tmp_path / "out"
    command = ["convert", str(rectified(mine, camera=True)), str(out), "-q"]
    for words in (["--stereo", "wide"], ["--stereo", "-0.1"], ["--stereo"]):
        assert main([*command, *words]) == 2
    assert main([*command, "--stereo", "0.1"]) == 0
    assert open_sequence(out)[0].depth.max() > 0
    capsys.readouterr()
    # a sequence with depth of its own
    assert main(["convert", str(out), str(tmp_path / "b"), "--stereo"]) == 2
    assert "with depth of its own" in capsys.readouterr().err
    bent = (mine / "camera.yaml").read_text() + "distortion: [0.1, 0, 0, 0]\n"
    (mine / "camera.yaml").write_text(bent)
    with pytest.raises(InputError, match="the camera has distortion"):
        open_sequence(mine, stereo=0.1)
