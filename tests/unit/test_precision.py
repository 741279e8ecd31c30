import pytest

from cgf.descriptors import precision
from cgf.descriptors.network import read_network, shipped_weights


def on_a_processor(monkeypatch, *, tiles, some_bytes):
    monkeypatch.setattr(precision, "has_tiles", lambda: tiles)
    monkeypatch.setattr(precision, "has_bytes", lambda: some_bytes)


@pytest.mark.parametrize(
    ("tiles", "some_bytes", "expected"),
    [(True, True, "bfloat16"), (False, True, "int8"), (False, False, "float32")],
)
def test_the_quickest_that_the_processor_has_is_chosen(monkeypatch, tiles, some_bytes, expected):
    monkeypatch.delenv("CGF_PRECISION", raising=False)
    on_a_processor(monkeypatch, tiles=tiles, some_bytes=some_bytes)
    assert precision.chosen_precision() == expected


def test_the_environment_names_the_precision(monkeypatch):
    on_a_processor(monkeypatch, tiles=True, some_bytes=True)
    for name in ("bfloat16", "int8", "float32"):
        monkeypatch.setenv("CGF_PRECISION", name)
        assert precision.chosen_precision() == name
    monkeypatch.setenv("CGF_PRECISION", "float16")
    with pytest.raises(ValueError, match="CGF_PRECISION must be bfloat16, int8 or float32, got float16"):
        precision.chosen_precision()


def test_a_precision_that_the_processor_lacks_is_refused(monkeypatch):
    on_a_processor(monkeypatch, tiles=False, some_bytes=True)
    monkeypatch.setenv("CGF_PRECISION", "bfloat16")
    with pytest.raises(
        ValueError,
        match=r"CGF_PRECISION must be what this processor multiplies \(int8 or float32\), got bfloat16; leave",
    ):
        precision.chosen_precision()


def test_only_bfloat16_takes_tiles(monkeypatch):
    network = read_network(shipped_weights("cgf-object"))
    on_a_processor(monkeypatch, tiles=True, some_bytes=True)
    monkeypatch.delenv("CGF_PRECISION", raising=False)
    assert network.takes_tiles
    monkeypatch.setenv("CGF_PRECISION", "int8")
    assert not network.takes_tiles
