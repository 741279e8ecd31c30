"""What `cgf train` takes; apart from the recipes, so that its help needs no torch."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from cgf.descriptors.settings import MAX_INSET, MODEL_DEFAULTS, FrameKind, HistogramKind, ModelDefaults, ModelName

DeviceChoice = Literal["auto", "cpu", "cuda", "mps"]


@dataclass(frozen=True)
class TrainSettings:
    """Settings of `cgf train`, from meshes or from fragments with poses."""

    output: Path
    """Weights to write, NAME.safetensors; the card goes beside it, checkpoints into the folder NAME."""
    meshes: Path | None = None
    """Folder of meshes to render range images of."""
    scenes: tuple[Path, ...] = ()
    """Folders of fragments cloud_bin_N.ply with logs of their relative poses."""
    logs: tuple[str, ...] = ("gt.log",)
    """Names of those logs; every pair in them is trained on."""
    model: ModelName = "object"
    """Whose lengths to use: `object` takes shares of the diameter, `indoor` metres."""
    recipe: Literal["contrastive", "paper", "pca"] = "contrastive"
    """`paper` trains on 40 triplets a point for three epochs, `pca` fits principal components."""
    network: Literal["azimuth", "paper"] | None = None
    """None stands for `azimuth` (contrastive) or the paper's five hidden layers."""
    frame: FrameKind | None = None
    """Whose local reference frames; None stands for `normal` (contrastive) or `paper`."""
    histogram: HistogramKind | None = None
    """What the network is given of a histogram: shares, their square roots, or also the neighbours' normals.

    None stands for `normals` (contrastive, azimuth network), `roots` (one of these two) or `counts`.
    """
    dims: tuple[int, ...] = (8, 16, 24, 32, 64)
    """Widths of the feature; the recipes `paper` and `pca` take the last alone."""
    width: int = 192
    """Channels of the azimuth network; time and size grow with its square."""
    steps: int | None = None
    """Minibatches; none stands for 6,000 (contrastive) or three epochs (paper)."""
    support_radius: float | None = None
    """Of the largest support, in diameters or metres; None stands for the model's own."""
    min_radius: float | None = None
    """Of its innermost shell; None stands for the model's own."""
    insets: tuple[int, ...] = (0,)
    """Supports whose features are joined: by how many shells each is smaller than the largest."""
    context: tuple[float, ...] = ()
    """Radii, in innermost shells, within which means of features are joined with a point's own; none averages them."""
    join_steps: int = 1000
    """Minibatches, after the others, in which joining supports and context is learned."""
    batch: int = 512
    """Correspondences (contrastive) or triplets (paper) per minibatch."""
    overlaps_per_batch: int = 8
    """Overlapping pairs that the correspondences of one minibatch come from."""
    scenes_per_batch: int | None = None
    """Scenes, or meshes, that these are of; None stands for any number."""
    negatives: Literal["overlap", "place"] = "overlap"
    """Which partners of others in a scene are negatives: those of the same overlap, or of all whose poses are known."""
    learning_rate: float | None = None
    """None stands for 1e-3 (contrastive) or the paper's 1e-4."""
    temperature: float = 0.07
    """Of the contrastive loss."""
    weight_decay: float = 0.01
    """Of the contrastive recipe (AdamW)."""
    dropout: float = 0.0
    """Share of what the azimuth network knows of all sectors together that is lost at random."""
    view_sets: int = 2
    """Sets of 14 range images per mesh, each turned anew."""
    noise: tuple[float, float] = (0.0, 0.004)
    """Range of the standard deviation of the noise in range images, in diameters."""
    voxel_sizes: tuple[float, ...] = ()
    """For scenes: densities to train on, in metres; none stands for the model's own."""
    normal_radii: tuple[float, ...] = ()
    """In voxels: normals are estimated again within these, and each cloud takes one of all its estimates at a time."""
    stretch: float = 0.0
    """Clouds are stretched along random axes by up to 1 plus this, or shrunk by as much."""
    bend: float = 0.0
    """Clouds are bent by four waves, each of which stretches them by up to this."""
    mirror: float = 0.0
    """Share of the overlaps that are mirrored."""
    holes: float = 0.0
    """Share of the clouds that holes are cut into."""
    cut: float = 0.0
    """Share of the clouds that are cut off at a random plane."""
    precision: Literal["bfloat16", "float32"] = "float32"
    """bfloat16 is three times faster on processors with AMX."""
    device: DeviceChoice = "cpu"
    """Where the network is trained; `auto` takes a GPU where there is one. Batches are drawn on the processor."""
    threads: int = 1
    """Of torch; results are repeatable to the bit for the same number."""
    checkpoint_every: int = 100
    """Minibatches between checkpoints."""
    seed: int = 1

    def config(self) -> dict[str, Any]:
        """All but the output, as a card keeps them: in the types of JSON, and folders by their names."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "output"}
        return {name: _as_json(value) for name, value in values.items()}

    def __post_init__(self) -> None:
        if (self.meshes is None) == (not self.scenes):
            raise ValueError(
                "one of --meshes and --scenes must be given, got " + ("both" if self.scenes else "neither")
            )
        if self.output.suffix != ".safetensors":
            raise ValueError(f"--output must end in .safetensors, got {self.output}")
        if self.batch % self.overlaps_per_batch:
            raise ValueError(
                f"--batch must be a multiple of --overlaps-per-batch ({self.overlaps_per_batch}), got {self.batch}"
            )
        if not self.dims or list(self.dims) != sorted(set(self.dims)) or self.dims[0] < 1:
            raise ValueError(f"--dims must be ascending and positive, got {self.dims}")
        if not 0 < self.lengths.min_radius < self.lengths.support_radius:
            raise ValueError(
                "--min-radius must be above 0 and below --support-radius, got "
                f"{self.lengths.min_radius:g} and {self.lengths.support_radius:g}"
            )
        if list(self.insets) != sorted(set(self.insets)) or self.insets[:1] != (0,) or self.insets[-1] > MAX_INSET:
            raise ValueError(f"--insets must be 0 and ascending numbers up to {MAX_INSET}, got {self.insets}")
        if len(self.insets) > 1 and (self.chosen_network != "azimuth" or not self.contrastive):
            raise ValueError(
                f"--insets must be 0 but for the azimuth network and contrastive recipe, got {self.insets}"
            )
        if list(self.context) != sorted(set(self.context)) or not all(radius > 0 for radius in self.context):
            raise ValueError(f"--context must be positive and ascending, got {self.context}")
        if self.context and not self.contrastive:
            raise ValueError(f"--context must come with the contrastive recipe, got the recipe {self.recipe}")
        possible: tuple[HistogramKind, ...] = ("roots", "counts")
        if self.chosen_network == "azimuth":
            possible = ("normals", "roots") if self.contrastive else ("roots",)
        if self.recipe == "pca":
            possible = ("counts",)
        if self.chosen_histogram not in possible:
            raise ValueError(
                f"--histogram must be {' or '.join(possible)} for the {self.chosen_network} network and the recipe "
                f"{self.recipe}, got {self.histogram}"
            )
        if self.join_steps < 1:
            raise ValueError(f"--join-steps must be 1 or more, got {self.join_steps}")
        if not all(radius > 0 for radius in self.normal_radii):
            raise ValueError(f"--normal-radii must be positive, got {self.normal_radii}")
        if not self.weight_decay >= 0:
            raise ValueError(f"--weight-decay must be 0 or more, got {self.weight_decay:g}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"--dropout must be 0 or more and below 1, got {self.dropout:g}")
        if self.dropout and (self.chosen_network != "azimuth" or not self.contrastive):
            raise ValueError(
                f"--dropout must be 0 but for the azimuth network and contrastive recipe, got {self.dropout:g}"
            )
        if self.scenes_per_batch is not None and self.scenes_per_batch < 1:
            raise ValueError(f"--scenes-per-batch must be 1 or more, got {self.scenes_per_batch}")
        if not 0 <= self.bend < 0.5:
            raise ValueError(f"--bend must be 0 or more and below 0.5, got {self.bend:g}")
        for name in ("stretch", "mirror", "holes", "cut"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"--{name} must lie between 0 and 1, got {getattr(self, name):g}")

    @property
    def lengths(self) -> ModelDefaults:
        """The model's, with the radii that were chosen."""
        usual = MODEL_DEFAULTS[self.model]
        support_radius = usual.support_radius if self.support_radius is None else self.support_radius
        min_radius = usual.min_radius if self.min_radius is None else self.min_radius
        return replace(usual, support_radius=support_radius, min_radius=min_radius)

    @property
    def contrastive(self) -> bool:
        """Whether features are learned by contrast, so nested and of unit length."""
        return self.recipe == "contrastive"

    @property
    def chosen_network(self) -> Literal["azimuth", "paper"]:
        return self.network or ("azimuth" if self.contrastive else "paper")

    @property
    def chosen_frame(self) -> FrameKind:
        return self.frame or ("normal" if self.contrastive else "paper")

    @property
    def chosen_histogram(self) -> HistogramKind:
        if self.histogram is not None:
            return self.histogram
        if self.recipe == "pca":
            return "counts"
        if self.chosen_network == "azimuth":
            return "normals" if self.contrastive else "roots"
        return "roots" if self.contrastive else "counts"


def _as_json(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_json(part) for part in value]
    return value.resolve().name if isinstance(value, Path) else value
