import numpy as np

from cgf.descriptors.settings import COLUMN_BINS, HISTOGRAM_BINS, histogram_size


def random_histograms(count, histogram):
    """Rows like those of a cloud, of which a few bins hold most of the neighbours."""
    rng = np.random.default_rng(2)
    rows = rng.random((count, HISTOGRAM_BINS), dtype=np.float32) ** 8
    rows /= rows.sum(axis=1, keepdims=True)
    if histogram != "normals":
        return rows
    roots = np.sqrt(rows).reshape(count, 12, 1, COLUMN_BINS)
    means = rng.uniform(-1, 1, size=(count, 12, 3, COLUMN_BINS)).astype(np.float32)
    return np.concatenate([roots, roots * means], axis=2).reshape(count, histogram_size(histogram))
