import pytest

from cgf.checks import InputError
from cgf.pipeline import choose_model
from tests.surfaces import surface


@pytest.mark.parametrize(
    ("size", "model", "words"),
    [
        (4.0, "indoor", "spans 4 m, as rooms do"),
        (1.7, "object", "span 1.7 units, not the 2.75 to 30 m of a room"),
        (2.7, "object", "span 2.7 units"),
        (2.8, "indoor", "spans 2.8 m"),
        (100.0, "object", "span 100 units"),
    ],
)
def test_the_model_follows_the_extent_and_says_why(size: float, model: str, words: str) -> None:
    choice = choose_model(surface(size), surface(size))
    assert choice.name == model
    assert words in choice.reason
    assert choice.warning is None


def test_the_larger_cloud_decides() -> None:
    assert choose_model(surface(1.0), surface(3.0)).name == "indoor"


@pytest.mark.parametrize("model", ["object", "indoor"])
def test_a_requested_model_is_taken(model: str) -> None:
    choice = choose_model(surface(4.0), surface(4.0), model)
    assert choice.name == model
    assert "as requested" in choice.reason
    assert choice.warning is None


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(InputError, match="--model must be auto, object or indoor, got outdoor"):
        choose_model(surface(), surface(), "outdoor")


@pytest.mark.parametrize("requested", ["auto", "indoor"])
def test_millimetres_are_warned_of(requested: str) -> None:
    warning = choose_model(surface(4000.0), surface(3000.0), requested).warning
    assert warning == "The clouds span 4,000 units; if this is a room in millimetres, say so with --unit mm."


def test_no_millimetres_are_suspected_where_scale_is_relative_by_request() -> None:
    assert choose_model(surface(4000.0), surface(4000.0), "object").warning is None


def test_indoor_weights_on_a_small_object_are_warned_of() -> None:
    warning = choose_model(surface(0.2), surface(0.2), "indoor").warning
    assert warning == "The indoor model expects rooms, but the clouds span 0.2 m; choose --unit or --model."


def test_units_that_differ_are_warned_of() -> None:
    warning = choose_model(surface(1.0), surface(100.0)).warning
    assert warning == "One cloud is 100 times as large as the other; do their units agree?"
