"""Imports point down the layers, and commands start without the heavy libraries."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

LAYERS = (
    ("app",),
    ("cgf.cli",),
    ("cgf",),  # the public names
    ("cgf.training",),
    ("cgf.diagnosis",),
    ("cgf.evaluation",),
    ("cgf.pipeline",),
    ("cgf.descriptors", "cgf.matching", "cgf.registration", "cgf.datasets"),
    ("cgf.geometry", "cgf.io"),
    ("cgf.types",),
    ("cgf.checks",),
)
"""From the top; a module imports only from layers below its own, or from its own part of its layer."""

HEAVY = ("fastapi", "numba", "open3d", "scipy", "sklearn", "torch", "uvicorn", "viser")


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for package in ("app", "cgf") for path in sorted((ROOT / package).rglob("*.py"))}


def imported_modules(path: Path) -> Iterator[tuple[int, str]]:
    """Line and full name of every module of this project that `path` imports, at the top or inside a function."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # `from cgf import io` imports a module, `from cgf.io import read_cloud` a name of one.
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in SOURCES else node.module for name in full]
        else:
            continue
        for name in names:
            if name.split(".")[0] in ("app", "cgf"):
                yield node.lineno, name


def part_of(module: str) -> tuple[int, str]:
    """Layer, counted from the top, and part of it to which `module` belongs."""
    candidates = [(len(part), layer, part) for layer, parts in enumerate(LAYERS) for part in parts]
    for _, layer, part in sorted(candidates, reverse=True):
        if module == part or (part != "cgf" and module.startswith(part + ".")):
            return layer, part
    raise AssertionError(f"{module} must belong to a layer, got none; add it to LAYERS")


def upward_imports(module: str, path: Path) -> list[str]:
    layer, part = part_of(module)
    return [
        f"{path.name}:{line}: {part} must not import {name}"
        for line, name in imported_modules(path)
        if part_of(name)[1] != part and part_of(name)[0] <= layer
    ]


@pytest.mark.parametrize("module", SOURCES)
def test_imports_point_down(module: str) -> None:
    assert not upward_imports(module, SOURCES[module])


@pytest.mark.parametrize(
    ("module", "statement"),
    [
        ("cgf.geometry.sampling", "from cgf.io import read_cloud"),
        ("cgf.matching", "def f():\n    import cgf.pipeline"),
        ("cgf.types", "from cgf import PointCloud"),
        ("cgf.cli", "import app.main"),
    ],
)
def test_an_import_that_points_up_is_found(module: str, statement: str, tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(statement, "utf-8")
    assert len(upward_imports(module, path)) == 1


def test_a_part_of_a_layer_has_no_import_cycles() -> None:
    graph = {module: {name for _, name in imported_modules(path)} - {module} for module, path in SOURCES.items()}
    done: set[str] = set()

    def visit(module: str, above: tuple[str, ...]) -> None:
        assert module not in above, " imports ".join([*above[above.index(module) :], module])
        if module not in done:
            for name in sorted(graph.get(module, ())):
                visit(name, (*above, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def reachable(module: str) -> set[str]:
    """Modules of `app` that importing `module` may import, itself included."""
    found: set[str] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        if name not in found and name in SOURCES:
            found.add(name)
            pending += [other for _, other in imported_modules(SOURCES[name]) if other.startswith("app.")]
    return found


def test_routes_and_viewer_meet_only_in_the_session() -> None:
    for module in (name for name in SOURCES if name.startswith(("app.routes", "app.viewer"))):
        other = "app.viewer" if module.startswith("app.routes") else "app.routes"
        assert not [name for name in reachable(module) if name == other or name.startswith(other + ".")], module


@pytest.mark.parametrize("module", ["app.session", "app.jobs"])
def test_session_can_be_tested_without_viser_and_fastapi(module: str) -> None:
    for name in reachable(module):
        for node in ast.walk(ast.parse(SOURCES[name].read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            heavy = {imported.split(".")[0] for imported in names} & {"fastapi", "starlette", "uvicorn", "viser"}
            assert not heavy, f"{name} imports {heavy}, and {module} imports {name}"


HELP = "import sys; sys.argv = ['{0}', '--help']\nfrom {1} import main\ntry: main()\nexcept SystemExit: pass"


@pytest.mark.parametrize(
    "code",
    [
        "import cgf",
        "import cgf.cli",
        "import app.main",
        HELP.format("cgf", "cgf.cli"),
        HELP.format("cgf-viewer", "app.main"),
    ],
    ids=["cgf", "cgf.cli", "app.main", "cgf --help", "cgf-viewer --help"],
)
def test_commands_start_without_the_heavy_libraries(code: str) -> None:
    program = f"{code}\nimport sys\nprint('HEAVY', *sorted(sys.modules.keys() & {set(HEAVY)}))"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "HEAVY"
