"""Features from spherical histograms: the learned CGF, and their principal components."""

import numpy as np
from jaxtyping import Float64, Int64
from threadpoolctl import threadpool_limits

from cgf.descriptors.network import Network, load_network, unit_rows
from cgf.descriptors.settings import AZIMUTH_BINS, DescriptorSettings
from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.parallel import for_each_block
from cgf.types import Features, IsCancelled, PointCloud, Progress, raise_if_cancelled

_BLOCK = 96
"""Points described at a time by one thread; what the network computes for them stays in the processor's cache."""


class HistogramDescriptor:
    """Frame, histogram and network for each point; `name` is `cgf` or `pca`."""

    def __init__(self, name: str, settings: DescriptorSettings, *, network: Network | None = None) -> None:
        self._name = name
        self.settings = settings
        self.network = load_network(name, settings.model, settings.weights) if network is None else network
        if settings.dim > self.network.card.dims[-1]:
            raise ValueError(f"dim must be {self.network.card.dims[-1]} or less, got {settings.dim}")

    @property
    def name(self) -> str:
        """`cgf` or `pca`."""
        return self._name

    @property
    def dim(self) -> int:
        """Columns of the features."""
        return self.settings.dim

    def describe(
        self,
        cloud: PointCloud,
        indices: Int64[np.ndarray, "K"],
        *,
        progress: Progress | None = None,
        cancelled: IsCancelled | None = None,
    ) -> Features:
        """Describe rows `indices` of `cloud`; points without a frame or a neighbour are left out.

        Args:
            cloud: Prepared at about the density the network was trained on, with normals.
            indices: Rows of `cloud`.
            progress: Told the share of points done.
            cancelled: Asked between blocks.

        Raises:
            ValueError: The cloud has no normals.
            Cancelled: `cancelled` returned True.
        """
        if cloud.normals is None:
            raise ValueError("cloud must have normals, got none; estimate them first")
        card, settings = self.network.card, self.settings
        frames, defined = estimate_lrf(
            cloud.points, cloud.normals, indices, radius=settings.lrf_radius, kind=card.frame
        )
        rows, frames = indices[defined], frames[defined]
        grid = histogram_grid(cloud.points, support_radius=settings.support_radius, min_radius=settings.min_radius)
        vectors = np.empty((len(rows), settings.dim), np.float32)
        filled = np.ones(len(rows), dtype=np.bool_)

        def fill(part: slice) -> None:
            raise_if_cancelled(cancelled)
            centers = cloud.points[rows[part]]
            histograms, counts = grid.histograms(centers, frames[part])
            embedded = self.network.embed(histograms)
            if card.kind == "azimuth":
                embedded += self.network.embed(grid.histograms(centers, _half_sector_turn(frames[part]))[0])
                embedded = unit_rows(embedded[:, : settings.dim])
            vectors[part] = embedded[:, : settings.dim]
            filled[part] = counts > 0

        def report(done: int) -> None:
            if progress is not None:
                progress(done / len(rows), "describing points")

        # Each of our threads multiplies its own matrices: quicker than all of them sharing one product.
        with threadpool_limits(1, user_api="blas"):
            for_each_block(fill, len(rows), block=_BLOCK, finished=report)
        return Features(rows[filled], vectors[filled], self._name)


def _half_sector_turn(frames: Float64[np.ndarray, "K 3 3"]) -> Float64[np.ndarray, "K 3 3"]:
    """Frames turned about z by half an azimuth bin.

    The network does not see turns by whole bins; the mean over two half a bin apart sees less of those in between:
    40.3 instead of 39.0 % of matches within 10 cm on the validation room.
    """
    angle = np.pi / AZIMUTH_BINS
    x, y = frames[:, 0], frames[:, 1]
    return np.stack(
        [np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, frames[:, 2]], axis=1
    )
