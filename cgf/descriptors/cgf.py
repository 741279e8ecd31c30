"""Features from spherical histograms: the learned CGF, and their principal components."""

import threading

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from threadpoolctl import threadpool_limits

from cgf.descriptors.device import embed_on_device, requested_device
from cgf.descriptors.network import Network, load_network, unit_rows
from cgf.descriptors.pooling import add_context, pool_features
from cgf.descriptors.settings import DescriptorSettings, histogram_size
from cgf.descriptors.spherical_histogram import histogram_grid
from cgf.descriptors.tile_layout import histogram_room
from cgf.geometry.lrf import estimate_lrf
from cgf.geometry.parallel import for_each_block
from cgf.types import Features, IsCancelled, PointCloud, Progress, raise_if_cancelled

_BLOCK, _TILED_BLOCK = 64, 128
"""Points described at a time by one thread, without tiles and with them, which take half the memory."""


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

        The learned features are averaged over those of `indices` that lie within the innermost shell of each, or joined
        with their means within the radii of the network's card.

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
        device = requested_device()
        if device is not None:
            return self._describe_on(device, cloud, rows, frames, progress=progress, cancelled=cancelled)
        grid = histogram_grid(
            cloud.points,
            support_radius=settings.support_radius,
            min_radius=settings.min_radius,
            normals=cloud.normals if card.oriented else None,
        )
        vectors = self._room(len(rows))
        quality = np.empty(len(rows), np.float32) if self.network.judges else None
        filled = np.ones(len(rows), dtype=np.bool_)
        kept = threading.local()

        takes_tiles = self.network.takes_tiles
        block = _TILED_BLOCK if takes_tiles else _BLOCK

        def fill(part: slice) -> None:
            raise_if_cancelled(cancelled)
            if not hasattr(kept, "room"):
                supports = block * len(card.insets)
                kept.room = (
                    histogram_room(supports)
                    if takes_tiles
                    else np.empty(supports * histogram_size(card.histogram), np.float32)
                )
            wanted = (cloud.points[rows[part]], frames[part])
            if takes_tiles:
                counts = grid.fill_tiles(*wanted, soft=card.soft, insets=card.insets, tiles=kept.room)
                embedded, judged = self.network.embed_tiles(kept.room, len(counts))
            else:
                histograms, counts = grid.nested_histograms(*wanted, soft=card.soft, insets=card.insets, room=kept.room)
                embedded, judged = self.network.embed_and_judge(histograms)
            vectors[:, part] = self._parts_of(embedded)
            if quality is not None:
                quality[part] = judged
            filled[part] = counts > 0

        def report(done: int) -> None:
            if progress is not None:
                progress(done / len(rows), "describing points")

        # Each of our threads multiplies its own matrices: quicker than all of them sharing one product.
        with threadpool_limits(1, user_api="blas"):
            for_each_block(fill, len(rows), block=block, finished=report)
        return self._features(cloud, rows, vectors, quality, filled)

    def _describe_on(
        self,
        device: str,
        cloud: PointCloud,
        rows: Int64[np.ndarray, "K"],
        frames: Float64[np.ndarray, "K 3 3"],
        *,
        progress: Progress | None,
        cancelled: IsCancelled | None,
    ) -> Features:
        settings, done = self.settings, 0
        vectors = self._room(len(rows))
        quality = np.empty(len(rows), np.float32) if self.network.judges else None
        counts = np.empty(len(rows), np.int64)
        for part, embedded, judged, found in embed_on_device(
            cloud,
            cloud.points[rows],
            frames,
            self.network,
            support_radius=settings.support_radius,
            min_radius=settings.min_radius,
            device=device,
            cancelled=cancelled,
        ):
            vectors[:, part], counts[part] = self._parts_of(embedded), found
            if quality is not None:
                quality[part] = judged
            done += len(part)
            if progress is not None:
                progress(done / len(rows), "describing points")
        return self._features(cloud, rows, vectors, quality, counts > 0)

    def _room(self, count: int) -> Float32[np.ndarray, "P {count} D"]:
        return np.empty((self.network.parts, count, self.network.card.dims[-1]), np.float32)

    def _parts_of(self, embedded: Float32[np.ndarray, "K W"]) -> Float32[np.ndarray, "P K D"]:
        return embedded.reshape(len(embedded), self.network.parts, -1).swapaxes(0, 1)

    def _features(
        self,
        cloud: PointCloud,
        rows: Int64[np.ndarray, "K"],
        parts: Float32[np.ndarray, "P K D"],
        quality: Float32[np.ndarray, "K"] | None,
        kept: Bool[np.ndarray, "K"],
    ) -> Features:
        """The features asked for, of what the network gave for `rows`."""
        if not kept.all():
            rows, parts = rows[kept], parts[:, kept]
            quality = None if quality is None else quality[kept]
        points, min_radius = cloud.points[rows], self.settings.min_radius
        if self.network.card.context:
            radii = tuple(share * min_radius for share in self.network.card.context)
            vectors = add_context(points, parts, radii=radii)
        elif self.network.card.pooled:
            vectors = pool_features(points, parts[0], radius=min_radius)
        else:
            vectors = parts[0]
        prefix = vectors[:, : self.settings.dim]
        prefix = unit_rows(prefix) if self.network.card.nested else np.ascontiguousarray(prefix)
        return Features(rows, prefix, self._name, quality)
