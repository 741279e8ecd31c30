"""The networks of `cgf.descriptors.network` as torch modules, with the same names for their weights."""

from itertools import pairwise

from torch import Tensor, nn

from cgf.descriptors.device import azimuth_forward, paper_forward
from cgf.descriptors.network import COLUMN_BINS
from cgf.descriptors.settings import HISTOGRAM_BINS


class AzimuthNetwork(nn.Module):
    """Three circular convolutions over azimuth columns, maximum and mean over them, two linear layers.

    The output is not normalised: the loss and `Network.embed` divide the prefixes by their lengths.
    """

    def __init__(self, dim: int, *, width: int) -> None:
        super().__init__()
        widths = [COLUMN_BINS, width, width, width]
        self.columns = nn.ModuleList(nn.Linear(3 * a, b) for a, b in pairwise(widths))
        self.hidden = nn.Linear(2 * width, 2 * width)
        self.out = nn.Linear(2 * width, dim)

    def forward(self, histograms: Tensor) -> Tensor:
        """Map (K, 2244) histograms, of soft azimuth sectors, to (K, dim)."""
        return azimuth_forward(histograms, dict(self.named_parameters()))


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
        return paper_forward(histograms, dict(self.named_parameters()))
