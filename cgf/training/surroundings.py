"""Features of all points of the training clouds, for a network that joins a feature with those around it."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int64

from cgf.descriptors.cgf import HistogramDescriptor
from cgf.descriptors.network import Network
from cgf.descriptors.pooling import cell_means, pool_features
from cgf.descriptors.settings import DescriptorSettings
from cgf.descriptors.spherical_histogram import nested_scales
from cgf.training.fragments import Fragments


class Surroundings:
    """Describes each cloud, as it is, when its first point is asked for, and keeps its features at half precision."""

    def __init__(
        self, fragments: Fragments, network: Network, *, insets: tuple[int, ...], context: tuple[float, ...]
    ) -> None:
        """Nothing is described yet.

        Args:
            fragments: Whose clouds have normals.
            network: Describes one support, the largest with the lengths of its card.
            insets: Of the supports, as of the histograms; their features stand side by side.
            context: Radii, in innermost shells, within which means are taken.
        """
        card = network.card
        single = replace(network, card=replace(card, pooled=False))
        self._fragments, self._radii = fragments, tuple(radius * card.min_radius for radius in context)
        self._descriptors = []
        for scale in nested_scales(insets, support_radius=card.support_radius, min_radius=card.min_radius):
            settings = DescriptorSettings(
                support_radius=scale * card.support_radius,
                min_radius=scale * card.min_radius,
                lrf_radius=card.lrf_radius,
                dim=card.dims[-1],
                model=card.model,
            )
            self._descriptors.append(HistogramDescriptor("cgf", settings, network=single))
        self._described = lru_cache(maxsize=None)(self._describe)

    def around(self, cloud: int, rows: Int64[np.ndarray, "K"]) -> Float32[np.ndarray, "K C W"]:
        """Means around the points `rows` of a cloud, within each radius."""
        points, features = self._described(cloud)
        at = self._fragments.clouds[cloud].points[rows]
        low, high = at.min(axis=0) - self._radii[-1], at.max(axis=0) + self._radii[-1]
        near = ((points >= low) & (points <= high)).all(axis=1)
        points, vectors = points[near], features[near].astype(np.float32)
        means = [
            pool_features(*cell_means(points, vectors, radius=radius), radius=radius, at=at) for radius in self._radii
        ]
        return np.stack(means, axis=1)

    def _describe(self, cloud: int) -> tuple[Float64[np.ndarray, "N 3"], Float16[np.ndarray, "N W"]]:
        described = self._fragments.clouds[cloud]
        found = [descriptor.describe(described, np.arange(len(described))) for descriptor in self._descriptors]
        # Those that have a neighbour in the smallest support have one in all.
        rows = found[-1].indices
        vectors = [features.vectors[np.isin(features.indices, rows)] for features in found]
        return described.points[rows], np.concatenate(vectors, axis=1).astype(np.float16)
