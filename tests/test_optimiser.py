# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The optimiser is PyTorch's, without what PyTorch's brings along."""

from __future__ import annotations

import subprocess
import sys

import torch
from radarsdf.optimiser import Adam


def test_same_bits_as_pytorch_s():
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in ((300, 8), (7,), (32, 20))]
    ours, theirs = ([p.clone().requires_grad_() for p in start] for _ in range(2))
    adam = Adam(ours, 1e-2, 1e-15)
    reference = torch.optim.Adam(theirs, lr=1e-2, eps=1e-15, fused=True)
    for i in range(20):
        adam.learning_rate = reference.param_groups[0]["lr"] = 1e-2 * (1 - i / 20)
        gradients = [torch.randn(p.shape, generator=generator) for p in ours]
        for parameter, gradient in zip(theirs, gradients, strict=True):
            parameter.grad = gradient.clone()
        adam.step(gradients)
        reference.step()
        for a, b in zip(ours, theirs, strict=True):
            assert torch.equal(a, b)
    assert not torch.equal(ours[0], start[0])
    assert adam.full_rate == 1e-2


def test_a_fit_does_not_import_pytorch_s_compiler():
    code = (
        "import sys, radarsdf\n"
        "scans = radarsdf.simulate.wall(frames=2)\n"
        "config = radarsdf.FitConfig(sdf_iterations=2, intensity_iterations=4)\n"
        "radarsdf.fit(scans.points, scans.poses, scans.intensities, config=config, progress=False).mesh()\n"
        "sys.exit(any(name.partition('.')[0] == 'sympy' or name == 'torch._dynamo' for name in sys.modules))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
