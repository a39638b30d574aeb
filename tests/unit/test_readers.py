"""Every reader gives back, bit for bit, what the test wrote in the data set's format."""

from __future__ import annotations

import numpy as np
import pytest
import sequences as write

from hybridvo.data.sequence import Sequence, open_sequence
from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, invert
from hybridvo.types import Camera

TRUTH = {"sintel": "true", "tartanair": "true", "tum": "sensor", "7scenes": "sensor"}


@pytest.mark.parametrize("kind", write.WRITERS)
def test_reads_back_exactly(kind, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    sequence = open_sequence(written.path)
    assert isinstance(sequence, Sequence)
    assert sequence.kind == kind.split("-")[0]
    assert sequence.depth_source == TRUTH.get(sequence.kind, "file")
    assert len(sequence) == write.N
    assert (np.diff(sequence.timestamps) > 0).all()
    # 7-Scenes stores 7 digits; everything else is exact to the last few bits
    np.testing.assert_allclose(sequence.poses, written.poses, atol=1e-12, rtol=0)
    for i in range(write.N):
        frame = sequence.frame(i)
        np.testing.assert_array_equal(frame.rgb, written.rgb[i])
        np.testing.assert_array_equal(frame.depth, written.depth[i])
        camera = sequence.camera(i)
        assert camera == frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == written.K[i]
        assert (frame.index, frame.timestamp) == (i, sequence.timestamps[i])
    assert sequence.has_flow == bool(written.flow)
    for i, expected in enumerate(written.flow):
        flow, valid = sequence.flow(i)
        np.testing.assert_array_equal(flow, expected)
        assert flow.dtype == np.float32
        if written.valid:
            np.testing.assert_array_equal(valid, written.valid[i])
        else:
            assert valid is None
    on_disk = {path for path in tmp_path.rglob("*") if path.is_file()}
    unread = {p for p in on_disk if "invalid" in str(p) and p.name == "frame_0003.png"}
    assert set(sequence.files()) >= on_disk - unread
    with pytest.raises(IndexError):
        sequence.frame(write.N)
    with pytest.raises(IndexError):
        sequence.frame(-1)


@pytest.mark.parametrize("kind", write.WRITERS)
def test_dataset_may_be_named(kind, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    name = kind.split("-")[0]
    assert len(open_sequence(written.path, name, strict=True)) == write.N
    with pytest.raises(InputError, match="option 'nope'"):
        open_sequence(written.path, name, nope=1)


def test_stamps_of_each_kind(tmp_path):
    steps = {}
    for kind, writer in write.WRITERS.items():
        sequence = open_sequence(writer(tmp_path / kind).path)
        steps[kind] = np.diff(sequence.timestamps)
    for kind, step in {
        "sintel": 1 / 24,
        "tartanair-v1": 1 / 10,
        "tum": 1 / 30,
        "7scenes": 1 / 30,
        "kitti": 1 / 10,
        "folder": 1 / 4,
    }.items():
        np.testing.assert_allclose(steps[kind], step, atol=2e-6)  # TUM lists have 6 digits


@pytest.mark.parametrize("folder", ["clean", "flow", "depth", "camdata_left", "final"])
def test_sintel_from_any_sibling(folder, tmp_path):
    written = write.write_sintel(tmp_path)
    sequence = open_sequence(tmp_path / "training" / folder / written.path.name)
    assert len(sequence) == write.N
    assert sequence.has_flow
    expected = None if folder == "final" else written.rgb[0]  # final was never downloaded
    assert (sequence.frame(0).rgb is None) == (expected is None)


def test_sintel_without_images_and_with_zips_apart(tmp_path):
    write.write_sintel(tmp_path / "MPI-Sintel-depth", images=False)
    path = tmp_path / "MPI-Sintel-depth" / "training" / "depth" / "alley_9"
    frame = open_sequence(path).frame(1)
    assert frame.rgb is None and frame.depth is not None
    apart = tmp_path / "MPI-Sintel-complete" / "training" / "clean" / "alley_9"
    write.png(apart / "frame_0001.png", write.image(0, 5, 8))
    sequence = open_sequence(apart)
    assert sequence.frame(0).rgb is not None and sequence.frame(0).depth is not None


def test_sintel_occlusion_does_not_invalidate_flow(tmp_path):
    sequence = open_sequence(write.write_sintel(tmp_path).path)
    occluded = sequence.occlusion(1)
    assert occluded.sum() == 1 and occluded[0, 1]
    assert sequence.flow(1)[1][0, 1]


def test_kitti_stereo_depth(tmp_path):
    written = write.write_kitti(tmp_path, stereo=True)
    sequence = open_sequence(written.path)
    assert sequence.depth_source == "stereo"
    frame = sequence.frame(0)
    found = frame.depth[:, 80:] > 0  # matching needs the search range to the left
    assert found.mean() > 0.5
    # f b / d = 20 * 0.5 / 8 = 1.25 m; disparities come in steps of 1/16 px
    assert abs(np.median(frame.depth[:, 80:][found]) - 1.25) < 1.25 / 8 / 16 + 1e-6
    variance = frame.depth_variance[frame.depth == 1.25]
    np.testing.assert_allclose(variance, (0.5 / 8) ** 2, rtol=1e-6)


def test_icl_nuim_is_reflected(tmp_path):
    root = tmp_path / "living_room_traj0"
    written = write.write_tum(tmp_path, root.name)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (root / name).unlink()
    lines = (f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(write.N))
    write.text(root / "associations.txt", "".join(lines))
    truth = "".join(write.tum_row(i, i) for i in range(write.N))
    write.text(root / "traj0.gt.freiburg", truth)
    sequence = open_sequence(root)
    F = np.diag([1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(sequence.poses, F @ np.array(written.poses) @ F, atol=1e-12)
    assert sequence.camera(0) == Camera(481.2, 480.0, 319.5, 239.5, 480, 640)
    np.testing.assert_array_equal(sequence.frame(2).depth, written.depth[2])


def test_tum_calibration_by_name_and_undistortion(tmp_path):
    written = write.write_tum(tmp_path, "rgbd_dataset_freiburg1_xyz")
    sequence = open_sequence(written.path)
    assert sequence.camera(0).fx == 517.306408
    # at the principal point (318.6, 255.3) the lens moves nothing; the corners look outside
    frame = sequence.frame(0)
    assert not frame.mask[0, 0] and frame.mask[255, 319]
    assert frame.depth[255, 319] == written.depth[0][255, 319]
    assert frame.depth[0, 0] == 0
    # nearest, never mixed: every depth is one that was in the file
    assert np.isin(frame.depth, [0.0, *np.unique(written.depth[0])]).all()
    other = open_sequence(write.write_tum(tmp_path, "kitchen").path)
    assert other.camera(0) == Camera(525, 525, 319.5, 239.5, 480, 640)
    assert any("assumed" in notice for notice in other.notices)


def test_real_tartanair_flow_is_the_rigid_flow(shared_data):
    sequence = open_sequence(shared_data / "tartanair_v2" / "P000")
    flow, valid = sequence.flow(0)
    T_curr_prev = invert(sequence.poses[1]) @ sequence.poses[0]
    prev = sequence.frame(0)
    rigid = ego_flow(prev.depth, T_curr_prev, prev.camera, sequence.camera(1))
    error = np.linalg.norm(rigid - flow, axis=2)[valid]
    # flow is stored in steps of 1/64 px: at most 0.5/64 * sqrt(2) = 0.01105 px of rounding
    assert np.median(error) < 0.0065
    assert error.max() < 0.0112


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg1_xyz_first10", "redwood_livingroom_5"])
def test_real_tum(name, shared_data):
    sequence = open_sequence(shared_data / "tum" / name)
    assert len(sequence) in (5, 10)
    assert np.isfinite(sequence.poses).all()
    depth = sequence.frame(0).depth
    assert 0.5 < np.median(depth[depth > 0]) < 3
