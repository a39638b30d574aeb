"""Semi-real pairs: their ground truth is that of their images, and no frame serves twice."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow
from hybridvo.core.types import Camera, Frame
from hybridvo_lab.synthetic import semi_real
from hybridvo_lab.synthetic.meshes import Canvas
from hybridvo_lab.synthetic.recordings import SPLITS, Recording, Source
from hybridvo_lab.synthetic.semi_real import (
    OBJECT_KINDS,
    draw_clip,
    load_split,
)


def recording(seed: int, count: int = 2) -> Recording:
    """Frames of a textured, curved wall with a hole in its depth; every one of another wall."""
    rng = np.random.default_rng(seed)
    camera = Camera(240.0, 240.0, 149.5, 112.5, height=226, width=300)
    u, v = np.meshgrid(np.arange(300), np.arange(226))
    frames = []
    for k in range(count):
        noise = rng.uniform(0, 255, (226, 300, 3)).astype(np.float32)
        rgb = np.clip(128 + 8 * (cv2.GaussianBlur(noise, (0, 0), 4) - 128), 0, 255)
        depth = (3 + k + np.sin(u / 40) * np.cos(v / 30)).astype(np.float32)
        depth[100:110, 100:130] = 0
        frames.append(Frame(rgb.astype(np.uint8), depth, camera))
    return Recording(Source(f"made_{seed}"), tuple(frames), ())


@pytest.mark.slow
@pytest.mark.parametrize("rendered", [0.0, 1.0])
def test_flow_obeys_the_motion_where_the_scene_is_static(
    rendered: float,
) -> None:
    recordings = [recording(1), recording(2)]
    checked = 0
    for seed in range(8):
        (drawn,) = draw_clip(np.random.default_rng(seed), recordings, 2, rendered)
        pair = drawn.pair
        depth = np.where(drawn.depth > 0, drawn.depth, np.nan)
        own = ego_flow(depth, drawn.T_curr_prev, pair.prev.camera, pair.curr.camera)
        error = np.linalg.norm(pair.flow - own, axis=2)
        good = pair.flow_valid & np.isfinite(error)
        # longer steps
        assert np.median(error[good & ~drawn.moving]) < (1.0 if rendered else 0.5)
        if np.count_nonzero(good & drawn.moving) > 300:
            checked += 1
            assert np.median(error[good & drawn.moving]) > np.median(
                error[good & ~drawn.moving]
            )
    assert checked >= 4


def test_through_a_rolling_shutter_the_camera_turns_on_from_row_to_row() -> None:
    camera = Camera(200.0, 200.0, 80.0, 60.0, height=121, width=161)
    u = np.indices((121, 161), np.float32)[1]
    canvas = Canvas(np.dstack([u] * 3), u + 1, 0 * u, np.zeros_like(u))
    # 0.02 rad: 4 px from the first row to the last
    canvas.roll(np.array([0.0, 0.02, 0.0]), camera)
    seen = canvas.image[..., 0] - u
    np.testing.assert_allclose(seen[[0, 60, 120], 80], [-2, 0, 2], atol=0.05)
    # the same pixel
    assert np.abs(canvas.depth - 1 - canvas.image[..., 0]).max() <= 0.55


def test_a_long_exposure_blurs_along_the_turn_and_leaves_depth_alone() -> None:
    camera = Camera(200.0, 200.0, 80.0, 60.0, height=121, width=161)
    u = np.indices((121, 161), np.float32)[1]
    step = (u > 80).astype(np.float32)
    canvas = Canvas(np.dstack([step] * 3), step + 1, 0 * u, np.zeros_like(u))
    # 8 px in the middle row
    canvas.roll(np.array([0.0, 0.02, 0.0]), camera, exposure=2.0)
    seen = canvas.image[60, :, 0]
    assert (seen > 0.05).argmax() == pytest.approx(77, abs=1)
    assert (seen > 0.95).argmax() == pytest.approx(84, abs=1)
    assert set(np.unique(canvas.depth)) == {1, 2}


def test_a_pair_is_drawn_again_as_it_was_and_may_be_static() -> None:
    recordings = [recording(1), recording(2)]
    one, two = (
        draw_clip(np.random.default_rng(5), recordings)[0] for _ in range(2)
    )
    np.testing.assert_array_equal(one.pair.curr.rgb, two.pair.curr.rgb)
    np.testing.assert_array_equal(one.pair.prev.depth, two.pair.prev.depth)
    (still,) = draw_clip(np.random.default_rng(5), recordings, objects=0)
    assert not still.moving.any()


def test_the_pairs_of_a_clip_share_their_frames_and_objects_stop_and_start(
    monkeypatch,
) -> None:
    monkeypatch.setattr(semi_real, "STOP_PROBABILITY", 1.0)  # at every step
    clip = draw_clip(
        np.random.default_rng(3), [recording(1), recording(2)], 1, frames=6
    )
    assert len(clip) == 5
    assert all(
        one.pair.curr is two.pair.prev for one, two in itertools.pairwise(clip)
    )
    for known in clip:
        own = ego_flow(
            known.depth, known.T_curr_prev, *[known.pair.prev.camera] * 2
        )
        static = known.pair.flow_valid & (known.depth > 0) & ~known.moving
        assert (
            np.median(np.linalg.norm(known.pair.flow - own, axis=2)[static]) < 0.5
        )
    areas = [known.moving.mean() for known in clip]
    moves = areas[::2]
    stands = areas[1::2]
    assert min(moves) > 0.03 and not any(stands)


def test_no_frame_serves_in_two_parts() -> None:
    used: dict[str, list[tuple[float, str]]] = {}
    for split, places in SPLITS.items():
        for source in (
            source for of_place in places.values() for source in of_place
        ):
            stop = np.inf if source.stop is None else source.stop
            for start, other_stop, other in used.setdefault(source.path, []):
                assert other == split or source.start >= other_stop or stop <= start
            used[source.path].append((source.start, stop, split))
    for path, rows in used.items():
        if path.startswith("real_dynamic"):
            assert {split for _, _, split in rows} == {"test"}


def test_a_folder_without_recordings_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="no recording of 'test'"):
        load_split(tmp_path, "test")
    with pytest.raises(InputError, match="expected train"):
        load_split(tmp_path, "all")


@pytest.mark.parametrize("number", range(len(OBJECT_KINDS)))
def test_each_kind_of_moving_objects_moves(monkeypatch, number: int) -> None:
    kind = OBJECT_KINDS[number]
    alone = kind._replace(probability=1.0)
    monkeypatch.setattr(semi_real, "OBJECT_KINDS", (alone,))
    drawn: list[str] = []
    draw_motion = semi_real._draw_motion

    def noting(*arguments):
        motion = draw_motion(*arguments)
        drawn.append(motion.kind)
        return motion

    monkeypatch.setattr(semi_real, "_draw_motion", noting)
    recordings = [recording(1), recording(2)]
    areas = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        (known,) = draw_clip(rng, recordings, 0, of_kind=1.0)
        assert np.isfinite(known.pair.prev.depth).all()
        areas.append(float(known.moving.mean()))
        depth = np.where(known.depth > 0, known.depth, np.nan)
        own = ego_flow(depth, known.T_curr_prev, *[known.pair.prev.camera] * 2)
        error = np.linalg.norm(known.pair.flow - own, axis=2)
        good = known.pair.flow_valid & np.isfinite(error)
        if np.count_nonzero(good & known.moving) > 500:
            moving = np.median(error[good & known.moving])
            assert moving > np.median(error[good & ~known.moving])
    assert drawn and set(drawn) <= set(kind.motions)
    assert max(areas) > 0.5 * kind.coverage[0]
