"""A first impression under new settings: a few points are described, and the others look like the nearest of them."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from app.shown import Shown, thinned_rows
from cgf import pipeline
from cgf.geometry import transforms
from cgf.geometry.neighbors import nearest
from cgf.types import Features, PointCloud, Transform

Rows = npt.NDArray[np.int64]


def choose_rows(
    source: PointCloud, target: PointCloud, *, count: int, target_from_source: Transform | None
) -> tuple[Rows, Rows]:
    """Rows of two prepared clouds, about `count` of each, spread evenly over the surface.

    Where a pose is known, half of the rows of each cloud are those nearest to the places of the other's: else hardly
    any point would have its true partner among so few, and all would look wrong.
    """
    if target_from_source is None:
        return thinned_rows(source.points, limit=count), thinned_rows(target.points, limit=count)
    source_rows = thinned_rows(source.points, limit=count // 2)
    target_rows = thinned_rows(target.points, limit=count // 2)
    back = transforms.invert(target_from_source)
    target_partners, _ = nearest(target.points, transforms.apply(target_from_source, source.points[source_rows]))
    source_partners, _ = nearest(source.points, transforms.apply(back, target.points[target_rows]))
    return np.union1d(source_rows, source_partners), np.union1d(target_rows, target_partners)


def borrowing(shown: Shown, prepared: PointCloud, features: Features) -> Shown:
    """The same points, each with the colour of the nearest prepared one that is described."""
    rows = features.indices[pipeline.nearest_described(prepared.points, prepared, features)]
    return replace(shown, prepared_rows=rows[shown.prepared_rows])
