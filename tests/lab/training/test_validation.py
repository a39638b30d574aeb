from __future__ import annotations

import numpy as np
import pytest
import torch

from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo_lab.paper.layers import NetworkOptions
from hybridvo_lab.paper.networks import build_network
from hybridvo_lab.synthetic.draws import sample_generator
from hybridvo_lab.synthetic.paper_samples import PaperOptions
from hybridvo_lab.training import validation
from hybridvo_lab.training.validation import TrainingBatch, collate

PRESET = PaperOptions(height=32, width=64)


def test_area_under_curve_by_hand():
    score = np.array([0.1, 0.4, 0.35, 0.8])
    label = np.array([False, False, True, True])
    assert validation.area_under_curve(score, label) == 0.75
    assert validation.area_under_curve(np.ones(4), label) == 0.5
    assert validation.area_under_curve(score, np.ones(4, bool)) is None


class Oracle(torch.nn.Module):
    """Answers with a share of the true motion and calls moving pixels uncertain."""

    def __init__(self, truth: TrainingBatch, fraction: float) -> None:
        super().__init__()
        self.options = NetworkOptions()
        self.dummy = torch.nn.Parameter(torch.zeros(1))
        self.truth = truth
        self.fraction = fraction

    def forward(self, inputs):
        maps = self.truth.moving[:, None].expand(-1, 6, -1, -1).float()
        motion = self.fraction * self.truth.targets.motion
        return PixelwisePrediction(motion[:, :, None, None].expand_as(maps), maps)


@pytest.mark.parametrize("fraction", [1.0, 0.0])
@pytest.mark.parametrize("rule", ["softmax", "mean"])
def test_figures_of_an_oracle_and_of_zero_motion(fraction, rule):
    samples = [PRESET.sample(sample_generator(3, i)) for i in range(6)]
    network = Oracle(collate(samples), fraction)
    result = validation.evaluate_network(
        network, validation.held_out(PRESET, 3, 6), rule
    )
    assert result["auroc_rotation"] == 1.0
    for name, exact in (("r_err_deg", 1e-5), ("t_err", 1e-6), ("epe", 1e-2)):
        expected = 0.0 if fraction else result[f"zero_{name}"]
        assert result[name] == pytest.approx(expected, abs=exact)
    direct = np.mean([np.abs(s.rotation_deg).mean() for s in samples])
    assert result["zero_r_err_deg"] == pytest.approx(direct, rel=1e-5)
    near = [
        np.linalg.norm(s.ego_flow, axis=-1) < validation.EPE_LIMIT_PX
        for s in samples
    ]
    flows = [
        (np.abs(s.ego_flow) * n[..., None]).mean()
        for s, n in zip(samples, near, strict=True)
    ]
    assert result["zero_epe"] == pytest.approx(np.mean(flows), rel=1e-4)
    assert len(result["epe_of_pairs"]) == 6


def test_figures_need_a_sample():
    network = build_network(NetworkOptions(width=0.1, head_stride=2))
    with pytest.raises(InputError, match="at least one"):
        validation.evaluate_network(network, [])
