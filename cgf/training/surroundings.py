"""Features of all points of the training clouds, for a network that joins a feature with those around it."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int64

from cgf.descriptors.network import Network
from cgf.descriptors.pooling import cell_means, pool_features
from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.parallel import for_each_block
from cgf.training.fragments import Fragments

_BLOCK = 64


class Surroundings:
    """Describes each cloud, as it is, when its first point is asked for, and keeps its features at half precision."""

    def __init__(self, fragments: Fragments, network: Network, *, insets: tuple[int, ...], radii: tuple[float, ...]):
        """Nothing is described yet.

        Args:
            fragments: Whose clouds have normals.
            network: Describes one support.
            insets: Of the supports, as of the histograms; their features stand side by side.
            radii: Within which means are taken, in the unit of the clouds.
        """
        self._fragments, self._network, self._insets, self._radii = fragments, network, insets, radii
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
        card, points, normals = self._network.card, *self._cloud(cloud)
        frames, defined = estimate_lrf(points, normals, np.arange(len(points)), radius=card.lrf_radius, kind=card.frame)
        centers, frames = points[defined], frames[defined]
        grid = histogram_grid(
            points,
            support_radius=card.support_radius,
            min_radius=card.min_radius,
            normals=normals if card.oriented else None,
        )
        features = np.empty((len(centers), len(self._insets) * card.dims[-1]), np.float16)
        filled = np.ones(len(centers), np.bool_)

        def fill(part: slice) -> None:
            histograms, counts = grid.nested_histograms(
                centers[part], frames[part], soft=card.soft, insets=self._insets
            )
            vectors = self._network.embed(histograms.reshape(-1, histograms.shape[-1]))
            features[part], filled[part] = vectors.reshape(len(counts), -1), counts > 0

        for_each_block(fill, len(centers), block=_BLOCK)
        return centers[filled], features[filled]

    def _cloud(self, number: int) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
        cloud = self._fragments.clouds[number]
        assert cloud.normals is not None
        return cloud.points, cloud.normals
