"""Every reader gives back, bit for bit, what the test wrote in the data set's format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import fingerprint
from hybridvo.core.geometry import ego_flow, invert
from hybridvo.core.types import Camera
from hybridvo.flow.providers import FlowField
from hybridvo.io.data.open import READERS, iter_pairs, open_sequence
from tests import sequences as write

DEPTH_SOURCE = {
    "sintel": "true",
    "tartanair": "true",
    "tum": "sensor",
    "7scenes": "sensor",
}
SECONDS = {
    "sintel": 1 / 24,
    "tartanair": 1 / 10,
    "tum": 1 / 30,
    "7scenes": 1 / 30,
    "folder": 1 / 4,
}


@pytest.mark.parametrize("kind", write.WRITERS)
def test_reads_back_exactly(kind, tmp_path):
    written = write.WRITERS[kind](tmp_path)
    sequence = open_sequence(written.path)
    assert sequence.kind == kind.split("-")[0]
    assert sequence.depth_source == DEPTH_SOURCE.get(sequence.kind, "file")
    assert len(sequence) == write.N
    step = SECONDS.get(sequence.kind, 1 / 10)
    np.testing.assert_allclose(np.diff(sequence.timestamps), step, atol=2e-6)
    # 7-Scenes stores 7 digits; everything else is exact to the last few bits
    np.testing.assert_allclose(sequence.poses, written.poses, atol=1e-12, rtol=0)
    for i, frame in enumerate(sequence):
        np.testing.assert_array_equal(frame.rgb, written.rgb[i])
        np.testing.assert_array_equal(frame.depth, written.depth[i])
        camera = frame.camera
        assert camera == sequence.camera(i)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == written.K[i]
        assert (frame.index, frame.timestamp) == (i, sequence.timestamps[i])
    assert sequence.has_flow == bool(written.flow)
    for i, expected in enumerate(written.flow):
        flow, valid = sequence.flow(i)
        np.testing.assert_array_equal(flow, expected)
        assert flow.dtype == np.float32
        np.testing.assert_array_equal(
            valid, written.valid[i] if written.valid else None
        )
    assert sequence[-1].index == write.N - 1
    for past_the_end in (write.N, -write.N - 1):
        with pytest.raises(IndexError):
            sequence[past_the_end]
    with pytest.raises(IndexError):
        sequence.flow(write.N - 1)
    read = {
        *sequence.rgb_files,
        *sequence.depth_files,
        *sequence.flow_files[:-1],
    } - {None}
    assert set(sequence.files()) >= read | {
        p for p in written.path.glob("*") if p.is_file()
    }


@pytest.mark.parametrize(
    "folder", ["clean", "flow", "depth", "camdata_left", "final"]
)
def test_sintel_from_any_sibling(folder, tmp_path):
    written = write.write_sintel(tmp_path)
    sequence = open_sequence(tmp_path / "training" / folder / written.path.name)
    assert len(sequence) == write.N
    assert sequence.has_flow
    # final was never downloaded: there are no images then
    assert (sequence.frame(0).rgb is None) == (folder == "final")


def test_real_tartanair_flow_is_the_rigid_flow(shared_data):
    sequence = open_sequence(shared_data / "tartanair_v2" / "P000")
    flow, valid = sequence.flow(0)
    T_curr_prev = invert(sequence.poses[1]) @ sequence.poses[0]
    prev = sequence[0]
    rigid = ego_flow(prev.depth, T_curr_prev, prev.camera, sequence.camera(1))
    error = np.linalg.norm(rigid - flow, axis=2)[valid]
    # flow is stored in steps of 1/64 px: at most 0.5/64 * sqrt(2) = 0.01105 px of rounding
    assert np.median(error) < 0.0065
    assert error.max() < 0.0112


def test_tum_calibrations_are_those_of_the_folder_name(tmp_path):
    for name, fx, is_distorted in (
        ("rgbd_dataset_freiburg1_x", 517.306408, True),
        ("fr2_desk", 520.908620, True),
        ("rgbd_bonn_balloon", 542.822841, True),
        ("unknown", 525.0, False),
    ):
        sequence = open_sequence(write.write_tum(tmp_path, name).path)
        assert sequence.camera(0).fx == fx
        assert (sequence[0].mask is not None) == is_distorted
        assert any("--camera" in told for told in sequence.warnings) == (
            name == "unknown"
        )
        given = open_sequence(sequence.root, camera="500,501,320,240")
        assert (
            given.camera(0) == Camera(500, 501, 320, 240, height=480, width=640)
            and given[0].mask is None
        )


def test_icl_nuim_is_reflected(tmp_path):
    written = write.write_tum(tmp_path, "living_room_traj0")
    root = written.path
    root.joinpath("associations.txt").write_text(
        "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(write.N))
    )
    root.joinpath("traj0.gt.freiburg").write_text(
        "".join(f"{i} {i} 2 3 0 0 0 1\n" for i in range(write.N))
    )
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (root / name).unlink()
    sequence = open_sequence(root)
    assert sequence.camera(0).fy == 480.0
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30)
    np.testing.assert_array_equal(sequence.poses[1, :3, 3], (1, -2, 3))
    np.testing.assert_array_equal(sequence[2].rgb, written.rgb[2])


def test_kitti_depth_from_stereo(tmp_path):
    written = write.write_kitti(tmp_path, stereo=True)
    sequence = open_sequence(written.path)
    assert sequence.depth_source == "stereo"
    frame = sequence[0]
    found = frame.depth > 0
    assert found[:, 40:].mean() > 0.6
    np.testing.assert_allclose(np.median(frame.depth[found]), 1.25, rtol=0.02)
    sigma = 0.5 * frame.depth / (20 * 0.5)  # half a pixel of disparity, f b = 10
    np.testing.assert_allclose(frame.depth_variance, sigma**2, rtol=1e-5)


def test_failure_says_what_was_looked_for(tmp_path):
    (tmp_path / "readme.txt").write_text("x")
    with pytest.raises(InputError) as caught:
        open_sequence(tmp_path)
    message = str(caught.value)
    assert str(tmp_path) in message and "hybridvo init" in message
    assert "\n" not in message
    for path, words in (
        (tmp_path / "missing", "no such folder"),
        (tmp_path / "v1.0", "no such folder"),
        (tmp_path / "missing.bag", "no such file"),
        (tmp_path / "readme.txt", "got a file"),
        # from Python 3.14 on such a name is like that of a missing file
        (tmp_path / ("x" * 300), "cannot be read|no such folder"),
        (f"{tmp_path}/a\0b", "no such folder"),
    ):
        with pytest.raises(InputError, match=words):
            open_sequence(path)
    with pytest.raises(InputError, match=r"known: sintel.*hybridvo init"):
        open_sequence(tmp_path, "nyu")


@pytest.mark.parametrize("dataset", READERS)
def test_forced_kind_on_a_foreign_folder(dataset, tmp_path):
    with pytest.raises(InputError):
        open_sequence(tmp_path, dataset)


def test_pairs_from_files_read_each_frame_once(tmp_path):
    sequence = open_sequence(write.write_sintel(tmp_path).path)
    pairs = list(iter_pairs(sequence))
    assert [(p.prev.index, p.curr.index) for p in pairs] == [(0, 1), (1, 2)]
    assert pairs[0].curr is pairs[1].prev
    assert pairs[0].flow_source == "file" and pairs[0].flow_is_true
    assert pairs[0].depth_source == "true" and not pairs[0].flow_valid[0, 1]
    assert len(list(iter_pairs(sequence, start=1))) == 1
    assert list(iter_pairs(sequence, stop=1)) == []


def test_pairs_from_a_callable(tmp_path):
    sequence = open_sequence(write.write_kitti(tmp_path).path)
    with pytest.raises(InputError, match="no flow files"):
        iter_pairs(sequence)

    def flow(prev, curr):
        field = np.full((*prev.camera.shape, 2), curr.index, np.float32)
        return FlowField(field, source="mine")

    pairs = list(iter_pairs(sequence, flow, stride=2))
    assert [(p.prev.index, p.curr.index, p.flow_source) for p in pairs] == [
        (0, 2, "mine")
    ]
    assert pairs[0].flow[0, 0, 0] == 2
    with_flow = open_sequence(write.write_folder(tmp_path).path)
    with pytest.raises(InputError, match="stride of 2"):
        iter_pairs(with_flow, stride=2)
    with pytest.raises(InputError, match="stride >= 1"):
        iter_pairs(with_flow, stride=0)


def test_a_broken_frame_and_a_missing_flow(tmp_path):
    written = write.write_folder(tmp_path)
    (written.path / "depth" / "f8.png").write_bytes(b"no")
    (written.path / "flow" / "f9.flo").unlink()
    sequence = open_sequence(written.path)
    with pytest.raises(FormatError, match=r"f8\.png"):
        next(iter_pairs(sequence))
    assert [(p.prev.index, p.flow) for p in iter_pairs(sequence, start=1)] == [
        (1, None)
    ]
    assert [frame.index for frame in map(sequence.frame, (1, 2))] == [1, 2]


def test_sintel_without_images_and_with_zips_apart(tmp_path):
    write.write_sintel(tmp_path / "MPI-Sintel-depth", images=False)
    path = tmp_path / "MPI-Sintel-depth" / "training" / "depth" / "alley_9"
    frame = open_sequence(path).frame(1)
    assert frame.rgb is None and frame.depth is not None
    apart = tmp_path / "MPI-Sintel-complete" / "training" / "clean" / "alley_9"
    for i in range(write.N):
        write.png(apart / f"frame_{i + 1:04d}.png", write.image(i, 5, 8))
    np.testing.assert_array_equal(
        open_sequence(apart).frame(1).rgb, write.image(1, 5, 8)
    )


def test_fingerprint_tells_changed_input(tmp_path):
    sequence = open_sequence(write.write_folder(tmp_path).path)
    before = fingerprint(sequence.files())
    assert fingerprint(open_sequence(sequence.root).files()) == before
    path = sequence.root / "poses.txt"
    path.write_text(path.read_text() + "\n")
    assert fingerprint(sequence.files()) != before


def test_depth_of_a_late_clock_in_lists(tmp_path):
    written = write.WRITERS["tum"](tmp_path)
    depth = written.path / "depth.txt"
    rows = [row.split() for row in depth.read_text().splitlines() if row[0] != "#"]
    late = [f"{float(stamp) + 0.05:.6f} {name}\n" for stamp, name in rows]
    depth.write_text("".join(late))
    right = open_sequence(written.path, depth_offset_ms=50)
    assert len(right) == len(rows)
    names = [path.name for path in right.depth_files]
    assert names == [Path(name).name for _, name in rows]
    with pytest.raises(InputError, match=r"depth-offset-ms.*has no such choice"):
        open_sequence(write.WRITERS["kitti"](tmp_path).path, depth_offset_ms=50)
    # matched by their names
    folder = write.WRITERS["folder"](tmp_path).path
    with pytest.raises(InputError, match=r"no stamps of its own.*--depth-lag-ms"):
        open_sequence(folder, depth_offset_ms=50)
