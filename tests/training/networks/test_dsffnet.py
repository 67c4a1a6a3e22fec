"""DSFFNet: its golden output, and its coefficients by name; `test_network_laws` has what holds for every network.

To write the golden output: ``python tests/training/networks/test_dsffnet.py --regenerate``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from torch import Tensor

from training.networks.dsffnet import DSFFNet

GOLDEN = Path(__file__).parents[2] / "golden" / "dsffnet_output.json"
NARROW = {"encoder_widths": (8, 12, 20), "decoder_widths": (10, 24, 14)}


def test_adaptive_coefficients_by_name() -> None:
    network = DSFFNet(**NARROW, feature_fusion=False)
    torch.nn.init.constant_(network.decoder.block2.norm2.beta, 0.25)
    found = network.adaptive_coefficients()
    assert sorted(found) == [f"block{i}.norm2.{which}" for i in (1, 2, 3) for which in ("alpha", "beta")]
    assert found["block2.norm2.beta"] == 0.25 and sum(found.values()) == 0.25
    assert set(DSFFNet(**NARROW).adaptive_coefficients().values()) == {0.0}


def _golden_output() -> Tensor:
    """Return the output of a network whose weights are sines, so that no random generator has a part in it."""
    network = DSFFNet(**NARROW).double()
    with torch.no_grad():
        for index, parameter in enumerate(network.parameters()):
            wave = torch.sin(torch.arange(1, parameter.numel() + 1, dtype=torch.float64) * (1.7 + index))
            parameter.copy_(wave.view_as(parameter) / parameter.shape[-1] ** 0.5)
        corner = torch.arange(36, dtype=torch.float64)
        return network(source=torch.cos(corner * 2.3).view(1, 12, 3), target=torch.cos(corner[:24] * 1.1).view(1, 8, 3))


def test_golden_output() -> None:
    expected = torch.tensor(json.loads(GOLDEN.read_text())["output"], dtype=torch.float64)
    torch.testing.assert_close(_golden_output(), expected, rtol=0, atol=1e-9)


if __name__ == "__main__" and sys.argv[1:] == ["--regenerate"]:
    command = "python tests/training/networks/test_dsffnet.py --regenerate"
    GOLDEN.write_text(json.dumps({"regenerate": command, "output": _golden_output().tolist()}, indent=1) + "\n")
