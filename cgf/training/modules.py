"""The networks of `cgf.descriptors.network` as torch modules, with the same names for their weights."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from cgf.descriptors.device import forward
from cgf.descriptors.network import NetworkKind
from cgf.descriptors.settings import AZIMUTH_BINS, HISTOGRAM_BINS, HistogramKind, histogram_size

_JUDGE_WIDTH = 64


class FeatureNetwork(nn.Module):
    """What the networks share: the kind of histogram, the last linear layer, and the estimate of quality.

    The output is not normalised: the loss and `Network.embed` divide the prefixes by their lengths.
    """

    def __init__(self, kind: NetworkKind, histogram: HistogramKind, *, hidden: int, dim: int, judges: bool) -> None:
        super().__init__()
        self.kind, self.histogram = kind, histogram
        self.dropout = 0.0
        self.out = nn.Linear(hidden, dim)
        if judges:
            self.quality = _judge(hidden)

    def forward(self, histograms: Tensor, around: Tensor | None = None) -> Tensor:
        """Map (K, B) histograms to (K, dim), and where quality is judged to (K, dim + 1): the last is its logit.

        A joined network takes (K, S, B), and one with a context also the (K, C, S dim) means of features `around`.
        """
        weights: dict[str, Tensor] = dict(self.named_parameters())
        vectors, logits = forward(self.kind, self.histogram, histograms, weights, dropout=self.dropout, around=around)
        return vectors if logits is None else torch.cat([vectors, logits[:, None]], dim=1)


class AzimuthNetwork(FeatureNetwork):
    """Three circular convolutions over azimuth columns, maximum and mean over them, two linear layers.

    It takes histograms with soft azimuth sectors.
    """

    def __init__(
        self, dim: int, *, width: int, histogram: HistogramKind = "normals", dropout: float = 0.0, judges: bool = True
    ) -> None:
        super().__init__("azimuth", histogram, hidden=2 * width, dim=dim, judges=judges)
        widths = [histogram_size(histogram) // AZIMUTH_BINS, width, width, width]
        self.columns = nn.ModuleList(nn.Linear(3 * a, b) for a, b in pairwise(widths))
        self.hidden = nn.Linear(2 * width, 2 * width)
        self.dropout = dropout


def joined(network: FeatureNetwork, supports: int, context: int = 0) -> FeatureNetwork:
    """Make `network` describe several supports: its features of each, joined by a linear layer, the only one to learn.

    That layer also takes means around a point, within `context` radii. At first it gives the mean of the supports, and
    with a context that within the first radius. What else there was stays as it is, but for the quality, which starts
    anew.
    """
    dim, hidden = network.out.out_features, network.out.in_features
    network.requires_grad_(requires_grad=False)
    network.join = nn.Linear(supports * dim, (1 + context) * dim, bias=False)
    weight = torch.zeros(1 + context, dim, supports * dim)
    weight[min(context, 1)] = torch.eye(dim).repeat(1, supports) / supports
    network.join.weight.data = weight.flatten(0, 1)
    network.quality = _judge(supports * hidden)
    network.dropout = 0.0
    return network


def _judge(hidden: int) -> nn.ModuleList:
    return nn.ModuleList([nn.Linear(hidden, _JUDGE_WIDTH), nn.Linear(_JUDGE_WIDTH, 1)])


class PaperNetwork(FeatureNetwork):
    """Five hidden layers of 512, initialised as in the paper: normal weights of deviation 0.1."""

    def __init__(self, dim: int, *, histogram: HistogramKind = "counts", judges: bool = False) -> None:
        super().__init__("paper", histogram, hidden=512, dim=dim, judges=judges)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([HISTOGRAM_BINS, *[512] * 5]))
        for layer in [*self.layers, self.out]:
            nn.init.normal_(layer.weight, std=0.1)
            nn.init.zeros_(layer.bias)
