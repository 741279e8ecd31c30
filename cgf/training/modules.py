"""The networks of `cgf.descriptors.network` as torch modules, with the same names for their weights."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from cgf.descriptors.network import COLUMN_BINS, INPUT_GAIN
from cgf.descriptors.settings import AZIMUTH_BINS, HISTOGRAM_BINS


class AzimuthNetwork(nn.Module):
    """Three circular convolutions over azimuth columns, maximum and mean over them, two linear layers.

    The output is not normalised: the loss and `Network.embed` divide the prefixes by their lengths.
    """

    def __init__(self, dim: int, *, width: int = 256, hidden: int = 512) -> None:
        super().__init__()
        widths = [COLUMN_BINS, width, width, width]
        self.columns = nn.ModuleList(nn.Linear(3 * a, b) for a, b in pairwise(widths))
        self.hidden = nn.Linear(2 * width, hidden)
        self.out = nn.Linear(hidden, dim)

    def forward(self, histograms: Tensor) -> Tensor:
        """Map (K, 2244) histograms to (K, dim)."""
        columns = histograms.sqrt().view(-1, AZIMUTH_BINS, COLUMN_BINS) * INPUT_GAIN
        for layer in self.columns:
            # As roll, concat and Linear: a circular Conv1d is nine times slower on processors.
            neighbors = torch.cat([columns.roll(1, dims=1), columns, columns.roll(-1, dims=1)], dim=2)
            columns = layer(neighbors).relu()
        pooled = torch.cat([columns.amax(dim=1), columns.mean(dim=1)], dim=1)
        out: Tensor = self.out(self.hidden(pooled).relu())
        return out


class PaperNetwork(nn.Module):
    """Five hidden layers of 512, initialised as in the paper: normal weights of deviation 0.1."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        widths = [HISTOGRAM_BINS, *[512] * 5, dim]
        layers = [nn.Linear(a, b) for a, b in pairwise(widths)]
        for layer in layers:
            nn.init.normal_(layer.weight, std=0.1)
            nn.init.zeros_(layer.bias)
        self.layers = nn.ModuleList(layers)

    def forward(self, histograms: Tensor) -> Tensor:
        """Map (K, 2244) histograms to (K, dim)."""
        values = histograms
        for layer in self.layers[:-1]:
            values = layer(values).relu()
        out: Tensor = self.layers[-1](values)
        return out
