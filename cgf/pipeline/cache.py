"""Features and matches that were computed before, on disk.

An entry is found by a digest of all that it follows from: the points and normals, every setting that matters, the
weights, and the source code that computes it. So an entry is never stale, only unused, and the longest unused ones go
first when there are too many. Frames and histograms are not kept: they take a tenth of the time of features, and 100 MB
of histograms for 10,000 points a quarter of that to read.
"""

import hashlib
import io
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from importlib import metadata, resources
from pathlib import Path

import numpy as np

from cgf.descriptors.device import requested_device
from cgf.descriptors.network import Network, load_network
from cgf.matching import MatchTable
from cgf.pipeline.settings import ResolvedSettings
from cgf.pipeline.stages import at_dim, describe, match_both_features
from cgf.types import Correspondences, Features, IsCancelled, PointCloud, Progress

MAX_BYTES = 1 << 30
"""Of all entries: some two hundred pairs of rooms."""
_DIGEST_BYTES = 32
_SUFFIX = ".cgf"
_ABANDONED_S = 3600.0
"""Age of a file half written that nobody will finish."""
_LIBRARIES = ("numpy", "numba", "scipy", "open3d")

Arrays = dict[str, np.ndarray]


def default_folder() -> Path:
    """`cgf-viewer` in the user's folder for caches: `$XDG_CACHE_HOME`, or else `~/.cache`."""
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The specification has relative paths ignored.
    return (home if home.is_absolute() else Path.home() / ".cache") / "cgf-viewer"


class DiskCache:
    """Arrays by key, in a folder of its own that several processes may share; errors of the disk only cost time."""

    def __init__(self, folder: Path | None = None, *, max_bytes: int = MAX_BYTES) -> None:
        """Keep entries in `folder`, by default the user's, of `max_bytes` altogether."""
        self.folder = default_folder() if folder is None else folder
        self._max_bytes = max_bytes

    def __contains__(self, key: str) -> bool:
        """Whether there is an entry of that name, sound or not."""
        return self._path(key).is_file()

    def get(self, key: str) -> Arrays | None:
        """The arrays kept under `key`; None where there are none, or they are damaged."""
        path = self._path(key)
        with suppress(OSError):
            content = path.read_bytes()
            digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
            if digest == _seal(key, payload):
                # The time of the last use, for the removal of the longest unused.
                os.utime(path)
                with np.load(io.BytesIO(payload), allow_pickle=False) as loaded:
                    return dict(loaded)
        return None

    def put(self, key: str, arrays: Arrays) -> None:
        """Keep `arrays` under `key` in place of what was there, and remove the longest unused entries if need be."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        payload = buffer.getvalue()
        if len(payload) > self._max_bytes // 4:
            return
        with suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            # Written aside and moved into place: whoever reads meanwhile finds a whole entry, old or new.
            handle, part = tempfile.mkstemp(dir=self.folder, suffix=".part")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(_seal(key, payload))
                    file.write(payload)
                Path(part).replace(self._path(key))
            finally:
                Path(part).unlink(missing_ok=True)
            self._evict()

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{_SUFFIX}"

    def _evict(self) -> None:
        entries = sorted(self._entries(), reverse=True)
        total = 0
        for _, size, path in entries:
            total += size
            if total > self._max_bytes:
                with suppress(OSError):
                    path.unlink()
        for path in self.folder.glob("*.part"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()

    def _entries(self) -> Iterator[tuple[float, int, Path]]:
        """Time of the last use, size and path of every entry; another process may remove them meanwhile."""
        for path in self.folder.glob(f"*{_SUFFIX}"):
            with suppress(OSError):
                found = path.stat()
                yield found.st_mtime, found.st_size, path


def feature_key(cloud: PointCloud, settings: ResolvedSettings) -> str:
    """A digest of all that `describe` depends on."""
    digest = hashlib.blake2b(code_version(), digest_size=_DIGEST_BYTES)
    lengths = (settings.support_radius, settings.min_radius, settings.lrf_radius)
    _add(digest.update, settings.descriptor, settings.model, settings.computed_dim, *lengths)
    if settings.descriptor in ("cgf", "pca"):
        network = load_network(settings.descriptor, settings.model, settings.weights)
        _add(digest.update, _network_digest(network), requested_device() or network.precision)
    _add(digest.update, cloud.points, cloud.normals)
    return digest.hexdigest()


def match_key(source: Features, target: Features) -> str:
    """A digest of all that `match` depends on."""
    digest = hashlib.blake2b(code_version(), digest_size=_DIGEST_BYTES)
    for features in (source, target):
        _add(digest.update, features.descriptor, features.indices, features.vectors, features.quality)
    return digest.hexdigest()


@lru_cache(maxsize=1)
def code_version() -> bytes:
    """A digest of the source code of this package and its libraries: with a change of any, nothing old is found."""
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    package = Path(str(resources.files("cgf")))
    for file in sorted(package.rglob("*.py")):
        _add(digest.update, str(file.relative_to(package)), file.read_bytes())
    for name in _LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            _add(digest.update, name, metadata.version(name))
    return digest.digest()


@lru_cache(maxsize=8)
def _network_digest(network: Network) -> bytes:
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    _add(digest.update, network.card.to_json())
    for name in sorted(network.weights):
        _add(digest.update, name, network.weights[name])
    return digest.digest()


def describe_cached(
    cloud: PointCloud,
    settings: ResolvedSettings,
    cache: DiskCache | None,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> Features:
    """What `describe` gives, from `cache` where it holds it; arguments and errors as there."""
    if cache is None:
        return describe(cloud, settings, progress=progress, cancelled=cancelled)
    key = feature_key(cloud, settings)
    arrays = cache.get(key)
    if arrays is not None:
        return Features(arrays["indices"], arrays["vectors"], settings.descriptor, arrays.get("quality"))
    features = describe(cloud, settings, progress=progress, cancelled=cancelled)
    arrays = {"indices": features.indices, "vectors": features.vectors}
    cache.put(key, arrays if features.quality is None else arrays | {"quality": features.quality})
    return features


def match_both_cached(
    source: Features,
    target: Features,
    settings: ResolvedSettings,
    cache: DiskCache | None,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> tuple[MatchTable, MatchTable]:
    """What `match_both_features` gives, from `cache` where it holds it; arguments and errors as there."""
    if cache is None:
        return match_both_features(source, target, settings, progress=progress, cancelled=cancelled)
    key = match_key(at_dim(source, settings), at_dim(target, settings))
    arrays = cache.get(key)
    if arrays is not None:
        return _table_of(arrays, "forward"), _table_of(arrays, "back")
    forward, back = match_both_features(source, target, settings, progress=progress, cancelled=cancelled)
    cache.put(key, _arrays_of(forward, "forward") | _arrays_of(back, "back"))
    return forward, back


def _arrays_of(table: MatchTable, name: str) -> Arrays:
    found = table.correspondences
    arrays = {"indices": found.indices, "distances": found.distances, "ratios": found.ratios, "mutual": table.mutual}
    if table.source_quality is not None and table.target_quality is not None:
        arrays |= {"source_quality": table.source_quality, "target_quality": table.target_quality}
    return {f"{name} {key}": values for key, values in arrays.items()}


def _table_of(arrays: Arrays, name: str) -> MatchTable:
    found = Correspondences(*(arrays[f"{name} {key}"] for key in ("indices", "distances", "ratios")))
    qualities = (arrays.get(f"{name} {key}") for key in ("source_quality", "target_quality"))
    return MatchTable(found, arrays[f"{name} mutual"], *qualities)


def _seal(key: str, payload: bytes) -> bytes:
    """Tells an entry of ours from a damaged or a foreign one, and from one of another name."""
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    _add(digest.update, key, payload)
    return digest.digest()


def _add(update: Callable[[bytes], object], *values: object) -> None:
    """Feed values to a digest, each with its kind and size, so that no two sequences of them look alike."""
    for value in values:
        if isinstance(value, np.ndarray):
            _add(update, str(value.dtype), value.shape)
            update(value.tobytes())
            continue
        content = value if isinstance(value, bytes) else repr(value).encode()
        update(f"{type(value).__name__} {len(content)} ".encode())
        update(content)
