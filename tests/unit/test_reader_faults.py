"""What a user gets when the files are wrong: faults F5 and F15 to F27, F36, F41 of the matrix."""

from __future__ import annotations

import os

import numpy as np
import pytest
import sequences as write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hybridvo.data.sequence import iter_pairs, open_sequence
from hybridvo.errors import FormatError, InputError
from hybridvo.flow import FlowField
from hybridvo.types import Camera

TINY = {k: w for k, w in write.WRITERS.items() if k not in ("tum", "7scenes")}


def edit(path, old, new):
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new))


# F15: intrinsics
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fx: 20.0", "fx: 0", "fx: expected a positive"),
        ("fx: 20.0", "fx: -3", "fx: expected a positive"),
        ("fx: 20.0", "fx: .nan", "fx: expected a positive finite"),
        ("fx: 20.0", "fx: 1" + "0" * 400, "fx: expected a positive finite"),
        ("cx: 4.5", "cx: 400", "far outside"),
        ("width: 10", "width: 11", "camera.yaml says 11x6"),
        ("width: 10", "width: 10.5", "whole number"),
        ("fy: 21.0", "fy: [1, 2]", "expected a number, got a list"),
        ("cx: 4.5\n", "", "missing: cx"),
    ],
)
def test_bad_intrinsics(old, new, message, tmp_path):
    written = write.write_folder(tmp_path)
    edit(written.path / "camera.yaml", old, new)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(written.path)
    assert "mine" in str(caught.value)


def test_bad_sintel_and_kitti_cameras(tmp_path):
    written = write.write_sintel(tmp_path)
    cam = tmp_path / "training" / "camdata_left" / "alley_9" / "frame_0002.cam"
    data = bytearray(cam.read_bytes())
    data[4:12] = np.float64(-5).tobytes()  # fx
    cam.write_bytes(bytes(data))
    sequence = open_sequence(written.path)
    with pytest.raises(FormatError, match=r"frame_0002\.cam.*fx"):
        sequence.frame(1)
    assert sequence.frame(2).camera.fx == 12.0
    kitti = write.write_kitti(tmp_path)
    edit(kitti.path / "calib.txt", "P2: 20", "P2: nan")
    with pytest.raises(FormatError, match=r"calib\.txt:3"):
        open_sequence(kitti.path)


# F16: mixed resolutions
@pytest.mark.parametrize("kind", TINY)
def test_first_frame_of_another_size_is_named(kind, tmp_path):
    written = TINY[kind](tmp_path)
    files = open_sequence(written.path).rgb_files
    write.png(files[2], write.image(0, 3, 4))
    with pytest.raises(InputError, match="frame 2 is 4x3") as caught:
        open_sequence(written.path)
    assert files[2].name in str(caught.value)


def test_depth_and_flow_of_another_size(tmp_path):
    written = write.write_sintel(tmp_path)
    sequence = open_sequence(written.path)
    write.tagged(sequence.depth_files[1], np.ones((2, 3), np.float32))
    write.tagged(sequence.flow_files[0], np.ones((2, 3, 2), np.float32))
    with pytest.raises(InputError, match=r"frame 1 .*expected 8x5 .*got 3x2"):
        sequence.frame(1)
    with pytest.raises(FormatError, match="expected flow of 8x5"):
        sequence.flow(0)


# F17: gaps, missing files, and F41: deletion during a run
@pytest.mark.parametrize("kind", write.WRITERS)
@pytest.mark.parametrize("index", [0, 1, 2])
def test_missing_depth_is_none(kind, index, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    sequence = open_sequence(written.path)
    sequence.depth_files[index].unlink()  # deleted during the run
    frame = sequence.frame(index)
    assert frame.depth is None and frame.rgb is not None
    reopened = open_sequence(written.path)
    assert len(reopened) == write.N
    assert reopened.frame(index).depth is None
    assert any("without depth" in n and f": {index}." in n for n in reopened.notices)


@pytest.mark.parametrize("kind", ["sintel", "tartanair-v1", "tartanair-v2", "tum", "7scenes"])
def test_missing_image_is_none_and_missing_both_raises(kind, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    open_sequence(written.path).rgb_files[1].unlink()
    sequence = open_sequence(written.path)
    assert len(sequence) == write.N
    assert sequence.frame(1).rgb is None and sequence.frame(1).depth is not None
    sequence.depth_files[1].unlink()
    with pytest.raises(FileNotFoundError, match="frame 1"):
        sequence.frame(1)


def test_a_gap_keeps_its_time_and_has_no_flow(tmp_path):
    written = write.write_tartanair(tmp_path, 1)
    for folder in ("image_left", "depth_left"):
        next((written.path / folder).glob("000001*")).unlink()
    sequence = open_sequence(written.path)
    np.testing.assert_allclose(sequence.timestamps, [0.0, 0.2])
    assert any("frame numbers 1 are missing" in n for n in sequence.notices)
    np.testing.assert_allclose(sequence.poses[1], written.poses[2], atol=1e-12)
    with pytest.raises(FileNotFoundError, match="no flow file"):
        sequence.flow(0)


def test_tum_leaves_out_colour_without_depth(tmp_path):
    written = write.write_tum(tmp_path)
    lines = (written.path / "depth.txt").read_text().splitlines()
    (written.path / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    sequence = open_sequence(written.path)
    assert len(sequence) == 2
    assert any("1 of 3 colour images have no depth" in n for n in sequence.notices)
    kept = open_sequence(written.path, keep_unmatched=True)
    assert len(kept) == 3 and kept.frame(1).depth is None


# F18: stamps
def test_nanoseconds_are_converted(tmp_path):
    seconds = open_sequence(write.write_tum(tmp_path / "s").path)
    epoch = open_sequence(write.write_tum(tmp_path / "ns", ns=True).path)
    np.testing.assert_allclose(epoch.timestamps, seconds.timestamps + 1.3e9, atol=1e-6)
    assert sum("nanoseconds" in n for n in epoch.notices) == 3
    assert np.isfinite(epoch.poses).all()


@pytest.mark.parametrize("change", ["swap", "duplicate", "nan"])
def test_stamps_must_increase(change, tmp_path):
    written = write.write_tum(tmp_path)
    path = written.path / "rgb.txt"
    lines = path.read_text().splitlines()
    if change == "swap":
        lines[1], lines[2] = lines[2], lines[1]
    elif change == "duplicate":
        lines[2] = lines[1]
    else:
        lines[2] = "nan rgb/1.png"
    path.write_text("\n".join(lines))
    if change == "nan":  # has no depth partner: left out, and said
        assert any("left out" in n for n in open_sequence(written.path).notices)
        with pytest.raises(InputError, match="not finite"):
            open_sequence(written.path, keep_unmatched=True)
    else:
        with pytest.raises(InputError, match="must increase"):
            open_sequence(written.path)
    kitti = write.write_kitti(tmp_path)
    (kitti.path / "times.txt").write_text("0\n0.2\n0.1\n")
    with pytest.raises(InputError, match="must increase: frame 1"):
        open_sequence(kitti.path)


# F19: natural order is what test_readers checks with f8, f9, f10; the order is told
def test_order_is_told(tmp_path):
    notices = open_sequence(write.write_folder(tmp_path).path).notices
    assert any("natural order, f8.png to f10.png" in n for n in notices)


# F20, F21: none and one
def test_empty_and_single(tmp_path):
    for kind in ("sintel", "kitti", "folder", "tartanair-v2"):
        written = write.WRITERS[kind](tmp_path / kind)
        sequence = open_sequence(written.path)
        for path in (*sequence.rgb_files[1:], *sequence.depth_files[1:]):
            path.unlink()
        single = open_sequence(written.path)
        assert len(single) == 1 and single.frame(0).depth is not None
        for path in (sequence.rgb_files[0], sequence.depth_files[0]):
            path.unlink()
        with pytest.raises(InputError, match="no frames"):
            open_sequence(written.path, sequence.kind)
    tum = write.write_tum(tmp_path)
    (tum.path / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="no frames"):
        open_sequence(tum.path)


# F22: units
def test_depth_units_notice(tmp_path):
    written = write.write_folder(tmp_path)
    assert not any("median depth" in n for n in open_sequence(written.path).notices)
    edit(written.path / "camera.yaml", "depth_scale: 256", "depth_scale: 0.256")
    notices = open_sequence(written.path).notices
    assert any("divide by 1000 (millimetres)" in n for n in notices)
    edit(written.path / "camera.yaml", "depth_scale: 0.256\n", "")
    with pytest.raises(InputError, match="depth_scale"):
        open_sequence(written.path)


@pytest.mark.parametrize(
    ("scale", "hint"),
    [("256000", "multiply by 1000"), ("25600", "multiply by 100"), ("51.2", None), ("1280", None)],
)
def test_depth_units_that_can_and_cannot_be_told(scale, hint, tmp_path):
    # Five times too far or near is a plausible room, and no picture knows its own scale: with depth
    # and translation both five times as large every flow is the same. Nothing can be said then.
    written = write.write_folder(tmp_path)
    edit(written.path / "camera.yaml", "depth_scale: 256", f"depth_scale: {scale}")
    notices = [n for n in open_sequence(written.path).notices if "median depth" in n]
    assert [hint in n for n in notices] == ([True] if hint else [])


# F23: dtypes
def test_eight_bit_depth_is_refused(tmp_path):
    written = write.write_kitti(tmp_path)
    sequence = open_sequence(written.path)
    write.png(sequence.depth_files[1], np.ones((6, 10), np.uint8))
    with pytest.raises(FormatError, match="16-bit depth"):
        sequence.frame(1)
    tartan = open_sequence(write.write_tartanair(tmp_path, 1).path)
    np.save(tartan.depth_files[0], np.ones((6, 8), np.int32))
    with pytest.raises(FormatError, match="floating point"):
        tartan.frame(0)


# F26: paths
@pytest.mark.parametrize("name", ["../../secret.png", "/etc/hostname", "rgb/../../x.png", "link"])
def test_lists_cannot_leave_the_folder(name, tmp_path):
    written = write.write_tum(tmp_path)
    if name == "link":
        os.symlink(tmp_path, written.path / "link")
        name = "link/x.png"
    write.png(tmp_path / "x.png", write.image(0, 480, 640))
    edit(written.path / "rgb.txt", "rgb/1.png", name)
    with pytest.raises(InputError, match="leads out of the sequence folder"):
        open_sequence(written.path)
    if name.endswith("x.png"):
        assert len(open_sequence(written.path, allow_outside=True)) == 3


def test_odd_names_in_lists(tmp_path):
    written = write.write_tum(tmp_path)
    os.symlink("loop", written.path / "loop")
    edit(written.path / "rgb.txt", "rgb/1.png", "loop/x.png")
    with pytest.raises(InputError, match=r"not a usable|leads out"):
        open_sequence(written.path)
    edit(written.path / "rgb.txt", "loop/x.png", "rgb/\0.png")
    with pytest.raises(InputError, match="not a usable"):
        open_sequence(written.path)
    edit(written.path / "rgb.txt", "rgb/\0.png", "x" * 5000)
    with pytest.raises(InputError, match="not a usable"):
        open_sequence(written.path)


def test_spaces_and_bytes_in_names(tmp_path):  # F41
    written = write.write_tum(tmp_path / "a b \N{CAMERA}")
    odd = os.fsdecode(os.fsencode(str(written.path / "rgb")) + b"/my \xff.png")
    os.rename(written.path / "rgb" / "1.png", odd)
    path = written.path / "rgb.txt"
    path.write_bytes(path.read_bytes().replace(b"rgb/1.png", b"rgb/my \xff.png"))
    frame = open_sequence(written.path).frame(1)
    np.testing.assert_array_equal(frame.rgb, written.rgb[1])


def test_very_long_paths(tmp_path):  # F41
    deep = tmp_path
    for _ in range(5):
        deep = deep / ("d" * 200)
    deep.mkdir(parents=True)
    written = write.write_folder(deep)
    np.testing.assert_array_equal(open_sequence(written.path).frame(2).rgb, written.rgb[2])
    with pytest.raises(InputError, match="cannot be read: File name too long"):
        open_sequence(tmp_path / ("x" * 300))
    with pytest.raises(InputError, match="no such folder"):
        open_sequence(f"{tmp_path}/a\0b")


@pytest.mark.parametrize("kind", ["folder", "kitti", "tartanair-v1"])
def test_frames_deleted_while_their_pairs_are_read(kind, tmp_path):  # F17, F41
    written = TINY[kind](tmp_path)
    sequence = open_sequence(written.path)
    problems: list[tuple[int, Exception]] = []
    zero = lambda prev, curr: FlowField(np.zeros((*prev.camera.shape, 2), np.float32))  # noqa: E731
    pairs = iter_pairs(sequence, zero, on_error=lambda i, e: problems.append((i, e)))
    for files in (sequence.rgb_files, sequence.depth_files):
        files[1].unlink()
    assert list(pairs) == []  # of three frames the middle one is gone
    assert [i for i, _ in problems] == [1]
    assert isinstance(problems[0][1], FileNotFoundError) and "frame 1" in str(problems[0][1])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("kind", ["sintel", "kitti", "tartanair-v1"])
def test_a_pipe_among_the_frames_does_not_block(kind, tmp_path):
    written = TINY[kind](tmp_path)
    path = open_sequence(written.path).rgb_files[1]
    path.unlink()
    os.mkfifo(path)
    sequence = open_sequence(written.path)
    assert path not in sequence.files()  # they are opened for the input hash
    with pytest.raises(FormatError, match="expected a file, got a pipe"):
        sequence.frame(1)


# F27: YAML
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (write.CAMERA_YAML + "distortoin: [0, 0, 0, 0, 0]\n", "did you mean 'distortion'"),
        (write.CAMERA_YAML + "distortion: [0, x, 0, 0, 0]\n", "list of 5 numbers"),
        ("!!python/object/apply:os.system ['true']\n", "not a plain YAML"),
        ("- 1\n- 2\n", "got a list"),
        ("fx: [1\n", "not a plain YAML"),
        ("", "got a NoneType"),
        ("a: &a [x]\nb: &b [*a, *a]\n? [1, 2]\n: 3\n", "unknown key|not a plain"),
        ("#" * (2**20 + 1), "above the limit"),
    ],
)
def test_camera_yaml(text, message, tmp_path):
    written = write.write_folder(tmp_path)
    (written.path / "camera.yaml").write_text(text)
    with pytest.raises(FormatError, match=message):
        open_sequence(written.path)


def test_alias_bomb_stays_small(tmp_path):
    written = write.write_folder(tmp_path)
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    for i in range(1, 12):  # 9^12 leaves if anything unfolded it
        bomb += f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n"
    (written.path / "camera.yaml").write_text(bomb + "fx: *a11\n")
    with pytest.raises(FormatError) as caught:
        open_sequence(written.path)
    assert len(str(caught.value)) < 1000


# Broken rows in lists name their line
@pytest.mark.parametrize("row", ["1 2 3", "1 0 0 0 0 0 0 x", "1 0 0 0 0 0 0 0"])
def test_broken_pose_rows(row, tmp_path):
    written = write.write_tum(tmp_path)
    path = written.path / "groundtruth.txt"
    path.write_text("# head\n" + row + "\n")
    with pytest.raises(FormatError, match=r"groundtruth\.txt:2|unit quaternion"):
        open_sequence(written.path)


def test_lost_tracking_and_missing_truth_are_nan_rows(tmp_path):
    written = write.write_seven_scenes(tmp_path)
    (written.path / "frame-000001.pose.txt").write_text("inf " * 16)
    (written.path / "frame-000002.pose.txt").write_text("1 2 3")
    sequence = open_sequence(written.path)
    assert np.isfinite(sequence.poses[0]).all() and np.isnan(sequence.poses[1:]).all()
    assert any("expected 16 numbers" in n for n in sequence.notices)
    with pytest.raises(FormatError):
        open_sequence(written.path, strict=True)
    tum = write.write_tum(tmp_path)
    (tum.path / "groundtruth.txt").write_text(write.tum_row(100.0, 0))
    poses = open_sequence(tum.path).poses
    assert np.isfinite(poses[0]).all() and np.isnan(poses[1:]).all()


@pytest.mark.parametrize("kind", TINY)
def test_undecodable_frame_names_its_file(kind, tmp_path):  # F5
    written = TINY[kind](tmp_path)
    sequence = open_sequence(written.path)
    for path in (sequence.rgb_files[1], sequence.depth_files[2]):
        path.write_bytes(path.read_bytes()[:-9])
    for index, path in ((1, sequence.rgb_files[1]), (2, sequence.depth_files[2])):
        with pytest.raises(FormatError, match=path.name):
            sequence.frame(index)
    assert open_sequence(written.path).frame(0).rgb is not None


def test_other_sizes_need_a_camera(tmp_path):
    root = tmp_path / "small"
    for i in range(2):
        write.png(root / f"frame-{i:06d}.color.png", write.image(i, 6, 8))
        write.png(root / f"frame-{i:06d}.depth.png", np.full((6, 8), 1500, np.uint16))
    with pytest.raises(InputError, match="Pass camera="):
        open_sequence(root)
    camera = Camera(8, 8, 3.5, 2.5, 6, 8)
    assert open_sequence(root, camera=camera).frame(1).depth[0, 0] == 1.5


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("kitti", "calib.txt"),
        ("kitti", "times.txt"),
        ("kitti", "../../poses/07.txt"),
        ("folder", "camera.yaml"),
        ("folder", "poses.txt"),
        ("tartanair-v1", "pose_left.txt"),
    ],
)
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_text_files_raise_input_errors_only(kind, name, tmp_path, data):
    path = tmp_path / "once"
    written = TINY[kind](path) if not path.exists() else None
    root = (
        written.path
        if written
        else next(p for p in (path / "sequences/07", path / "mine", path / "P000") if p.exists())
    )
    backup = path / f"backup-{name.replace('/', '_')}"
    if not backup.exists():
        backup.write_bytes((root / name).read_bytes())
    content = bytearray(backup.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        piece = st.sampled_from(
            [b"9" * 400, b"nan", b"-", b"\n", b"\0", b"e999", b"[", b": ", b"*"]
        )
        content[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=6) | piece)
    (root / name).write_bytes(bytes(content))
    try:
        sequence = open_sequence(root, kind.split("-")[0])
        sequence.frame(0)
        assert sequence.poses is None or not np.isinf(sequence.poses).any()
    except InputError as error:
        assert root.name in str(error) or "07" in str(error)
