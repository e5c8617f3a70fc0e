"""The Segment Anything Model: from an image and a point in it to a mask.

The architecture is that of `transformers`. Without a checkpoint its weights are random, the same
everywhere: such a network takes as long as a trained one, and its masks mean nothing.
"""

from __future__ import annotations

import os
from pathlib import Path

# Nothing is ever loaded from the network, and nobody asked for advice.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")

import numpy as np
import torch
from PIL import Image
from transformers import SamConfig, SamModel

# Size: layers, width and heads of the image encoder, which layers see the whole image, and the
# side of the image. `base` is the published ViT-B; `base-256` looks at smaller images.
SIZES = {
    "tiny": (12, 192, 3, (2, 5, 8, 11), 256),
    "base-256": (12, 768, 12, (2, 5, 8, 11), 256),
    "base": (12, 768, 12, (2, 5, 8, 11), 1024),
}
_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_SPREAD = np.array([58.395, 57.12, 57.375], np.float32)


def configuration(size: str) -> SamConfig:
    """Return what `transformers` calls this architecture in one of `SIZES`."""
    layers, width, heads, whole, side = SIZES[size]
    vision = {
        "num_hidden_layers": layers,
        "hidden_size": width,
        "num_attention_heads": heads,
        "mlp_dim": 4 * width,
        "global_attn_indexes": list(whole),
        "image_size": side,
    }
    prompt = {"image_size": side, "image_embedding_size": side // 16}
    return SamConfig(vision_config=vision, prompt_encoder_config=prompt)


class Segmenter:
    """The network on some threads. Holds nothing from image to image.

    Args:
        size: One of `SIZES`, where no weights are given.
        weights: Folder of a checkpoint in the format of `transformers`.
        threads: How many cores one image may use.
    """

    def __init__(self, size: str = "tiny", weights: Path | None = None, threads: int = 1) -> None:
        torch.set_num_threads(threads)
        if weights is None:
            torch.manual_seed(0)
            self._network = SamModel(configuration(size))
            self.name = f"SAM, {size}, random weights: its masks mean nothing"
        else:
            self._network = SamModel.from_pretrained(str(weights), local_files_only=True)
            self.name = f"SAM, trained weights of {weights.name}"
        self._network.eval()
        self._side = int(self._network.config.vision_config.image_size)

    def segment(self, rgb: np.ndarray, x: float, y: float) -> tuple[np.ndarray, float]:
        """Return the mask (height x width truth values) of what is at a point, and its score."""
        high, wide = rgb.shape[:2]
        scale = self._side / max(high, wide)
        size = max(1, round(wide * scale)), max(1, round(high * scale))
        small = Image.fromarray(rgb).resize(size, Image.Resampling.BILINEAR)
        padded = np.zeros((self._side, self._side, 3), np.float32)
        padded[: size[1], : size[0]] = (np.asarray(small, np.float32) - _MEAN) / _SPREAD
        pixels = torch.from_numpy(padded.transpose(2, 0, 1)[None].copy())
        points = torch.tensor([[[[x * scale, y * scale]]]], dtype=torch.float32)
        with torch.inference_mode():
            seen = self._network(pixel_values=pixels, input_points=points, multimask_output=False)
            logits = torch.nn.functional.interpolate(
                seen.pred_masks[0], (self._side, self._side), mode="bilinear"
            )[..., : size[1], : size[0]]
            whole = torch.nn.functional.interpolate(logits, (high, wide), mode="bilinear")
        return (whole[0, 0] > 0).numpy(), float(seen.iou_scores.reshape(-1)[0])
