# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The two losses of the method."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def sdf_loss(logit: Tensor, sdf_m: Tensor, sigma_m: float) -> Tensor:
    """Binary cross-entropy of sigmoid(logit) against sigmoid(sdf / sigma), (B,) each (SHINE-Mapping).

    The sigmoid gives errors near the surface the most weight.
    """
    return functional.binary_cross_entropy_with_logits(logit, torch.sigmoid(sdf_m / sigma_m))


def intensity_loss(predicted: Tensor, label: Tensor) -> Tensor:
    """Mean absolute error of scaled intensities (B,). Outliers count less than in a squared error (3QFPI).

    Where the label is NaN there is none, and no error.
    """
    return functional.l1_loss(predicted, torch.where(label.isnan(), predicted.detach(), label))
