"""What the page is told: plain values, ready to become JSON."""

from dataclasses import dataclass
from typing import Literal

from app.compare import ColumnInfo
from app.funnel import PickedInfo, Step
from app.settings import Coloring, Pose, Reference, ViewSettings
from app.tasks import Task


@dataclass(frozen=True)
class Status:
    """What the worker does."""

    phase: Literal["working", "ready", "failed"]
    text: str
    progress: float
    """Share done, from 0 to 1."""
    elapsed_s: float | None = None
    """How long the last change took, once it is done."""
    tasks: tuple[Task, ...] = ()
    """What panels have done beside the main work."""


@dataclass(frozen=True)
class CloudInfo:
    """One of the two clouds."""

    name: str
    points: int
    """In the file."""
    shown: int
    """Drawn: fewer where the file has very many."""
    prepared: int
    """After downsampling: those that features and matches count."""
    features: int | None


@dataclass(frozen=True)
class Unit:
    """How lengths are to be written."""

    name: Literal["m", "units"]
    diameter: float
    """Of the larger cloud; lengths of objects are understood as shares of it."""
    metres: float = 1.0
    """Length of one unit of the clouds, where `name` is m."""


@dataclass(frozen=True)
class Model:
    """Which weights and defaults, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Limits:
    """Range of a length's slider, in cloud units; other values may be typed."""

    low: float
    high: float
    default: float


@dataclass(frozen=True)
class Controls:
    """What each control of the page shows and offers."""

    descriptors: tuple[str, ...]
    dims: tuple[int, ...]
    dim: int
    """The one in use."""
    poses: tuple[Pose, ...]
    references: tuple[Reference, ...]
    colorings: tuple[Coloring, ...]
    support_radius: Limits
    lrf_radius: Limits
    voxel_size: Limits
    error_scale: Limits
    line_count: Limits
    point_size: Limits


@dataclass(frozen=True)
class Numbers:
    """The figures of merit of the matches that pass the filters."""

    matches: int
    with_partner: int
    """Those whose source point has a true partner."""
    right: int
    """Those within `precision_radius` among the latter."""
    precision: float | None
    """`right` over `with_partner`."""
    inlier_ratio: float | None
    """Share of all matches within `precision_radius`."""
    median_error: float | None
    """Of matches with a true partner, in cloud units."""
    precision_radius: float
    tau: float


@dataclass(frozen=True)
class Estimate:
    """The pose that was brought along, or estimated from the matches."""

    given: bool
    found: bool
    method: str
    fitness: float | None
    """Share of source points near the target after moving."""
    rmse: float | None
    rotation_error_deg: float | None
    """Against the ground truth; None without one."""
    translation_error: float | None


@dataclass(frozen=True)
class Curve:
    """Precision over the error that is still accepted."""

    thresholds: tuple[float, ...]
    precision: tuple[float, ...]
    count: int
    """Matches it is taken over."""


@dataclass(frozen=True)
class Swatch:
    """A colour with a meaning."""

    color: str
    label: str


@dataclass(frozen=True)
class Tick:
    """A mark along a ramp."""

    at: float
    label: str


@dataclass(frozen=True)
class Legend:
    """What the colours in the picture mean, from the functions that painted it."""

    coloring: Coloring
    title: str
    ramp: tuple[str, ...]
    """From no error to `scale`, or along `ticks`; empty where colours mean neither."""
    scale: float | None
    """In cloud units."""
    swatches: tuple[Swatch, ...]
    ticks: tuple[Tick, ...] = ()
    """Of a ramp that means something else than errors, from 0 to 1 along it."""


@dataclass(frozen=True)
class Message:
    """A line for the person."""

    level: Literal["error", "warning", "info"]
    text: str


@dataclass(frozen=True)
class DiagnosisInfo:
    """A diagnosis in short."""

    number: int
    """Grows with every diagnosis."""
    outcome: str
    verdict: str
    problems: int
    cautions: int


@dataclass(frozen=True)
class Snapshot:
    """The whole state of the page."""

    revision: int
    """Grows with every change but the status's."""
    status: Status
    settled: bool
    """Whether everything shown belongs to the settings shown."""
    previewed: int | None
    """Points whose features colour all others for the moment, while the numbers are still those before the change."""
    pairs: tuple[str, ...]
    settings: ViewSettings
    """As chosen; None where the default of `controls` holds."""
    source: CloudInfo | None
    target: CloudInfo | None
    unit: Unit | None
    model: Model | None
    controls: Controls | None
    pose: str | None
    """Where the source is drawn: one of `controls.poses`, a run, or None between two poses."""
    reference: Reference | None
    """What errors are measured against."""
    numbers: Numbers | None
    estimate: Estimate | None
    curve: Curve | None
    funnel: tuple[Step, ...]
    picked: PickedInfo | None
    legend: Legend | None
    messages: tuple[Message, ...]
    diagnosis: DiagnosisInfo | None
    """Whether the pair registers and why not; None until that is found out."""
    columns: tuple[ColumnInfo, ...]
    """What is compared, one beside the other; empty where it is the pair itself that is shown."""
    command: str
    """The command line that gives the same matches; empty where the pair has no files."""
    shared: str
    """The settings that differ from their defaults, as links and `--state` carry them."""
    open_command: str
    """The command line that opens the pair; with `shared` behind `--state`, it shows the same. Empty without files."""
