"""The segmenter has SAM's architecture and answers the same question alike, anywhere."""

from __future__ import annotations

import numpy as np
import pytest

from tests.examples.loading import modules
from tests.needs import need

need("torch")
with modules("segment", "sam") as found:
    (sam,) = found


def test_base_has_as_many_parameters_as_the_published_one():
    """93.7 million, as SAM ViT-B; counted without making them."""
    import torch

    with torch.device("meta"):
        network = sam.SamModel(sam.configuration("base"))
    assert sum(each.numel() for each in network.parameters()) == 93_735_728


def test_every_copy_answers_alike_and_another_point_differs():
    image = np.random.default_rng(1).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    first, second = sam.Segmenter("tiny"), sam.Segmenter("tiny")
    mask, score = first.segment(image, 20, 30)
    assert mask.shape == (60, 80)
    assert np.isfinite(score)
    assert 0 < mask.mean() < 1
    same, again = second.segment(image, 20, 30)
    assert (same == mask).all()
    assert again == pytest.approx(score)
    assert (first.segment(image, 70, 5)[0] != mask).any()
    assert "random weights" in first.name
