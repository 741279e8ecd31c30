"""Histograms and network on an accelerator, through torch; the same features within 1e-3 as on the processor."""

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int64

from cgf.descriptors.network import Network, NetworkKind
from cgf.descriptors.settings import (
    AZIMUTH_BINS,
    ELEVATION_BINS,
    INPUT_GAIN,
    RADIAL_BINS,
    TILT_STEPS,
    HistogramKind,
)
from cgf.descriptors.spherical_histogram import shell_edges
from cgf.geometry.normals import unit_normals
from cgf.types import IsCancelled, PointCloud, raise_if_cancelled

if TYPE_CHECKING:
    from torch import Tensor

_HALF_SECTORS = 2 * AZIMUTH_BINS
_CENTERS = 512
"""Points described at a time; they lie close together, so they share most of their neighbours."""
_PAIRS = 1 << 24
"""Point and candidate pairs looked at together, 64 MiB an array."""


def requested_device() -> str | None:
    """The torch device that `CGF_DEVICE` names, e.g. `cuda`; None stands for the processor, without torch.

    Raises:
        ValueError: Torch is not installed, or has no such device.
    """
    name = os.environ.get("CGF_DEVICE", "")
    if name in ("", "cpu"):
        return None
    try:
        import torch

        torch.zeros(1, device=name)
    except (ModuleNotFoundError, RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"CGF_DEVICE must be cpu or a device that torch has, got {name}: {reason}") from error
    return name


def embed_on_device(
    cloud: PointCloud,
    centers: Float64[np.ndarray, "K 3"],
    frames: Float64[np.ndarray, "K 3 3"],
    network: Network,
    *,
    support_radius: float,
    min_radius: float,
    device: str,
    cancelled: IsCancelled | None = None,
) -> Iterator[
    tuple[Int64[np.ndarray, "P"], Float32[np.ndarray, "P D"], Float32[np.ndarray, "P"] | None, Int64[np.ndarray, "P"]]
]:
    """Describe `centers` part by part.

    Args:
        cloud: With normals, if the network's histograms have them.
        centers: Points to describe, in cloud units.
        frames: Rows are x, y, z.
        network: Any kind.
        support_radius: Of the sphere described, in cloud units.
        min_radius: Of the innermost shell.
        device: As torch calls it.
        cancelled: Asked between parts.

    Yields:
        Rows of `centers`, what `Network.embed` gives for them, the quality of each, and their numbers of neighbours.
    """
    import torch

    offset = cloud.points.min(axis=0)
    points = torch.from_numpy((cloud.points - offset).astype(np.float32)).to(device)
    normals = None
    if network.card.oriented:
        assert cloud.normals is not None
        normals = torch.from_numpy(unit_normals(cloud.normals).astype(np.float32)).to(device)
    queries = torch.from_numpy((centers - offset).astype(np.float32)).to(device)
    axes = torch.from_numpy(frames.astype(np.float32)).to(device)
    weights = {name: torch.from_numpy(values).to(device) for name, values in network.weights.items()}
    card = network.card
    edges = shell_edges(max(card.insets), support_radius=support_radius, min_radius=min_radius)
    sq_edges = torch.from_numpy(np.square(edges).astype(np.float32)).to(device)
    # In the order of coarse cells, so that the points of a part lie close together.
    cells = torch.floor(queries / support_radius).long()
    shape = cells.amax(dim=0) + 1 if len(cells) else cells.new_ones(3)
    order = torch.argsort((cells[:, 2] * shape[1] + cells[:, 1]) * shape[0] + cells[:, 0], stable=True)
    with torch.no_grad():
        for rows in torch.split(order, _CENTERS):
            raise_if_cancelled(cancelled)
            low, high = queries[rows].amin(dim=0), queries[rows].amax(dim=0)
            is_near = ((points >= low - support_radius) & (points <= high + support_radius)).all(dim=1)
            near, near_normals = points[is_near], None if normals is None else normals[is_near]
            parts = [
                _histograms(
                    near,
                    near_normals,
                    queries[part],
                    axes[part],
                    sq_edges,
                    support_radius,
                    soft=card.soft,
                    insets=card.insets,
                )
                for part in torch.split(rows, max(_PAIRS // max(len(near), 1), 1))
            ]
            histograms, counts = (torch.cat(column) for column in zip(*parts, strict=True))
            vectors, logits = forward(card.kind, card.histogram, histograms, weights)
            if card.nested and not card.context:
                vectors = torch.nn.functional.normalize(vectors, dim=1)
            quality = None if logits is None else logits.sigmoid().cpu().numpy()
            yield rows.cpu().numpy(), vectors.cpu().numpy(), quality, counts.cpu().numpy()


def _histograms(
    points: "Tensor",
    normals: "Tensor | None",
    centers: "Tensor",
    frames: "Tensor",
    sq_edges: "Tensor",
    radius: float,
    *,
    soft: bool,
    insets: tuple[int, ...],
) -> "tuple[Tensor, Tensor]":
    """What `cgf.descriptors.spherical_histogram` computes, (K, S, B), for every pair of a centre and a point."""
    import torch

    offsets = points[None] - centers[:, None]
    sq_distances = offsets.square().sum(dim=2)
    rows, columns = ((sq_distances <= radius**2) & (sq_distances > 1e-15)).nonzero(as_tuple=True)
    local = torch.einsum("pij,pj->pi", frames[rows], offsets[rows, columns])
    sq = sq_distances[rows, columns]
    shell = torch.bucketize(sq, sq_edges, right=True)
    elevation = torch.acos((local[:, 2] / sq.sqrt()).clamp(-1, 1)) * (ELEVATION_BINS / np.pi)
    turn = (torch.atan2(local[:, 1], local[:, 0]) + np.pi) * (_HALF_SECTORS / (2 * np.pi))
    sector = turn.long() % _HALF_SECTORS
    shells = len(sq_edges) + 1
    column = shell + shells * elevation.long().clamp(max=ELEVATION_BINS - 1)
    bins = (rows * _HALF_SECTORS + sector) * shells * ELEVATION_BINS + column
    counted = [torch.ones_like(sq)]
    if normals is not None:
        counted += _tilts(torch.einsum("pij,pj->pi", frames[rows], normals[columns]), local)
    size = len(centers) * _HALF_SECTORS * shells * ELEVATION_BINS
    hits = torch.stack([torch.bincount(bins, weights=values, minlength=size).float() for values in counted])
    halves = hits.view(len(counted), len(centers), AZIMUTH_BINS, 2, ELEVATION_BINS, shells)
    sectors = halves.sum(dim=3)
    if soft:
        beside = halves[:, :, :, 1].roll(1, dims=2) + halves[:, :, :, 0].roll(-1, dims=2)
        sectors = 0.75 * sectors + 0.25 * beside
    supports = []
    for inset in insets:
        merged = shells - RADIAL_BINS - inset
        support = sectors[..., merged : merged + RADIAL_BINS].clone()
        support[..., 0] += sectors[..., :merged].sum(dim=4)
        support /= support[0].sum(dim=(1, 2, 3)).clamp(min=1).view(-1, 1, 1, 1)
        if normals is not None:
            roots = support[0].sqrt()
            support = torch.cat([roots[None], support[1:] / roots.clamp(min=1e-20)])
        supports.append(support.permute(1, 2, 0, 3, 4).reshape(len(centers), -1))
    return torch.stack(supports, dim=1), torch.bincount(rows, minlength=len(centers))


def _tilts(normals: "Tensor", offsets: "Tensor") -> "list[Tensor]":
    """Components of normals, all in the frames of their centres: along z, away from the z axis and around it."""
    import torch

    x, y = torch.nn.functional.normalize(offsets[:, :2], dim=1, eps=1e-15).unbind(dim=1)
    components = (normals[:, 2], normals[:, 0] * x + normals[:, 1] * y, normals[:, 1] * x - normals[:, 0] * y)
    return [torch.floor(value.clamp(-1, 1) * TILT_STEPS + 0.5) / TILT_STEPS for value in components]


def forward(
    kind: "NetworkKind",
    histogram: "HistogramKind",
    histograms: "Tensor",
    weights: "dict[str, Tensor]",
    *,
    dropout: float = 0.0,
    around: "Tensor | None" = None,
) -> "tuple[Tensor, Tensor | None]":
    """Map (K, S, B) or (K, B) histograms to (K, D), not normalised, and (K,) logits of quality.

    Where features are joined with those around, to the (K, (1 + C) D) parts of each; or, given the (K, C, S D) means
    `around`, to their sums.

    Of what the azimuth network knows of all sectors together, a share of `dropout` is lost at random.

    Autograd and autocast work through it; the quality's gradient stops at the layer that it shares with the features.
    """
    import torch
    from torch.nn.functional import linear, normalize, relu

    count, values = len(histograms), histograms.reshape(-1, histograms.shape[-1])
    if histogram == "roots":
        values = values.sqrt()
    gain = 1.0 if histogram == "counts" else INPUT_GAIN
    if kind == "pca":
        return (values - weights["mean"]) @ weights["components"].T, None
    if kind == "azimuth":
        hidden = _azimuth_hidden(values, gain, weights, dropout)
    else:
        hidden = _paper_hidden(values, gain, weights)
    vectors = linear(hidden, weights["out.weight"], weights["out.bias"])
    if "join.weight" in weights:
        vectors, join = normalize(vectors, dim=1).view(count, -1), weights["join.weight"]
        if around is not None:
            vectors = torch.cat([vectors, around.flatten(1)], dim=1)
            join = torch.cat(join.chunk(1 + around.shape[1]), dim=1)
        vectors = linear(vectors, join)
    if "quality.0.bias" not in weights:
        return vectors, None
    judged = relu(linear(hidden.detach().view(count, -1), weights["quality.0.weight"], weights["quality.0.bias"]))
    return vectors, linear(judged, weights["quality.1.weight"], weights["quality.1.bias"])[:, 0]


def _azimuth_hidden(values: "Tensor", gain: float, weights: "dict[str, Tensor]", drop: float) -> "Tensor":
    import torch
    from torch.nn.functional import dropout, linear, relu

    columns = values.view(len(values), AZIMUTH_BINS, -1)
    if torch.is_autocast_enabled(columns.device.type):
        # Once, where each product would do so for itself.
        columns = columns.to(torch.get_autocast_dtype(columns.device.type))
    for i in range(3):
        # As linear and roll: a circular convolution of torch is nine times slower on processors. The gain multiplies
        # the weights, which are fewer.
        weight, bias = weights[f"columns.{i}.weight"], weights[f"columns.{i}.bias"]
        taps = (gain * weight if i == 0 else weight).chunk(3, dim=1)
        before, same, after = linear(columns, taps[0]), linear(columns, taps[1], bias), linear(columns, taps[2])
        columns = relu(before.roll(1, dims=1) + same + after.roll(-1, dims=1))
    pooled = torch.cat([columns.amax(dim=1), columns.mean(dim=1)], dim=1)
    if drop:
        pooled = dropout(pooled, drop)
    return relu(linear(pooled, weights["hidden.weight"], weights["hidden.bias"]))


def _paper_hidden(values: "Tensor", gain: float, weights: "dict[str, Tensor]") -> "Tensor":
    from torch.nn.functional import linear, relu

    values = gain * values
    for i in range(5):
        values = relu(linear(values, weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]))
    return values
