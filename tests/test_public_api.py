"""What `import cgf` offers is what it lists."""

import ast
import importlib
import inspect
from pathlib import Path

import pytest

import cgf


def imported_for_types() -> set[str]:
    """Names that type checkers see in `cgf/__init__.py`."""
    tree = ast.parse(Path(cgf.__file__).read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}


def test_the_list_is_what_type_checkers_see() -> None:
    assert sorted(cgf.__all__) == sorted(imported_for_types())


def test_the_list_is_what_can_be_imported() -> None:
    assert sorted(cgf.__all__) == sorted(cgf._MODULE_OF)


def test_the_list_is_in_order_and_names_nothing_twice() -> None:
    assert sorted(set(cgf.__all__)) == cgf.__all__


@pytest.mark.parametrize("name", cgf.__all__)
def test_a_public_name_is_the_one_of_its_module_and_is_described(name: str) -> None:
    value = getattr(cgf, name)
    assert value is getattr(importlib.import_module(f"cgf.{cgf._MODULE_OF[name]}"), name)
    assert inspect.getdoc(value)


def test_dir_lists_the_public_names() -> None:
    assert set(cgf.__all__) <= set(dir(cgf))


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'cgf' has no attribute 'register'"):
        _ = cgf.register


def test_the_docstring_lists_the_stages_in_order() -> None:
    stages = [
        "io",
        "datasets",
        "geometry",
        "descriptors",
        "matching",
        "registration",
        "pipeline",
        "evaluation",
        "training",
    ]
    assert cgf.__doc__ is not None
    places = [cgf.__doc__.index(f"`cgf.{stage}`") for stage in stages]
    assert places == sorted(places)
