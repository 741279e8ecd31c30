"""The wheel holds all that the checkout has, says what it needs, and works elsewhere."""

import ast
import os
import re
import subprocess
import sys
import sysconfig
import urllib.request
from collections.abc import Iterator
from email import message_from_string
from importlib import metadata
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    (path,) = folder.glob("*.whl")
    return path


def checkout_files(folder: str) -> set[str]:
    files = (path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(ROOT).as_posix() for path in files}


def test_wheel_holds_every_file_of_the_packages_and_the_page(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    page = {f"app/{name}" for name in checkout_files("static")}
    assert held == checkout_files("cgf") | checkout_files("app") | page


@pytest.mark.parametrize(
    "pattern",
    [
        r"app/static/index\.html",
        *(
            rf"cgf/descriptors/weights/{name}-{model}\.{kind}"
            for name in ("cgf", "pca")
            for model in ("object", "indoor")
            for kind in ("safetensors", "json")
        ),
        r"cgf/datasets/demo_data/.*\.pcd",
        r"cgf/datasets/demo_data/.*LICENSE.*",
        r"cgf_viewer-.*\.dist-info/licenses/LICENSE",
    ],
)
def test_wheel_holds_page_weights_and_demo(wheel: Path, pattern: str) -> None:
    with ZipFile(wheel) as archive:
        assert [name for name in archive.namelist() if re.fullmatch(pattern, name)]


def requirements(wheel: Path) -> Iterator[str]:
    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        headers = message_from_string(archive.read(name).decode("utf-8"))
    for text in headers.get_all("Requires-Dist", []):
        requirement = Requirement(text)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", "train")):
            yield canonicalize_name(requirement.name)


def imported_distributions() -> set[str]:
    names = set()
    for package in ("app", "cgf"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Import):
                    names.update(alias.name.split(".")[0] for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and node.module:
                    names.add(node.module.split(".")[0])
                elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                    names.update(argument.value for argument in node.args if isinstance(argument, ast.Constant))
    third_party = names - sys.stdlib_module_names - {"app", "cgf"}
    return {owner for name in third_party for owner in owners(name)}


def owners(module: str) -> set[str]:
    """Distributions whose files include the top-level `module`."""
    # `importlib.metadata.packages_distributions` misses those without a top_level.txt in Python 3.10.
    tops = {module, f"{module}.py"}
    return {
        canonicalize_name(distribution.metadata["Name"])
        for distribution in metadata.distributions()
        if any(file.parts[0] in tops for file in distribution.files or ())
    }


def test_what_is_imported_is_declared_and_the_other_way_round(wheel: Path) -> None:
    assert imported_distributions() == set(requirements(wheel))


LOAD = """
import sys
from pathlib import Path
import numpy as np
import cgf
assert Path(cgf.__file__).is_relative_to(sys.prefix), cgf.__file__
pair = cgf.load_demo()
assert len(pair.source) > 1_000 and len(pair.target) > 1_000
for model in ("object", "indoor"):
    settings = cgf.resolve(cgf.PairSettings(model=model), pair.source, pair.target)
    part = cgf.prepare(pair.source, settings).take(np.arange(500))
    print(model, len(cgf.describe(part, settings)))
"""


@pytest.mark.slow
def test_an_installed_wheel_shows_the_demo(wheel: Path, tmp_path: Path) -> None:
    """In an environment that sees the libraries of this one, but neither the checkout nor an editable install of it."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    scripts = Path(sysconfig.get_path("scripts", vars={"base": str(environment)}))
    (site,) = environment.glob("**/site-packages")
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib"), "utf-8")
    install = [scripts / "python", "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", wheel]
    subprocess.run(install, check=True, stdin=subprocess.DEVNULL)
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    loaded = subprocess.run(
        [scripts / "python", "-c", LOAD], cwd=tmp_path, env=clean, capture_output=True, text=True, check=False
    )
    assert loaded.returncode == 0, loaded.stderr
    described = dict(line.split() for line in loaded.stdout.splitlines())
    assert described.keys() == {"object", "indoor"}
    assert all(int(count) > 100 for count in described.values())

    viewer = subprocess.Popen(
        [scripts / "cgf-viewer", "--demo", "--no-browser", "--port", "0"],
        cwd=tmp_path,
        env=clean,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert viewer.stdout is not None
        printed = ""
        while (url := re.search(r"http://\S+", printed)) is None:
            line = viewer.stdout.readline()
            assert line, printed
            printed += line
        with urllib.request.urlopen(url.group(), timeout=30) as page:
            assert page.status == 200
            assert page.read() == (ROOT / "static" / "index.html").read_bytes()
    finally:
        viewer.terminate()
        viewer.communicate(timeout=30)
