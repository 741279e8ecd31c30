from typing import get_args

import numpy as np
import pytest

from app import colors
from app.settings import Palette

LARGEST_STEP_OF_A_LINE = 3
"""Of 255: eight bits cannot undo the tone mapping better than that."""


PALETTES = get_args(Palette)
# What is seen with no cones for long, middle and short waves: Machado et al. 2009, severity 1, for linear RGB.
COLOUR_BLIND = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def test_error_colours_run_from_light_to_black() -> None:
    shown = colors.error_colors(np.linspace(0, 0.25, 100), scale=0.25, palette="paper")
    lightness = shown.astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) <= 0).all()
    assert shown[-1].tolist() == [0, 0, 0]
    assert lightness[0] > 200


def test_errors_beyond_the_scale_are_black() -> None:
    assert colors.error_colors([0.25, 0.3, 1e9], scale=0.25, palette="paper").max() == 0


@pytest.mark.parametrize("palette", PALETTES)
@pytest.mark.parametrize("kind", COLOUR_BLIND)
def test_errors_a_quarter_of_the_scale_apart_differ_for_colour_blind_people(palette: Palette, kind: str) -> None:
    table = colors.ERROR_TABLES[palette][::8] / 255
    linear = np.where(table <= 0.04045, table / 12.92, ((table + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(COLOUR_BLIND[kind]).T, 0, 1)
    lab = colors._oklab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1)
    rows, columns = np.triu_indices(len(table), k=8)
    assert apart[rows, columns].min() > 0.1


@pytest.mark.parametrize("palette", PALETTES)
def test_neighbouring_errors_differ_by_equal_perceived_steps(palette: Palette) -> None:
    lab = colors._oklab(colors.ERROR_TABLES[palette] / 255)
    steps = np.linalg.norm(lab[8::8] - lab[:-8:8], axis=1)
    # Next to black, eight bits are too coarse for equal steps.
    visible = steps[:-2]
    assert visible.std() < 0.05 * visible.mean()


def test_points_without_partner_or_match_have_their_own_colours() -> None:
    partner = np.array([True, False, False])
    shown = colors.error_colors([0.0, 0.0, np.nan], scale=1.0, palette="paper", has_partner=partner)
    assert shown.tolist() == [colors.ERROR_TABLES["paper"][0].tolist(), [*colors.NO_PARTNER], [*colors.NO_MATCH]]


@pytest.mark.parametrize("palette", PALETTES)
def test_the_special_colours_are_not_on_the_ramp(palette: Palette) -> None:
    # Where lines are unjudged there are no errors to show.
    for special in (colors.NO_PARTNER, colors.NO_MATCH):
        assert np.abs(colors.ERROR_TABLES[palette].astype(int) - special).max(axis=1).min() > 24


def test_lines_look_like_points_on_the_screen() -> None:
    wanted = np.concatenate([*colors.ERROR_TABLES.values(), [colors.NO_PARTNER, colors.NO_MATCH, colors.UNJUDGED]])
    shown = colors.tone_mapped(colors.line_colors(wanted.astype(np.uint8)))
    assert np.abs(shown.astype(int) - wanted).max() <= LARGEST_STEP_OF_A_LINE


@pytest.mark.parametrize(("sent", "shown"), [(128, 197), (255, 226), (0, 0)])
def test_tone_mapping_is_as_measured_in_the_browser(sent: int, shown: int) -> None:
    assert colors.tone_mapped(np.full((1, 3), sent, dtype=np.uint8)).tolist() == [[shown] * 3]


def test_equal_features_have_equal_colours_in_both_clouds() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(50, 8)).astype(np.float32)
    target = np.concatenate([source[:10], rng.normal(size=(30, 8)).astype(np.float32) + 2])
    basis = colors.feature_basis(source, target)
    np.testing.assert_array_equal(colors.feature_colors(source, basis)[:10], colors.feature_colors(target, basis)[:10])


def test_feature_colours_do_not_depend_on_the_order_of_points() -> None:
    rng = np.random.default_rng(1)
    source, target = rng.normal(size=(2, 60, 8)).astype(np.float32)
    order = rng.permutation(60)
    one = colors.feature_colors(source, colors.feature_basis(source, target))
    other = colors.feature_colors(source, colors.feature_basis(source[order], target))
    assert np.abs(one.astype(int) - other).max() <= 1


def test_features_without_variation_are_mid_grey() -> None:
    same = np.ones((5, 4), dtype=np.float32)
    assert np.unique(colors.feature_colors(same, colors.feature_basis(same, same))).size == 1


def test_black_colours_of_a_scanner_without_camera_are_not_used() -> None:
    dark = np.zeros((100, 3), dtype=np.uint8)
    dark[:20] = 200
    assert not colors.are_colors_usable(dark)
    assert colors.are_colors_usable(np.full((100, 3), 60, dtype=np.uint8))


def test_shading_is_brightest_where_the_surface_faces_the_sensor() -> None:
    points = np.zeros((2, 3))
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    shown = colors.shaded_colors((200, 100, 50), points, normals, viewpoint=np.array([0.0, 0.0, 5.0]))
    assert shown[0].tolist() == [200, 100, 50]
    assert shown[1].max() < 100
