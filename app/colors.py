"""Colours of points and lines, and the legend that explains them; plain arrays in, bytes out."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.settings import Palette
from cgf.pipeline import REJECTIONS, Rejection

Colors = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

# Each runs from an exact match to a useless one. None of their colours is brighter or purer than what the tone-mapped
# lines can show, and all are told apart under each kind of colour blindness.
_ANCHORS: dict[Palette, tuple[tuple[int, int, int], ...]] = {
    # As in the paper's error figure, light to black. Lightness falls steadily, so the order survives a black-and-white
    # print.
    "paper": ((227, 225, 158), (229, 196, 112), (224, 150, 88), (205, 103, 92), (164, 66, 104), (112, 44, 102),
              (62, 26, 74), (24, 12, 32), (0, 0, 0)),
    # Like matplotlib's, but dimmer at the light end, for the lines. Nothing is black, so all of it stands out from a
    # dark ground.
    "viridis": ((224, 212, 84), (176, 208, 58), (122, 196, 84), (72, 178, 112), (38, 152, 132), (40, 122, 140),
                (50, 92, 140), (62, 60, 128), (66, 30, 104), (50, 4, 66)),
    # Good and bad in two hues, for projectors that wash out shades; both ends are darker than the middle.
    "blue_orange": ((20, 84, 168), (44, 112, 196), (84, 150, 214), (140, 188, 224), (200, 216, 222), (224, 206, 170),
                    (222, 164, 96), (204, 116, 44), (166, 72, 18), (111, 36, 8), (70, 18, 4)),
}  # fmt: skip
NO_PARTNER: tuple[int, int, int] = (138, 150, 166)
"""Points whose true position lies where the other cloud has no points: no match can be right."""
NO_MATCH: tuple[int, int, int] = (72, 84, 102)
"""Points without a feature, or whose match a filter took away."""
UNJUDGED: tuple[int, int, int] = (126, 176, 214)
"""Lines whose error is not known because no pose is."""
SOURCE_TINT: tuple[int, int, int] = (240, 178, 92)
TARGET_TINT: tuple[int, int, int] = (96, 178, 236)
STAGE_COLORS: dict[Rejection, tuple[int, int, int]] = {
    "no_frame": NO_MATCH,
    "no_feature": (46, 56, 74),
    "no_partner": NO_PARTNER,
    "not_mutual": (150, 96, 190),
    "above_ratio": (72, 136, 214),
    "unsure": (58, 156, 140),
    "outlier": (214, 92, 44),
    "none": (229, 222, 120),
}
"""Points and matches by the stage that rejects them; told apart by lightness too."""
PICKED: tuple[int, int, int] = (70, 224, 240)
"""The point that was picked: this hue and the next are in no ramp, and stand out from both themes."""
PARTNER: tuple[int, int, int] = (240, 72, 160)
"""Its true partner."""
AXES: Colors = np.array([(226, 74, 74), (96, 200, 90), (84, 132, 240)], dtype=np.uint8)
"""Of a frame: x, y, z."""
_LEVELS = 256


@dataclass(frozen=True, eq=False)
class FeatureBasis:
    """Linear map from feature space to red, green, blue; one for both clouds, so that equal features look equal."""

    mean: Floats
    axes: Floats
    """(D, 3), columns are principal directions."""
    low: Floats
    high: Floats
    """Projections shown as darkest and brightest, per colour channel."""


def _oklab(rgb: Floats) -> Floats:
    """Turn sRGB in [0, 1] into OKLab, in which equal steps look equal."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lms = linear @ np.array(
        [[0.4122214708, 0.2119034982, 0.0883024619], [0.5363325363, 0.6806995451, 0.2817188376],
         [0.0514459929, 0.1073969566, 0.6299787005]]
    )  # fmt: skip
    lab: Floats = np.cbrt(lms) @ np.array(
        [[0.2104542553, 1.9779984951, 0.0259040371], [0.7936177850, -2.4285922050, 0.7827717662],
         [-0.0040720468, 0.4505937099, -0.8086757660]]
    )  # fmt: skip
    return lab


def _error_table(palette: Palette) -> Colors:
    """The ramp in 256 steps of equal perceived difference."""
    anchors = np.asarray(_ANCHORS[palette], dtype=np.float64) / 255
    dense = np.stack(
        [np.interp(np.linspace(0, len(anchors) - 1, 4096), np.arange(len(anchors)), column) for column in anchors.T],
        axis=1,
    )
    steps = np.linalg.norm(np.diff(_oklab(dense), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    positions = np.linspace(0, length[-1], _LEVELS)
    table = np.stack([np.interp(positions, length, column) for column in dense.T], axis=1)
    return np.rint(table * 255).astype(np.uint8)


ERROR_TABLES: dict[Palette, Colors] = {palette: _error_table(palette) for palette in _ANCHORS}
"""(256, 3) each; the first row means no error, the last the error scale or more."""
DISTANCE_TABLE: Colors = ERROR_TABLES["viridis"]
"""(256, 3); the first row means the most alike features or the best ones, the last the most unlike or worst."""


def error_colors(
    errors: npt.ArrayLike, *, scale: float, palette: Palette, has_partner: npt.NDArray[np.bool_] | None = None
) -> Colors:
    """Colours of matches or points by their error.

    Args:
        errors: In cloud units; nan where there is no match.
        scale: Error from which on the colour is the last of the palette, in cloud units.
        palette: Which colours.
        has_partner: Which of them have a true partner; the others are grey. All have one if None.

    Returns:
        One row of red, green, blue for each error.
    """
    values = np.asarray(errors, dtype=np.float64)
    missing = np.isnan(values)
    steps = np.clip(np.where(missing, 0.0, values) / scale, 0.0, 1.0) * (_LEVELS - 1)
    colors: Colors = ERROR_TABLES[palette][np.rint(steps).astype(np.int64)]
    if has_partner is not None:
        colors[~has_partner] = NO_PARTNER
    colors[missing] = NO_MATCH
    return colors


def distance_colors(distances: npt.ArrayLike, *, low: float, high: float) -> Colors:
    """Colours of points by a feature distance, on a logarithmic scale from `low` to `high`; nan for no feature."""
    values = np.asarray(distances, dtype=np.float64)
    missing = np.isnan(values)
    shares = np.log(np.clip(np.where(missing, high, values), low, high) / low) / np.log(high / low)
    colors: Colors = DISTANCE_TABLE[np.rint(shares * (_LEVELS - 1)).astype(np.int64)]
    colors[missing] = NO_MATCH
    return colors


def quality_colors(qualities: npt.ArrayLike) -> Colors:
    """Colours of features by their quality, from 0 to 1: light is distinctive."""
    steps = (1 - np.clip(np.asarray(qualities, dtype=np.float64), 0, 1)) * (_LEVELS - 1)
    colors: Colors = DISTANCE_TABLE[np.rint(steps).astype(np.int64)]
    return colors


def stage_colors(stages: npt.NDArray[np.int8]) -> Colors:
    """Colours of points or matches by the stage that rejects them, as `cgf.pipeline.rejections` counts them."""
    table = np.array([STAGE_COLORS[name] for name in REJECTIONS], dtype=np.uint8)
    return np.asarray(table[stages])


def feature_basis(source: npt.NDArray[np.float32], target: npt.NDArray[np.float32]) -> FeatureBasis:
    """The three directions in which the features of both clouds together vary most.

    Args:
        source: Feature vectors, one a row.
        target: Feature vectors of the other cloud, as wide.

    Returns:
        The map to colours; directions without variation become mid grey.
    """
    vectors = np.concatenate([source, target]).astype(np.float64)
    mean = vectors.mean(axis=0) if len(vectors) else np.zeros(vectors.shape[1])
    centred = vectors - mean
    _, directions = np.linalg.eigh(centred.T @ centred)
    axes = directions[:, ::-1][:, :3]
    if axes.shape[1] < 3:
        axes = np.pad(axes, ((0, 0), (0, 3 - axes.shape[1])))
    # The sign of an eigenvector is arbitrary; fixing it keeps the colours from flipping between runs.
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=0)[None], axis=0)
    axes = axes * np.where(largest < 0, -1.0, 1.0)
    projected = centred @ axes
    if not len(projected):
        return FeatureBasis(mean, axes, np.zeros(3), np.zeros(3))
    low, high = np.percentile(projected, (2, 98), axis=0)
    return FeatureBasis(mean, axes, low, high)


def feature_colors(vectors: npt.NDArray[np.float32], basis: FeatureBasis) -> Colors:
    """Project features to red, green, blue; equal vectors get equal colours whichever cloud they come from."""
    projected = (vectors.astype(np.float64) - basis.mean) @ basis.axes
    span = basis.high - basis.low
    shares = np.where(span > 0, (projected - basis.low) / np.where(span > 0, span, 1.0), 0.5)
    return np.rint(40 + 215 * np.clip(shares, 0, 1)).astype(np.uint8)


def are_colors_usable(colors: Colors) -> bool:
    """Whether a cloud's own colours show anything; scanners without a camera often write black."""
    return bool(len(colors)) and float(np.mean(colors.max(axis=1) > 8)) > 0.75


def shaded_colors(tint: tuple[int, int, int], points: Floats, normals: Floats | None, *, viewpoint: Floats) -> Colors:
    """One colour for a cloud that brings none, darker where the surface turns away from the sensor."""
    if normals is None:
        return np.tile(np.asarray(tint, dtype=np.uint8), (len(points), 1))
    rays = viewpoint - points
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    facing = np.abs(np.sum(rays * normals, axis=1))
    shade = 0.35 + 0.65 * facing[:, None]
    return np.rint(np.asarray(tint, dtype=np.float64) * shade).astype(np.uint8)


# The viewer's lines go through three.js's filmic tone mapping, points do not. These are its constants.
_TONE_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_TONE_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_TONE_EXPOSURE = 0.6


def tone_mapped(colors: Colors) -> Colors:
    """What a line of these bytes looks like on the screen."""
    light = colors.astype(np.float64) / 255 / _TONE_EXPOSURE @ _TONE_IN.T
    light = (light * (light + 0.0245786) - 0.000090537) / (light * (0.983729 * light + 0.4329510) + 0.238081)
    linear = np.clip(light @ _TONE_OUT.T, 0, 1)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(shown * 255).astype(np.uint8)


def line_colors(colors: Colors) -> Colors:
    """The bytes to send for lines that shall look like `colors`, as `tone_mapped` undoes this."""
    shown = colors.astype(np.float64) / 255
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    mapped = np.clip(linear @ np.linalg.inv(_TONE_OUT).T, 0, 0.999)
    # mapped = (x^2 + a x - b) / (c x^2 + d x + e), solved for the positive x.
    square, slope, rest = (1 - 0.983729 * mapped), (0.0245786 - 0.4329510 * mapped), (-0.000090537 - 0.238081 * mapped)
    light = (-slope + np.sqrt(np.maximum(slope**2 - 4 * square * rest, 0))) / (2 * square)
    sent = light @ np.linalg.inv(_TONE_IN).T * _TONE_EXPOSURE
    sent[(colors == 0).all(axis=-1)] = 0
    return np.rint(np.clip(sent, 0, 1) * 255).astype(np.uint8)
