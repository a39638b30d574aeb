"""The judge's pictures as samples of the pixel-wise networks, and what those say of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.data.presets import load_preset
from hybridvo.errors import FormatError, InputError
from hybridvo.learned import shipped_network
from hybridvo.network.judge import JudgeNetwork, JudgeOptions
from hybridvo.network.weighted_fit import weighted_fit
from hybridvo.synthetic.paper import Sample, rigid_flow
from hybridvo.training.held_out import evaluate_network
from hybridvo.training.judge_batches import PictureBatch, read_batches, refits_of
from hybridvo.training.judge_proposals import write_proposals
from hybridvo.training.rendered_pictures import NAMES, RenderedOptions, picture_sample
from hybridvo.training.stream import collate, sample_generator


def pictures(shards: Path, source: int) -> list[dict[str, np.ndarray]]:
    out = []
    for path in sorted(shards.glob("*.npz")):
        with np.load(path) as file:
            shard = {name: file[name] for name in NAMES}
        chosen = np.flatnonzero(shard["source"] == source)
        out += [{k: v[i] for k, v in shard.items()} for i in chosen]
    return out


def on_static(sample: Sample) -> np.ndarray:
    """Distances (n,) of the measured flow from that of the true motion, static pixels, px."""
    assert sample.rays is not None
    known = sample.depth_true > 0
    inverse = np.where(known, 1 / np.where(known, sample.depth_true, 1), 0).astype(np.float32)
    focal = (float(sample.K[0, 0]), float(sample.K[1, 1]))
    x, y = sample.rays[..., 0], sample.rays[..., 1]
    u, v, _ = rigid_flow(x, y, inverse, sample.T_curr_prev[:3, :3], sample.translation, focal)
    use = known & ~sample.moving & np.isfinite(sample.flow).all(-1)
    return np.hypot(sample.flow[..., 0] - u, sample.flow[..., 1] - v)[use]


@pytest.mark.parametrize("mirrored", [(False, False), (True, False), (False, True), (True, True)])
def test_a_sample_is_its_picture_in_any_mirror(shards: Path, mirrored: tuple[bool, bool]) -> None:
    medians = []
    for picture in pictures(shards, 1):
        sample = picture_sample(picture, (128, 256), mirrored)
        plain = picture_sample(picture, (128, 256))
        assert sample.flow.shape == (128, 256, 2) and sample.depth_prev.shape == (128, 256)
        # a mirror keeps lengths and what is seen
        np.testing.assert_allclose(
            np.linalg.norm(sample.translation), np.linalg.norm(plain.translation), rtol=1e-6
        )
        assert sample.moving.sum() == plain.moving.sum()
        distance = on_static(sample)
        if len(distance) > 100:
            medians.append(float(np.median(distance)))
            np.testing.assert_allclose(medians[-1], np.median(on_static(plain)), atol=2e-3)
        # the measured points lie within a cell of the grid (3 px here) of the sample's pixels
        columns = (np.arange(256) - sample.K[0, 2]) / sample.K[0, 0]
        assert np.abs(sample.rays[..., 0] - columns).max() * sample.K[0, 0] < 3.0
    # true flow, half of it with noise of up to a pixel; float16 depths leave a hundredth
    assert len(medians) >= 2 and min(medians) < 0.02


def test_the_true_static_pixels_give_the_true_motion(shards: Path) -> None:
    errors = []
    for picture in pictures(shards, 1):
        sample = picture_sample(picture, (128, 256), (True, False))
        inputs = collate([sample]).inputs
        weights = (inputs.valid & ~torch.from_numpy(sample.moving)).float()
        if weights.sum() < 2000:
            continue
        f, c = inputs.K_prev.diagonal(dim1=1, dim2=2)[:, :2], inputs.K_prev[:, :2, 2]
        target = inputs.rays + inputs.flow_px / f[:, :, None, None]
        assert torch.isfinite(target).all() and c.shape == (1, 2)
        T = weighted_fit(
            inputs.rays.flatten(2),
            inputs.inverse_depth[:, 0].flatten(1),
            target.flatten(2),
            weights.flatten(1),
            torch.eye(4)[None],
        )[0].numpy()
        errors.append(float(np.abs(T - sample.T_curr_prev).max()))
    # exact where flow and depth are; gross errors and noise elsewhere
    assert errors and min(errors) < 1e-3


def test_the_preset_draws_the_same_and_says_what_is_missing(shards: Path, tmp_path: Path) -> None:
    options = RenderedOptions(str(shards), str(shards))
    one, two = (options.sample(sample_generator(3, 5)) for _ in range(2))
    np.testing.assert_array_equal(one.flow, two.flow)
    batch = collate([one, options.sample(sample_generator(3, 6))])
    torch.testing.assert_close(batch.inputs.rays[0], torch.from_numpy(one.rays).permute(2, 0, 1))
    figures = evaluate_network(shipped_network("pwvo"), options, 0, 4)
    assert figures["count"] == 4 and np.isfinite(figures["epe"])
    with pytest.raises(InputError, match="no shards of rendered pictures"):
        RenderedOptions(str(tmp_path / "none")).sample(sample_generator(0, 0))
    with pytest.raises(InputError, match="held_out"):
        RenderedOptions(str(shards)).for_evaluation()
    with pytest.raises(InputError, match="2 px"):
        RenderedOptions(str(shards), height=1)
    (tmp_path / "0_1x1.npz").write_bytes(b"nothing")
    with pytest.raises(FormatError, match="not a shard"):
        RenderedOptions(str(tmp_path)).sample(sample_generator(0, 0))
    shipped = load_preset(Path(__file__).parents[2] / "configs" / "data_rendered.yaml")
    assert shipped == RenderedOptions("runs/judge_data", "runs/judge_held_out")


def test_proposals_stand_beside_their_pictures(shards: Path) -> None:
    before = next(iter(read_batches(sorted(shards.glob("*.npz")), 4, None)))
    assert not before.proposed.any()
    count = write_proposals(shards, shipped_network("pwvo"))
    batches = list(read_batches(sorted(shards.glob("*.npz")), 4, None))
    assert count == sum(len(b.T) for b in batches) and all(b.proposed.all() for b in batches)
    parts: dict[int, list[float]] = {0: [], 1: []}
    for b in batches:
        for label, values in parts.items():
            values += b.static[(b.label == label) & b.inputs.usable].tolist()
    # the labels are 0 for moving pixels and 1 for static ones
    assert np.mean(parts[1]) > np.mean(parts[0]) + 0.2


def largest(shards: Path) -> PictureBatch:
    return max(read_batches(sorted(shards.glob("*.npz")), 4, None), key=lambda b: len(b.T))


def test_a_proposal_takes_part_where_it_is_shown(shards: Path) -> None:
    write_proposals(shards, shipped_network("pwvo"))
    batch = largest(shards)
    torch.manual_seed(0)
    network = JudgeNetwork(JudgeOptions(width=0.5)).eval()
    with torch.no_grad():
        # the masks of a new network mean nothing; proposals stand where they are not empty
        plain = refits_of(batch, network(batch.inputs), 1)
        asked = torch.zeros(len(batch.T), dtype=torch.bool)
        asked[0] = True
        shown = batch.shown(asked)
        more = refits_of(shown, network(shown.inputs), 1)
    assert plain is not None and more is not None
    counts = [torch.bincount(x.owner, minlength=len(batch.T)) for x in (plain, more)]
    assert (counts[1] - counts[0]).tolist() == [1] + [0] * (len(batch.T) - 1)
    assert shown.inputs.has_static.tolist() == asked.tolist()


def test_histories_of_all_kinds_are_expected(shards: Path) -> None:
    batch = largest(shards)
    rng = np.random.default_rng(0)
    seen = [batch.expecting(rng).inputs for _ in range(40)]
    known = torch.cat([s.has_last for s in seen])
    assert 0.3 < known.float().mean() < 0.9
    for s in seen:
        assert torch.isfinite(s.T_last).all() and torch.isfinite(s.last_information).all()
        R = s.T_last[:, :, :3]
        torch.testing.assert_close(
            R @ R.transpose(1, 2), torch.eye(3).expand(len(R), 3, 3), atol=1e-5, rtol=0
        )
