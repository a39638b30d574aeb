"""Two recordings in one view: every pixel is one of theirs, and follows their motion."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow, invert
from hybridvo_lab.synthetic.recordings import KnownMotion, Recording, Source
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.synthetic.two_recordings import (
    TwoRecordings,
    _draw_outline,
    compose,
    draw_two_recordings,
    load_places,
)

SHAPE = (160, 224)


@functools.cache
def places(count: int = 2) -> dict[str, list[Recording]]:
    """Rendered static scenes in place of recordings, each with another camera motion."""
    made = {}
    for seed in range(count):
        height, width = SHAPE
        scene = make_scene("static", seed, height=height, width=width, frames=4)
        frames = tuple(scene.render(k) for k in range(4))
        T = scene.T_world_cam
        pairs = [KnownMotion(k, k + 1, invert(T[k + 1]) @ T[k]) for k in range(3)]
        made[f"scene {seed}"] = [Recording(Source("made"), frames, tuple(pairs))]
    return made


def drawn(seed: int, frames: int = 2) -> TwoRecordings:
    """Two of them: the thing stands before all of the scene, on two fifths of the view."""
    rng = np.random.default_rng(seed)
    parts = draw_two_recordings(rng, places(), frames)
    shape = parts.world.frames[0].camera.shape
    outline = _draw_outline(rng, shape, 1, 0.4)
    return parts._replace(outline=outline, nearness=(0.0, 0.5))


@pytest.mark.parametrize("seed", range(4))
def test_each_part_follows_its_own_motion(seed: int) -> None:
    clip = compose(drawn(seed))
    (known,) = clip.pairs
    pair = known.pair
    depth = np.where(known.depth > 0, known.depth, np.nan)
    cameras = pair.prev.camera, pair.curr.camera
    errors = {}
    for whose, T in (("world", known.T_curr_prev), ("thing", clip.T_thing[0])):
        apart = np.linalg.norm(pair.flow - ego_flow(depth, T, *cameras), axis=2)
        for part, mask in (("world", ~known.moving), ("thing", known.moving)):
            errors[whose, part] = float(np.nanmedian(apart[mask]))
    assert errors["world", "world"] < 0.5
    assert errors["thing", "thing"] < 0.5
    assert errors["thing", "world"] > errors["world", "world"]
    assert errors["world", "thing"] > errors["thing", "thing"]


def test_the_scene_is_as_it_was_recorded_and_the_thing_fills_its_outline() -> None:
    parts = drawn(1)
    frame = compose(parts).pairs[0].pair.prev
    scene, thing = parts.world.frames[0], parts.thing.frames[0]
    inside = parts.outline > 0.05
    outside = parts.outline < -0.05
    np.testing.assert_array_equal(frame.rgb[outside], scene.rgb[outside])
    np.testing.assert_array_equal(frame.depth[outside], scene.depth[outside])
    np.testing.assert_array_equal(frame.rgb[inside], thing.rgb[inside])
    assert (frame.depth[inside] < scene.depth[inside]).all()


def test_exchanged_roles_show_the_other_recording_on_either_side() -> None:
    parts = drawn(2)
    both = [compose(each).pairs[0] for each in (parts, parts.exchanged())]
    first, second = (known.pair.prev.rgb for known in both)
    outside = parts.outline < -0.05
    np.testing.assert_array_equal(
        second[outside], parts.thing.frames[0].rgb[outside]
    )
    np.testing.assert_array_equal(
        first[outside], parts.world.frames[0].rgb[outside]
    )
    motions = parts.world.motions[0], parts.thing.motions[0]
    for known, T in zip(both, motions, strict=True):
        np.testing.assert_array_equal(known.T_curr_prev, T)
    assert parts.exchanged().exchanged() == parts


def test_what_lies_along_the_border_is_known_to_be_the_scene() -> None:
    parts = drawn(3)
    height, width = SHAPE
    v, u = np.mgrid[:height, :width]
    inner = (abs(v - height / 2) < 40) & (abs(u - width / 2) < 60)
    for mask, is_known in ((inner, True), (~inner, False), (u < 112, False)):
        outline = np.where(mask, 1, -1).astype(np.float32)
        assert compose(parts._replace(outline=outline)).is_known == is_known


@given(
    share=st.floats(0.05, 0.95),
    kind=st.integers(0, 2),
    seed=st.integers(0, 10_000),
)
def test_an_outline_encloses_its_share(share: float, kind: int, seed: int) -> None:
    outline = _draw_outline(np.random.default_rng(seed), (60, 80), kind, share)
    assert np.mean(outline > 0) == pytest.approx(share, abs=0.01)


def test_longer_clips_follow_the_outline_and_hold_frames() -> None:
    for seed in range(6):
        parts = drawn(seed, frames=4)
        clip = compose(parts)
        assert len(clip.pairs) == len(clip.T_thing) == 3
        for k, T in enumerate(parts.world.motions):
            before, after = parts.world.frames[k], parts.world.frames[k + 1]
            is_held = np.array_equal(before.rgb, after.rgb)
            assert is_held == np.array_equal(T, np.eye(4))


def test_places_that_cannot_be_put_together_are_named(tmp_path: Path) -> None:
    assert load_places(tmp_path, ("test",)) == {}
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="at least two, got 1"):
        draw_two_recordings(rng, places(1))
    with pytest.raises(InputError, match=r"scene 0, scene 1 have 40 frames"):
        draw_two_recordings(rng, places(), frames=40)
