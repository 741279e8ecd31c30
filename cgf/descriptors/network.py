"""The networks that compress a histogram, as plain matrix products; trained with torch in `cgf.training`.

Inference needs no torch: importing it takes seconds, and these are a few matrix products a point.
"""

import json
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float32

from cgf.descriptors.settings import (
    AZIMUTH_BINS,
    HISTOGRAM_BINS,
    INPUT_GAIN,
    MODEL_DEFAULTS,
    FrameKind,
    HistogramKind,
    ModelDefaults,
    ModelName,
    histogram_size,
)

if TYPE_CHECKING:
    from cgf.descriptors.amx import TiledNetwork
    from cgf.descriptors.precision import Precision
    from cgf.descriptors.tile_layout import Tiles
    from cgf.descriptors.vnni import ByteNetwork

NetworkKind = Literal["azimuth", "paper", "pca"]
Weights = dict[str, Float32[np.ndarray, "..."]]


@dataclass(frozen=True)
class NetworkCard:
    """What weights are, how they were made and what they reach; the JSON file beside them."""

    kind: NetworkKind
    model: ModelName
    dims: tuple[int, ...]
    """Widths that may be asked for, ascending; each is a prefix of the next where there are several."""
    frame: FrameKind
    relative: bool
    """Lengths below are shares of the diameter, else metres."""
    support_radius: float
    min_radius: float
    lrf_radius: float
    voxel_sizes: tuple[float, ...]
    command: str = ""
    """Remakes the weights."""
    data: str = ""
    seed: int = 0
    scores: dict[str, float] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    """Settings of `cgf train`, which `cgf train --config` reads; folders by their names."""
    histogram: HistogramKind = "normals"
    """What the network takes; all but counts are multiplied by `INPUT_GAIN`."""
    nested: bool = True
    """Whether features are compared at unit length, and those of fewer dimensions are prefixes of those of more."""
    pooled: bool = True
    """Whether features are averaged over the described points within `min_radius`."""
    insets: tuple[int, ...] = (0,)
    """The supports whose features are joined: by how many shells each is smaller than `support_radius`."""
    context: tuple[float, ...] = ()
    """Radii, in `min_radius`, within which means of the features around a point are joined with its own."""

    @property
    def soft(self) -> bool:
        """Whether the network takes histograms with soft azimuth sectors."""
        return self.kind == "azimuth"

    @property
    def oriented(self) -> bool:
        """Whether the network takes histograms with the normals of neighbours."""
        return self.histogram == "normals"

    def defaults(self) -> ModelDefaults:
        """The model's defaults, with the lengths that these weights were trained with."""
        return replace(
            MODEL_DEFAULTS[self.model],
            voxel_size=self.voxel_sizes[0],
            support_radius=self.support_radius,
            min_radius=self.min_radius,
            lrf_radius=self.lrf_radius,
        )

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str, *, source: str) -> "NetworkCard":
        """Read a card.

        Raises:
            ValueError: The text is no card; the sentence names `source`.
        """
        try:
            values = json.loads(text)
            # Cards written before these could be chosen.
            learned = dict.fromkeys(("nested", "pooled"), values["kind"] == "azimuth")
            has_roots = values.pop("root", values["kind"] == "azimuth")
            values = learned | {"histogram": "roots" if has_roots else "counts"} | values
            for name in ("dims", "voxel_sizes", "insets", "context"):
                if name in values:
                    values[name] = tuple(values[name])
            return cls(**values)
        except (KeyError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"{source} must be a network card written by cgf train, got: {error}") from error


@dataclass(frozen=True, eq=False)
class Network:
    """Weights with their card; call `embed` on histograms."""

    card: NetworkCard
    weights: Weights

    def __post_init__(self) -> None:
        expected = expected_shapes(self.card, self.weights)
        for name, shape in expected.items():
            found = self.weights[name].shape if name in self.weights else "none"
            if found != shape:
                raise ValueError(
                    f"weights must fit their card ({self.card.kind}, {self.card.dims[-1]} dimensions): "
                    f"{name} must have shape {shape}, got {found}"
                )

    def embed(self, histograms: Float32[np.ndarray, "K *S B"]) -> Float32[np.ndarray, "K D"]:
        """Map histograms of the card's kind to vectors of the largest of the card's dimensions.

        Nested ones are unit length, and so is every prefix once it is divided by its length. Where the card has a
        context, they are not: they are the parts that `cgf.descriptors.pooling.add_context` takes, side by side.

        Args:
            histograms: Of the card's supports, in their order; without that axis where there is one.
        """
        return self.embed_and_judge(histograms)[0]

    def embed_and_judge(
        self, histograms: Float32[np.ndarray, "K *S B"]
    ) -> tuple[Float32[np.ndarray, "K D"], Float32[np.ndarray, "K"] | None]:
        """The vectors of `embed`, and the quality of each as in `Features.quality`, if the network was taught it."""
        weights, count = self.weights, len(histograms)
        rows = histograms.reshape(-1, histograms.shape[-1])
        if self.card.kind == "pca":
            # Projection on the principal components of training histograms: the paper's linear baseline.
            return (rows - weights["mean"]) @ weights["components"].T, None
        return self._outputs(self._hidden(rows), count)

    def embed_tiles(
        self, tiles: "Tiles", count: int
    ) -> tuple[Float32[np.ndarray, "{count} D"], Float32[np.ndarray, "{count}"] | None]:
        """As `embed_and_judge`, of `count` points whose histograms `HistogramGrid.fill_tiles` wrote."""
        return self._outputs(self._tiled.hidden_of_tiles(tiles, count * len(self.card.insets)), count)

    @property
    def takes_tiles(self) -> bool:
        """Whether `embed_tiles` can be used: for networks that know normals, on processors that multiply tiles.

        Raises:
            ValueError: The environment asks for a precision that there is not.
        """
        return self.card.oriented and self.precision == "bfloat16"

    @property
    def precision(self) -> "Precision":
        """In which numbers this processor computes most of the network.

        Raises:
            ValueError: The environment asks for a precision that there is not.
        """
        # Compiled, so imported only where features are computed: reading a card takes no time.
        from cgf.descriptors.precision import chosen_precision

        chosen = chosen_precision()
        can_round = self.card.kind == "azimuth" and (chosen == "bfloat16" or self.card.oriented)
        return chosen if can_round else "float32"

    def _outputs(
        self, hidden: Float32[np.ndarray, "R H"], count: int
    ) -> tuple[Float32[np.ndarray, "{count} D"], Float32[np.ndarray, "{count}"] | None]:
        weights = self.weights
        vectors = _linear(hidden, weights, "out")
        if self.card.nested:
            vectors = unit_rows(vectors)
        if "join.weight" in weights:
            vectors = vectors.reshape(count, -1) @ weights["join.weight"].T
            if not self.card.context:
                vectors = unit_rows(vectors)
        if not self.judges:
            return vectors, None
        logits = _linear(_linear_relu(hidden.reshape(count, -1), weights, "quality.0"), weights, "quality.1")[:, 0]
        return vectors, np.exp(-np.logaddexp(0, -logits))

    @property
    def parts(self) -> int:
        """How many vectors of the largest of the card's dimensions `embed` gives for a point, side by side."""
        return 1 + len(self.card.context)

    @property
    def judges(self) -> bool:
        """Whether the network was taught the quality of its features."""
        return "quality.0.bias" in self.weights

    def _hidden(self, histograms: Float32[np.ndarray, "K B"]) -> Float32[np.ndarray, "K H"]:
        precision = self.precision
        if precision == "bfloat16":
            return self._tiled.hidden(histograms)
        if precision == "int8":
            return _linear_relu(self._bytes.pooled(histograms), self.weights, "hidden")
        values = histograms
        if self.card.histogram != "counts":
            values = (np.sqrt(values) if self.card.histogram == "roots" else values) * np.float32(INPUT_GAIN)
        if self.card.kind == "paper":
            return _paper_hidden(values, self.weights)
        return _azimuth_hidden(values, self._filtered)

    @cached_property
    def _tiled(self) -> "TiledNetwork":
        from cgf.descriptors.amx import pack_network

        return pack_network(self.weights, self.card.histogram)

    @cached_property
    def _bytes(self) -> "ByteNetwork":
        from cgf.descriptors.vnni import pack_network

        return pack_network(self.weights)

    @cached_property
    def _filtered(self) -> Weights:
        """The weights, with what `convolve_filled` and `convolve_circularly` take."""
        from cgf.descriptors.convolution import filter_tiles, pack_bins

        layers = {f"tiles.{i}": filter_tiles(self.weights[f"columns.{i}.weight"]) for i in range(3)}
        if self.card.oriented:
            layers["bins"] = pack_bins(self.weights["columns.0.weight"])
            del layers["tiles.0"]
        return self.weights | layers


def expected_shapes(card: NetworkCard, weights: Weights) -> dict[str, tuple[int, ...]]:
    """Shape of every array that a network of this kind needs; widths of hidden layers are read off `weights`."""
    dim = card.dims[-1]
    if card.kind == "pca":
        return {"mean": (HISTOGRAM_BINS,), "components": (dim, HISTOGRAM_BINS)}
    if card.kind == "paper":
        shapes = _layers({f"layers.{i}": shape for i, shape in enumerate(pairwise([HISTOGRAM_BINS, *[512] * 5]))})
        hidden = 512
    else:
        channels = [len(weights.get(f"columns.{i}.bias", ())) for i in range(3)]
        widths = [histogram_size(card.histogram) // AZIMUTH_BINS, *channels]
        hidden = len(weights.get("hidden.bias", ()))
        shapes = _layers({f"columns.{i}": (3 * a, b) for i, (a, b) in enumerate(pairwise(widths))})
        shapes |= _layers({"hidden": (2 * widths[-1], hidden)})
    supports = len(card.insets)
    if supports > 1 or card.context:
        shapes["join.weight"] = ((1 + len(card.context)) * dim, supports * dim)
    if "quality.0.bias" in weights:
        judged = len(weights["quality.0.bias"])
        shapes |= _layers({"quality.0": (supports * hidden, judged), "quality.1": (judged, 1)})
    return shapes | _layers({"out": (hidden, dim)})


def _layers(widths: dict[str, tuple[int, int]]) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of linear layers, given their inputs and outputs."""
    return {f"{name}.weight": (b, a) for name, (a, b) in widths.items()} | {
        f"{name}.bias": (b,) for name, (_, b) in widths.items()
    }


def unit_rows(vectors: Float32[np.ndarray, "K D"]) -> Float32[np.ndarray, "K D"]:
    """Rows divided by their length; rows of length zero stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.float32(1.0))


def _azimuth_hidden(values: Float32[np.ndarray, "K B"], weights: Weights) -> Float32[np.ndarray, "K H"]:
    """Circular convolutions over the 12 azimuth columns, then their maximum and mean: turning x changes little."""
    from cgf.descriptors.convolution import convolve_circularly, convolve_filled

    if "bins" in weights:
        columns = convolve_filled(values, weights["bins"], weights["columns.0.bias"])
    else:
        # Azimuth first, so that a column of all points is one matrix.
        columns = np.ascontiguousarray(values.reshape(len(values), AZIMUTH_BINS, -1).transpose(1, 0, 2))
        columns = convolve_circularly(columns, weights["tiles.0"], weights["columns.0.bias"])
    for i in (1, 2):
        columns = convolve_circularly(columns, weights[f"tiles.{i}"], weights[f"columns.{i}.bias"])
    pooled = np.concatenate([columns.max(axis=0), columns.mean(axis=0)], axis=1)
    return _linear_relu(pooled, weights, "hidden")


def _paper_hidden(values: Float32[np.ndarray, "K 2244"], weights: Weights) -> Float32[np.ndarray, "K 512"]:
    """Five hidden layers of 512 with max(., 0), as in section 5 of the paper."""
    for i in range(5):
        values = _linear_relu(values, weights, f"layers.{i}")
    return values


def _linear_relu(values: Float32[np.ndarray, "K A"], weights: Weights, name: str) -> Float32[np.ndarray, "K B"]:
    return np.maximum(_linear(values, weights, name), 0)


def _linear(values: Float32[np.ndarray, "K A"], weights: Weights, name: str) -> Float32[np.ndarray, "K B"]:
    return values @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def read_network(path: Path) -> Network:
    """Read `NAME.safetensors` and the card `NAME.json` beside it.

    Raises:
        ValueError: A file is missing, broken, or the two contradict each other.
    """
    from safetensors.numpy import load_file

    card_path = path.with_suffix(".json")
    for file in (path, card_path):
        if not file.is_file():
            raise ValueError(f"weights must consist of {path.name} and {card_path.name}, got no file {file}")
    card = NetworkCard.from_json(card_path.read_text(), source=str(card_path))
    try:
        weights = load_file(path)
    except Exception as error:  # The reader's own exception class is not part of its public interface.
        raise ValueError(f"{path} must be a safetensors file, got: {error}") from error
    return Network(card, {name: np.asarray(values, np.float32) for name, values in weights.items()})


def write_network(path: Path, network: Network) -> None:
    """Write the weights, in half precision where that loses nothing, and, beside them, their card."""
    from safetensors.numpy import save

    halves = {name: values.astype(np.float16) for name, values in network.weights.items()}
    stored = {
        name: half if (half == network.weights[name]).all() else network.weights[name] for name, half in halves.items()
    }
    # Not its `save_file`, whose files nobody else may read.
    path.write_bytes(save(stored))
    path.with_suffix(".json").write_text(network.card.to_json())


def shipped_weights(name: str) -> Path:
    """Path of weights that come with the package, e.g. `cgf-object`."""
    return Path(str(resources.files("cgf.descriptors") / "weights" / f"{name}.safetensors"))


@lru_cache(maxsize=8)
def load_network(name: str, model: ModelName | None, weights: Path | None = None) -> Network:
    """Weights that come with the package, e.g. `cgf` trained on `object`; or others, for `cgf`, of any model if None.

    Raises:
        ValueError: There are none, or they contradict their card or what is asked of them.
    """
    if weights is None:
        return read_network(shipped_weights(f"{name}-{model}"))
    network = read_network(weights)
    if name != "cgf":
        raise ValueError(f"weights must be for descriptor cgf, got {weights} for descriptor {name}")
    if model not in (None, network.card.model):
        raise ValueError(f"weights must be trained for model {model}, got {network.card.model} from {weights}")
    return network
