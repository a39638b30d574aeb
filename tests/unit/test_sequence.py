"""Opening, detection, association and pairs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import sequences as write
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.data.file_sequence import associate, depth_unit_notice, natural_key, to_seconds
from hybridvo.data.sequence import DATASETS, iter_pairs, open_sequence
from hybridvo.errors import FormatError, InputError


def test_failure_says_what_was_looked_for(tmp_path):
    (tmp_path / "readme.txt").write_text("x")
    with pytest.raises(InputError) as caught:
        open_sequence(tmp_path)
    message = str(caught.value)
    assert all(f"\n  {name}: " in message for name in DATASETS)
    assert "readme.txt" in message and str(tmp_path) in message
    with pytest.raises(InputError, match="no such folder"):
        open_sequence(tmp_path / "missing")
    with pytest.raises(InputError, match="got a file"):
        open_sequence(tmp_path / "readme.txt")
    with pytest.raises(InputError, match="did you mean 'kitti'"):
        open_sequence(tmp_path, "kiti")


@pytest.mark.parametrize("dataset", DATASETS)
def test_forced_kind_on_a_foreign_folder(dataset, tmp_path):
    with pytest.raises(InputError):
        open_sequence(tmp_path, dataset)


@given(
    st.lists(st.integers(0, 400), min_size=1, max_size=25, unique=True),
    st.lists(st.integers(0, 400), min_size=1, max_size=25, unique=True),
)
def test_association_is_greedy_one_to_one(a, b):
    first, second = np.array(a) / 1000, np.array(b) / 1000 + 0.00031
    pairs = associate(first, second, 0.02)
    # the definition, in its slow form
    table = sorted(
        (abs(x - y), i, j)
        for i, x in enumerate(first)
        for j, y in enumerate(second)
        if abs(x - y) < 0.02
    )
    used_a, used_b, expected = set(), set(), []
    for _, i, j in table:
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            expected.append((i, j))
    assert pairs == sorted(expected)


def test_natural_order_and_seconds():
    names = ["frame_10.png", "frame_9.png", "frame_1.png"]
    assert sorted(names, key=natural_key) == ["frame_1.png", "frame_9.png", "frame_10.png"]
    seconds, notices = to_seconds([1.3e18, 1.3e18 + 5e8], "rgb.txt")
    assert seconds.tolist() == [1.3e9, 1.3e9 + 0.5] and "nanoseconds" in notices[0]
    assert to_seconds([1.3e9], "rgb.txt")[1] == []


@pytest.mark.parametrize(
    ("scale", "advice"),
    [(1, ""), (1000, "divide by 1000 (millimetres)"), (5000, "divide by 5000"), (0.001, "1000")],
)
def test_depth_units(scale, advice):
    depth = np.full((4, 4), 3.0) * scale
    depth[0] = 1e4 if scale < 100 else np.nan  # sky does not count
    notice = depth_unit_notice(depth)
    assert (notice == "") == (advice == "")
    assert advice in notice


def test_pairs_from_files_read_each_frame_once(tmp_path):
    sequence = open_sequence(write.write_sintel(tmp_path).path)
    reads = []
    original = sequence.frame
    sequence.frame = lambda i: reads.append(i) or original(i)
    pairs = list(iter_pairs(sequence))
    assert reads == [0, 1, 2]
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
        return SimpleNamespace(flow=field, variance=None, valid=None, source="mine", is_true=False)

    pairs = list(iter_pairs(sequence, flow, stride=2))
    assert [(p.prev.index, p.curr.index, p.flow_source) for p in pairs] == [(0, 2, "mine")]
    assert pairs[0].flow[0, 0, 0] == 2
    with_flow = open_sequence(write.write_folder(tmp_path).path)
    with pytest.raises(InputError, match="stride of 2"):
        iter_pairs(with_flow, stride=2)
    with pytest.raises(InputError, match="stride >= 1"):
        iter_pairs(with_flow, stride=0)


def test_pairs_go_on_after_a_broken_frame(tmp_path):
    written = write.write_folder(tmp_path)
    (written.path / "depth" / "f8.png").write_bytes(b"no")
    (written.path / "flow" / "f9.flo").unlink()
    sequence = open_sequence(written.path)
    with pytest.raises(FormatError, match=r"f8\.png"):
        next(iter_pairs(sequence))
    seen = []
    pairs = list(iter_pairs(sequence, on_error=lambda i, e: seen.append((i, type(e)))))
    assert seen == [(0, FormatError)]
    assert [(p.prev.index, p.flow) for p in pairs] == [(1, None)]
