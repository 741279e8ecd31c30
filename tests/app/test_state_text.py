import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.settings import Bar, Column, ViewSettings
from app.state_text import read_state, restored, write_state
from cgf.checks import InputError


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "dim": st.integers(1, 512),
            "support_radius": st.floats(1e-6, 1e6),
            "max_ratio": st.floats(0.1, 1.0),
            "surest": st.floats(0.01, 1.0),
            "mutual": st.booleans(),
            "line_count": st.integers(0, 5000),
            "palette": st.sampled_from(["paper", "viridis", "blue_orange"]),
            "pose": st.sampled_from(["loaded", "estimate"]),
            "layout": st.sampled_from(["side_by_side", "overlaid"]),
            "bar": st.builds(Bar, st.just("error"), st.floats(0, 1), st.floats(1, 2)),
            "columns": st.lists(st.builds(Column, st.just("cgf"), st.integers(1, 64)), max_size=3).map(tuple),
        },
    )
)
def test_what_is_written_reads_back_to_the_last_digit(changes: dict[str, object]) -> None:
    settings = ViewSettings().changed(changes, pairs=1)
    assert ViewSettings().changed(restored(read_state(write_state(settings))), pairs=1) == settings


def test_settings_at_their_default_are_not_written() -> None:
    assert write_state(ViewSettings()) == ""
    assert write_state(ViewSettings(dim=16, mutual=True)) == "dim=16&mutual=true"


def test_a_whole_link_is_understood_and_what_is_only_of_its_window_left_out() -> None:
    link = "http://127.0.0.1:8750/secret/#tab=plots&dim=16&camera=1,2,3,0,0,0"
    assert read_state(link) == {"dim": 16}


def test_what_is_not_named_goes_back_to_its_default() -> None:
    changed = ViewSettings(dim=8, mutual=True).changed(restored(read_state("dim=16")), pairs=1)
    assert changed == ViewSettings(dim=16)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dim=many", "Dim should be a valid integer"),
        ("speed=9", "Speed is not permitted"),
        ("support_radius=-1", "Support radius should be greater than 0"),
        ("nonsense", "Nonsense is not permitted"),
    ],
)
def test_a_state_that_cannot_be_used_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_state(text)
