"""Damaged, missing and odd files: FormatError with file and line, or a right frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridvo.core.errors import FormatError, InputError
from hybridvo.io.data.open import open_sequence
from tests import sequences as write

RELAXED = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
TINY = {
    kind: writer
    for kind, writer in write.WRITERS.items()
    if kind not in ("tum", "7scenes")
}  # those two are written at 640x480: enough for single tests, slow for properties
TEXT_FILES = [
    ("kitti", "calib.txt"),
    ("kitti", "times.txt"),
    ("kitti", "../../poses/07.txt"),
    ("folder", "camera.yaml"),
    ("folder", "poses.txt"),
    ("folder", "timestamps.txt"),
    ("tartanair-v1", "pose_left.txt"),
    ("tum", "rgb.txt"),
    ("tum", "depth.txt"),
    ("tum", "groundtruth.txt"),
    ("7scenes", "frame-000001.pose.txt"),
]
DAMAGE = st.binary(max_size=6) | st.sampled_from(
    [b"9" * 400, b"\n", b"\0", b": ", *b"nan inf - e999 [ * # , ../".split()]
)


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """A whole sequence of every kind."""
    root = tmp_path_factory.mktemp("originals")
    found = {
        kind: writer(root / kind).path for kind, writer in write.WRITERS.items()
    }
    write.text(found["folder"] / "timestamps.txt", "0.0\n0.25\n0.5\n")
    return found


def sane(root: Path, kind: str, index: int | None = None) -> None:
    """Open and read: nothing but an InputError that names a file or folder may come."""
    try:
        sequence = open_sequence(root, kind.split("-")[0])
        assert (np.diff(sequence.timestamps) > 0).all()
        assert sequence.poses is None or not np.isinf(sequence.poses).any()
        for i in range(len(sequence)) if index is None else [index]:
            frame = sequence[i]
            assert frame.depth is None or frame.depth.shape == frame.camera.shape
    except InputError as error:
        assert any(
            part in str(error) for part in (root.name, "07", "frame", str(root))
        )


@pytest.mark.parametrize(("kind", "name"), TEXT_FILES)
@RELAXED
@given(data=st.data())
def test_damaged_text_files(kind, name, originals, data):
    path = originals[kind] / name
    whole = path.read_bytes()
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 8))] = data.draw(DAMAGE)
    try:
        path.write_bytes(bytes(content))
        sane(originals[kind], kind, 0)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("kind", TINY)
@RELAXED
@given(data=st.data())
def test_damaged_binary_files(kind, originals, data):
    sequence = open_sequence(originals[kind])
    suffixes = (".png", ".npy", ".dpt", ".flo", ".cam")
    path = data.draw(
        st.sampled_from(
            [path for path in sequence.files() if path.suffix in suffixes]
        )
    )
    whole = path.read_bytes()
    content = bytearray(whole)
    at = data.draw(st.integers(0, len(content)))
    content[at : at + data.draw(st.integers(0, 8))] = data.draw(DAMAGE)
    try:
        path.write_bytes(bytes(content))
        sane(originals[kind], kind)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("kind", "name", "text", "line"),
    [
        ("tum", "groundtruth.txt", "# head\n1 2 3\n", 2),
        ("tum", "groundtruth.txt", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 x\n", 2),
        ("tum", "groundtruth.txt", "1 0 0 0 0 0 0 0\n", 1),  # no unit quaternion
        ("tum", "groundtruth.txt", "100 0 0 0 1e200 0 0 1e200\n", 1),
        ("tum", "rgb.txt", "100.0 rgb/0.png\nabc rgb/1.png\n", 2),
        ("tum", "rgb.txt", "100.0\n", 1),
        ("tartanair-v2", "pose_lcam_front.txt", "0 0 0 0 0 0 1\n0 0 0\n", 2),
        ("kitti", "calib.txt", "P2: 1 2\n", 1),
        ("kitti", "../../poses/07.txt", "0 0 0 0 0 0 0 0 0 0 0 0\n" * 3, 1),
        ("kitti", "times.txt", "0\n0.1\nx\n", 3),
        ("folder", "poses.txt", "0 1 2 3 0 0 0 1\n0.5 1 2 3 0 0 0\n", 2),
        ("folder", "timestamps.txt", "0\n0.5\n1.0 2\n", 3),
    ],
)
def test_damage_names_file_and_line(kind, name, text, line, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    (written.path / name).write_text(text)
    with pytest.raises(
        FormatError, match=rf"{Path(name).name}:{line}: .*expected.*got"
    ):
        open_sequence(written.path)


def test_a_matrix_that_is_no_projection_is_named(tmp_path):
    written = write.WRITERS["kitti"](tmp_path)
    (written.path / "calib.txt").write_text("P2: 20 0 4.5 5 0 0 2.5 0 0 0 1 0\n")
    with pytest.raises(FormatError, match=r"calib\.txt: P2: expected fx 0 cx"):
        open_sequence(written.path)


@pytest.mark.parametrize("kind", write.WRITERS)
def test_a_broken_frame_names_its_file_and_costs_itself_alone(kind, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    sequence = open_sequence(written.path)
    for path in (sequence.rgb_files[1], sequence.depth_files[2]):
        path.write_bytes(path.read_bytes()[:-30])
    for index, path in ((1, sequence.rgb_files[1]), (2, sequence.depth_files[2])):
        with pytest.raises(FormatError, match=path.name):
            sequence[index]
    reopened = open_sequence(written.path)
    assert len(reopened) == write.N and reopened[0].rgb is not None


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("kind", write.WRITERS)
def test_missing_depth_is_none_and_missing_both_raises(kind, index, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    sequence = open_sequence(written.path)
    sequence.depth_files[index].unlink()  # deleted during the run
    frame = sequence[index]
    assert frame.depth is None and frame.rgb is not None
    reopened = open_sequence(written.path)
    assert len(reopened) == write.N and reopened[index].depth is None
    assert any(
        "without depth" in told and f": {index}" in told
        for told in reopened.warnings
    )
    sequence.rgb_files[index].unlink()
    with pytest.raises(FileNotFoundError, match=f"frame {index}"):
        sequence[index]


def test_a_gap_keeps_its_time_and_has_no_flow(tmp_path):
    written = write.write_tartanair(tmp_path, 1)
    for folder in ("image_left", "depth_left"):
        next((written.path / folder).glob("000001*")).unlink()
    sequence = open_sequence(written.path)
    np.testing.assert_allclose(sequence.timestamps, [0.0, 0.2])
    assert any("frame numbers 1 are missing" in told for told in sequence.warnings)
    np.testing.assert_allclose(sequence.poses[1], written.poses[2], atol=1e-12)
    with pytest.raises(FileNotFoundError, match="no flow file"):
        sequence.flow(0)


def test_a_frame_of_another_size_is_refused_alone(tmp_path):
    sequence = open_sequence(write.write_kitti(tmp_path).path)
    write.png(sequence.rgb_files[1], write.image(0, 10, 6))  # turned by 90 degrees
    reopened = open_sequence(sequence.root)
    with pytest.raises(
        FormatError, match=r"000001\.png: expected 10x6 pixels.*6x10"
    ):
        reopened[1]
    assert reopened[2].rgb is not None


def test_tum_stamps_in_nanoseconds_and_without_a_value(tmp_path):
    seconds = open_sequence(write.write_tum(tmp_path / "s").path)
    written = write.write_tum(tmp_path / "ns", ns=True)
    for name in ("rgb.txt", "depth.txt"):
        path = written.path / name
        path.write_text(path.read_text() + "inf rgb/0.png\nnan rgb/1.png\n")
    epoch = open_sequence(written.path)
    np.testing.assert_allclose(
        epoch.timestamps, seconds.timestamps + 1.3e9, atol=1e-6
    )
    assert sum("nanoseconds" in told for told in epoch.warnings) == 3
    assert np.isfinite(epoch.poses).all()


def test_empty_and_single(tmp_path):
    for kind in ("sintel", "kitti", "folder", "tartanair-v2"):
        written = write.WRITERS[kind](tmp_path / kind)
        sequence = open_sequence(written.path)
        for path in (*sequence.rgb_files[1:], *sequence.depth_files[1:]):
            path.unlink()
        single = open_sequence(written.path)
        assert len(single) == 1 and single[0].depth is not None
        for path in (sequence.rgb_files[0], sequence.depth_files[0]):
            path.unlink()
        with pytest.raises(InputError, match="no frames"):
            open_sequence(written.path, sequence.kind)
    tum = write.write_tum(tmp_path)
    (tum.path / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="no frames"):
        open_sequence(tum.path)


def test_lost_tracking_is_a_nan_row_and_a_damaged_pose_is_refused(tmp_path):
    written = write.write_seven_scenes(tmp_path)
    (written.path / "frame-000001.pose.txt").write_text("inf " * 16)
    sequence = open_sequence(written.path)
    assert (
        np.isnan(sequence.poses[1]).all()
        and np.isfinite(sequence.poses[[0, 2]]).all()
    )
    (written.path / "frame-000002.pose.txt").write_text("1 2 3")
    with pytest.raises(FormatError, match=r"000002.*expected 16 numbers"):
        open_sequence(written.path)


def test_a_camera_file_of_no_use_costs_its_frame(tmp_path):
    written = write.write_sintel(tmp_path)
    cam = sorted((tmp_path / "training" / "camdata_left").rglob("*.cam"))[1]
    content = cam.read_bytes()
    # fx
    cam.write_bytes(content[:4] + np.array([1e300], "<f8").tobytes() + content[12:])
    assert np.isfinite(open_sequence(written.path).poses).all()
    with pytest.raises(FormatError, match=cam.name):
        open_sequence(written.path)[1]
    cam.write_bytes(content[:-8] + np.array([np.nan], "<f8").tobytes())  # pose
    with pytest.raises(FormatError, match=cam.name):
        open_sequence(written.path)


@pytest.mark.parametrize("kind", ["7scenes", "tum"])
def test_other_sizes_need_a_camera(kind, tmp_path):
    sequence = open_sequence(write.WRITERS[kind](tmp_path).path)
    for i in range(write.N):
        write.png(sequence.rgb_files[i], write.image(i, 6, 8))
        write.png(sequence.depth_files[i], np.full((6, 8), 1500, np.uint16))
    with pytest.raises(InputError, match=r"8x6.*640x480.*--camera"):
        open_sequence(sequence.root)
    frame = open_sequence(sequence.root, camera="8,8,3.5,2.5", depth_scale=1000)[1]
    assert frame.depth[0, 0] == 1.5 and frame.camera.shape == (6, 8)
