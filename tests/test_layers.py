"""Import rules: every module has a layer, none imports a layer above it, and start-up imports little."""

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import sameas
from modules import belong_inside, circles, constants, imported, name_of, too_small

HOME = Path(sameas.__file__).parent
#: The modules and packages of ``sameas`` from the lowest layer up; those of one line do not import each other.
FLOORS = """
errors representation
arrays bounds
ragged
gaussian kernels
space
records
gate
groups
evidence
prior
assignment
posterior
result
decision
_identify
estimate
many
registration
score
sky tracks
picture simulate
report
maps
io
partitions
plots
pages
live
front
adapters
cli
__main__
"""
FLOOR = {room: floor for floor, line in enumerate(FLOORS.strip().splitlines()) for room in line.split()}
#: Packages that must not import sky, tracks or the command line.
CORE = [room for room in FLOOR if FLOOR[room] <= FLOOR["score"]]
#: The stages for many sources; each imports earlier ones only.
MANY = ["observations", "pooled", "rules", "sets", "marginals", "objects", "identify"]


def room_of(path):
    return path.relative_to(HOME).with_suffix("").parts[0]


def rooms(names):
    return {name.split(".")[0] for name in names} & set(FLOOR)


MODULES = [path for path in sorted(HOME.rglob("*.py")) if path != HOME / "__init__.py"]


def test_every_module_has_a_layer_and_every_layer_exists():
    there = {path.stem for path in HOME.glob("*.py") if path.stem != "__init__"}
    there |= {path.name for path in HOME.iterdir() if path.is_dir() and any(path.rglob("*.py"))}
    assert there == set(FLOOR)


@pytest.mark.slow_after(56)
@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_module_imports_its_own_layer_or_one_above(path):
    room = room_of(path)
    for other in rooms(imported(path)) - {room}:
        beside = FLOOR[other] == FLOOR[room] and room != "kernels" and FLOOR[room] > 0
        assert FLOOR[other] <= FLOOR[room] and not beside, f"{path.relative_to(HOME)} imports {other}"


def test_kernels_import_kernels_only():
    for path in (HOME / "kernels").glob("*.py"):
        assert rooms(imported(path)) <= {"kernels", "arrays"}, path


@pytest.mark.slow
def test_there_are_no_import_cycles():
    """No import cycles, including imports for type checking only."""
    assert circles() == []


@pytest.mark.slow
def test_a_module_with_one_importer_belongs_inside_it():
    """Exceptions: the folders of ``modules.KINDS``, and together more than ``modules.TWO_IDEAS`` lines."""
    assert belong_inside() == []


@pytest.mark.slow
def test_a_class_name_stands_for_one_thing():
    homes = defaultdict(list)
    for path in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(name_of(path))
    del homes["Tuning"]  # of each stage
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


@pytest.mark.slow
def test_no_test_patches_a_constant():
    """What tunes a stage is a field of its tuning, of which a test passes another."""
    patched = re.compile(r'setattr\(\s*(?:"sameas[\w.]*\.|[\w.]+,\s*")([A-Z][A-Z0-9_]+)"')
    known = {name.rpartition(".")[2] for name in constants()}
    for path in Path(__file__).parent.rglob("test_*.py"):
        if path.name not in ("test_study.py", "test_examples.py"):  # of benchmarks and examples
            assert not known & set(patched.findall(path.read_text(encoding="utf-8"))), path


@pytest.mark.slow
def test_very_short_modules_have_many_importers():
    assert too_small() == []


@pytest.mark.parametrize("stage", MANY)
def test_a_stage_of_many_sources_never_imports_a_later_one(stage):
    later = {f"many.{name}" for name in MANY[MANY.index(stage) + 1 :]}
    assert not imported(HOME / "many" / f"{stage}.py") & later


@pytest.mark.slow
def test_the_core_imports_no_sky_tracks_or_command_line():
    assert {"identify", "sky", "tracks", "cli"}.isdisjoint(CORE) and {"records", "estimate", "many"} <= set(CORE)
    for room in CORE:
        files = list((HOME / room).rglob("*.py")) or [HOME / f"{room}.py"]
        for path in files:
            assert rooms(imported(path)) <= set(CORE), path


@pytest.mark.slow
@pytest.mark.parametrize("package", ["", "sky", "tracks", "picture", "simulate", "score"])
def test_every_public_name_exists(package):
    """Every name listed in ``__init__.pyi`` exists."""
    program = f"import sameas.{package or 'errors'} as p, sameas; p = sameas{'.' + package if package else ''}; "
    program += "print(*(type(getattr(p, name)).__name__ for name in p.__all__))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    stub = (HOME / package / "__init__.pyi").read_text(encoding="utf-8")
    assert len(run.stdout.split()) == stub.count("import ") > 5


@pytest.mark.parametrize("used", ["sameas", "sameas.identify, sameas.Records, sameas.PoissonField, sameas.Sphere"])
def test_start_up_imports_nothing_heavy(used):
    program = f"import sys, sameas; {used}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "sameas" in loaded and ("numpy" in loaded or used == "sameas")
    assert not loaded & {"astropy", "scipy", "numba", "pyarrow", "matplotlib", "pandas", "typer", "rich", "llvmlite"}


def test_match_options_are_built_without_numpy():
    program = "import sys, sameas.cli.match; print('numpy' in sys.modules, 'typer' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True"]
