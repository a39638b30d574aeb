from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridvo.core.errors import FormatError, InputError, OutputError
from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import (
    euler_deg_to_matrix,
    invert,
    make_transform,
    se3_exp,
)
from hybridvo.core.trajectory import Trajectory, read_trajectory
from tests.walks import chained

IDENTITY_TUM = "0 0 0 0 0 0 1"


def random_trajectory(rng: np.random.Generator, frames: int = 20) -> Trajectory:
    relative = [se3_exp(0.1 * rng.standard_normal(6)) for _ in range(frames - 1)]
    return chained(relative, 1.3e9 + np.arange(frames) / 30)


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


# -- the class --------------------------------------------------------------------------------


def test_rotation_stays_orthonormal_over_many_rounded_steps(rng):
    relative = np.array(
        [se3_exp(0.1 * rng.standard_normal(6)) for _ in range(1000)]
    )
    relative = np.tile(relative.astype(np.float32), (20, 1, 1))
    trajectory = chained(relative, np.arange(20_001.0))
    R = trajectory.T_world_cam[:, :3, :3]
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-12


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    frames=st.integers(1, 12),
    size=st.sampled_from([1e-7, 1.0]),
)
def test_chained_motions_are_those_between_the_poses(seed, frames, size):
    rng = np.random.default_rng(seed)
    relative = np.array(
        [se3_exp(size * rng.standard_normal(6)) for _ in range(frames - 1)]
    )
    first = se3_exp(rng.standard_normal(6))
    trajectory = chained(relative.reshape(-1, 4, 4), np.arange(frames), first)
    assert len(trajectory) == frames
    np.testing.assert_allclose(trajectory.T_world_cam[0], first, atol=1e-14)
    # a few roundings of numbers up to about 20
    T = trajectory.T_world_cam
    np.testing.assert_allclose(
        invert(T[1:]) @ T[:-1], relative.reshape(-1, 4, 4), atol=1e-13
    )


def test_arrays_are_copied_and_read_only():
    T = np.eye(4)[None].copy()
    trajectory = Trajectory([0.0], T)
    T[0, 0, 3] = 5.0
    assert trajectory.positions[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        trajectory.T_world_cam[0, 0, 3] = 1.0


@pytest.mark.parametrize(
    ("stamps", "match"),
    [
        ([0.0, 2.0, 1.0], "frame 2 has"),
        ([0.0, np.nan, 2.0], "frame 1 has"),
        ([0.0, 1.0], r"\(2,\) for 3 poses"),
    ],
)
def test_bad_timestamps(stamps, match):
    with pytest.raises(InputError, match=match):
        Trajectory(stamps, np.tile(np.eye(4), (3, 1, 1)))


def test_bad_poses():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1, 0, 3] = np.nan
    with pytest.raises(InputError, match=r"T_world_cam\[1\]: expected"):
        Trajectory(np.arange(3), T)
    reflection = np.diag([1.0, 1.0, -1.0, 1.0])
    with pytest.raises(
        InputError, match=r"T_world_cam\[0\]: expected a finite rigid"
    ):
        Trajectory([0.0], reflection[None])
    with pytest.raises(
        InputError, match=r"expected shape \(N, 4, 4\), got float64 \(2, 3, 4\)"
    ):
        Trajectory([0.0, 1.0], np.zeros((2, 3, 4)))
    with pytest.raises(InputError, match="at least one pose"):
        Trajectory([], np.zeros((0, 4, 4)))
    with pytest.raises(InputError, match=r"\(3,\) for 1 poses"):
        Trajectory([0.0, 1.0, 2.0], np.eye(4)[None])


# -- writing ------------------------------------------------------------------------------------


def test_tum_and_kitti_round_trip_and_evo_reads_them(tmp_path, rng):
    from evo.tools.file_interface import (
        read_kitti_poses_file,
        read_tum_trajectory_file,
    )

    trajectory = random_trajectory(rng)
    tum, kitti = tmp_path / "t.tum", tmp_path / "t.kitti"
    trajectory.save(tum)
    trajectory.save(kitti)
    again = read_trajectory(tum)
    np.testing.assert_array_equal(again.timestamps, trajectory.timestamps)
    # quaternion and back: a few ulp of 1
    np.testing.assert_allclose(
        again.T_world_cam, trajectory.T_world_cam, atol=5e-15
    )
    np.testing.assert_array_equal(
        read_trajectory(kitti).T_world_cam, trajectory.T_world_cam
    )
    evo = read_tum_trajectory_file(str(tum))
    np.testing.assert_allclose(evo.poses_se3, trajectory.T_world_cam, atol=5e-15)
    np.testing.assert_array_equal(
        read_kitti_poses_file(str(kitti)).poses_se3, trajectory.T_world_cam
    )
    assert sorted(os.listdir(tmp_path)) == ["t.kitti", "t.tum"]


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path):
    target = write(tmp_path / "t.tum", "old")
    with pytest.raises(RuntimeError), atomic_write(target) as file:
        file.write("new")
        raise RuntimeError
    assert target.read_text() == "old\n"
    assert os.listdir(tmp_path) == ["t.tum"]


def test_output_error_names_the_file(tmp_path):
    blocker = write(tmp_path / "file", "x")
    with pytest.raises(OutputError, match=r"t\.tum: cannot be written"):
        Trajectory([0.0], np.eye(4)[None]).save(blocker / "t.tum")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="folder: cannot be written"):
        Trajectory([0.0], np.eye(4)[None]).save(tmp_path / "folder")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_a_symbolic_link_is_replaced_not_followed(tmp_path):
    sentinel = write(tmp_path / "sentinel", "mine")
    link = tmp_path / "t.tum"
    link.symlink_to(sentinel)
    Trajectory([0.0], np.eye(4)[None]).save(link)
    assert sentinel.read_text() == "mine\n"
    assert not link.is_symlink()


# -- reading ------------------------------------------------------------------------------------


def test_comments_crlf_tabs_bom_and_blank_lines(tmp_path):
    path = tmp_path / "t.txt"
    path.write_bytes(
        b"\xef\xbb\xbf# timestamp tx ty tz qx qy qz qw\r\n\r\n"
        b"1.5 1 2 3 0 0 0 1 \r\n  2.5\t4 5 6  0 0 1 0 # turned\r\n"
    )
    trajectory = read_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [1.5, 2.5])
    np.testing.assert_array_equal(trajectory.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(
        trajectory.T_world_cam[1, :3, :3], np.diag([-1, -1, 1]), atol=1e-15
    )


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["1 2 3"], r":1: expected 'timestamp tx.* or 'r11.* or 'tx.*got '1 2 3'"),
        (
            [f"0 {IDENTITY_TUM}", f"1 {IDENTITY_TUM[:-1]}x"],
            r":2: expected 'timestamp tx .* got '1 0",
        ),
        ([f"0 {IDENTITY_TUM}", IDENTITY_TUM], r":2: expected 'timestamp tx"),
        (["# head", "0 nan 0 0 0 0 0 1"], r":2: expected finite"),
        (["0 0 0 0 0 0 0 inf"], r":1: expected finite"),
        (["0 0 0 0 0 0 0 0"], r":1: expected a unit quaternion"),
        (["0 0 0 0 0 0 3 4"], r":1: expected a unit quaternion.*3.0, 4.0"),
        ([f"1 {IDENTITY_TUM}", f"0 {IDENTITY_TUM}"], r":2: expected increasing"),
        (
            [f"1 {IDENTITY_TUM}", "", f"1 {IDENTITY_TUM}"],
            r":3: expected increasing",
        ),
        (["1 0 0 0 0 1 0 0 0 0 2 0"], r":1: expected a rotation"),
        (["1 0 0 0 0 1 0 0 0 0 -1 0"], r":1: expected a rotation"),
        (["1e200 1e200 0 0 1e200 -1e200 0 0 0 0 1 0"], r":1: expected a rotation"),
        (["0 0 0 0 1e200 0 0 0"], r":1: expected a unit quaternion"),
        (["# nothing"], "expected at least one pose"),
        ([], "expected at least one pose"),
    ],
)
def test_malformed_files(tmp_path, lines, match):
    with pytest.raises(FormatError, match=match):
        read_trajectory(write(tmp_path / "t.txt", *lines))


def test_missing_binary_and_folder(tmp_path):
    with pytest.raises(InputError, match=r"none\.txt: .*no such file"):
        read_trajectory(tmp_path / "none.txt")
    with pytest.raises(InputError, match="cannot be read"):
        read_trajectory(tmp_path)
    (tmp_path / "b").write_bytes(bytes(range(256)))
    with pytest.raises(FormatError, match="binary"):
        read_trajectory(tmp_path / "b")


@settings(max_examples=200, deadline=None)
@given(
    st.binary(max_size=200)
    | st.text("0123456789.-e #\n\r\tnaif", max_size=200).map(str.encode)
)
def test_arbitrary_bytes_give_a_trajectory_or_a_format_error(
    tmp_path_factory, data
):
    path = tmp_path_factory.getbasetemp() / "fuzz.txt"
    path.write_bytes(data)
    try:
        trajectory = read_trajectory(path)
    except FormatError:
        return
    assert np.isfinite(trajectory.T_world_cam).all()


def test_slightly_rounded_matrices_become_rotations(tmp_path, rng):
    T = se3_exp(rng.standard_normal(6))
    path = write(
        tmp_path / "t", " ".join(f"{value:.4f}" for value in T[:3].ravel())
    )
    R = read_trajectory(path).T_world_cam[0, :3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    # four decimals were written
    np.testing.assert_allclose(R, T[:3, :3], atol=2e-4)


def test_tartanair_columns_are_ned(tmp_path):
    # 1 m north (forward), 2 m east (right), 3 m down; turned 90 deg about the down axis
    path = write(
        tmp_path / "pose_left.txt",
        "1 2 3 0 0 0.7071067811865476 0.7071067811865476",
    )
    trajectory = read_trajectory(path)
    assert not trajectory.has_timestamps
    np.testing.assert_array_equal(trajectory.timestamps, [0.0])
    np.testing.assert_allclose(trajectory.positions, [[2, 3, 1]])
    # looking along world z, then turned right: the camera's forward axis is world x
    np.testing.assert_allclose(
        trajectory.T_world_cam[0, :3, 2], [1, 0, 0], atol=1e-15
    )


@pytest.mark.parametrize(
    ("stamps", "unit", "first"),
    [
        ([1305031102175, 1305031102211], "milliseconds", 1305031102.175),
        ([1305031102175304, 1305031102211214], "microseconds", 1305031102.175304),
        ([1305031102.175, 1305031102.211], "", 1305031102.175),
        ([1e14], "", 1e14),
        ([2e14], "nanoseconds", 2e5),
    ],
)
def test_units_of_stamps(tmp_path, stamps, unit, first):
    path = write(tmp_path / "t", *(f"{stamp!r} {IDENTITY_TUM}" for stamp in stamps))
    trajectory = read_trajectory(path)
    assert trajectory.timestamps[0] == pytest.approx(first, rel=1e-15)
    assert (unit in trajectory.warnings[0]) if unit else not trajectory.warnings


# -- conventions, with numbers worked by hand ---------------------------------------------------


def test_turn_right_then_forward():
    # turning right by 90 deg about y (down): what was ahead (0, 0, 1) is now at the left (-1, 0, 0)
    turn = make_transform(
        euler_deg_to_matrix(np.array([0.0, -90.0, 0.0])), np.zeros(3)
    )
    np.testing.assert_allclose(turn[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-15)
    forward = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    trajectory = chained([turn, forward], [0.0, 1.0, 2.0])
    # after the turn, forward is to the right of the world: +x
    np.testing.assert_allclose(trajectory.positions[2], [1, 0, 0], atol=1e-15)
