import numpy as np
import pytest

from app import colors

LARGEST_STEP_OF_A_LINE = 3
"""Of 255: eight bits cannot undo the tone mapping better than that."""


def test_error_colours_run_from_light_to_black() -> None:
    shown = colors.error_colors(np.linspace(0, 0.25, 100), scale=0.25)
    lightness = shown.astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) <= 0).all()
    assert shown[-1].tolist() == [0, 0, 0]
    assert lightness[0] > 200


def test_errors_beyond_the_scale_are_black() -> None:
    assert colors.error_colors([0.25, 0.3, 1e9], scale=0.25).max() == 0


def test_neighbouring_errors_differ_by_equal_perceived_steps() -> None:
    lab = colors._oklab(colors.ERROR_TABLE / 255)
    steps = np.linalg.norm(lab[8::8] - lab[:-8:8], axis=1)
    # Next to black, eight bits are too coarse for equal steps.
    visible = steps[:-2]
    assert visible.std() < 0.05 * visible.mean()


def test_points_without_partner_or_match_have_their_own_colours() -> None:
    shown = colors.error_colors([0.0, 0.0, np.nan], scale=1.0, has_partner=np.array([True, False, False]))
    assert shown.tolist() == [list(colors.ERROR_TABLE[0]), list(colors.NO_PARTNER), list(colors.NO_MATCH)]


def test_the_special_colours_are_not_on_the_ramp() -> None:
    for special in (colors.NO_PARTNER, colors.NO_MATCH, colors.UNJUDGED):
        assert np.abs(colors.ERROR_TABLE.astype(int) - special).max(axis=1).min() > 24


def test_lines_look_like_points_on_the_screen() -> None:
    wanted = np.concatenate([colors.ERROR_TABLE, [colors.NO_PARTNER, colors.NO_MATCH, colors.UNJUDGED]])
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
