"""Data walks one way: a stage imports no later one, the core imports no room, and starting up imports little."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sameas

HOME = Path(sameas.__file__).parent
STAGES = ["records", "gate", "groups", "evidence", "prior", "assignment", "posterior", "result", "identify", "estimate"]
# Companions walk with their stage.
WITH = {"errors": "records", "space": "records", "threads": "records", "search": "gate", "zones": "gate",
        "coverage": "estimate", "grades": "estimate", "detection": "estimate", "photometry": "estimate",
        "piecewise": "records", "quantity": "estimate", "regression": "estimate", "error_model": "estimate",
        "decision": "result", "older": "result", "spacing": "evidence"}  # fmt: skip
ROOMS = {"sky", "tracks", "picture", "maps", "io", "adapters", "plots", "report", "findings", "prose", "cli", "study",
         "pages", "__main__"}  # fmt: skip
FOR_PEOPLE = {"io", "maps", "adapters", "plots", "report", "findings", "cli", "study", "pages", "__main__"}


def imported(path, *, always=False):
    """Modules of sameas that a file imports, as dotted names; with ``always`` not those for type checkers only."""
    tree = ast.parse(path.read_text())
    skipped = set()
    if always:
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                skipped |= {id(inner) for inner in ast.walk(node)}
    names = set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix("sameas.") for name in names if name.startswith("sameas.")}


def tops(names):
    return {name.split(".")[0] for name in names}


def files_of(stage):
    """The file of a stage, or the files of the package that it is."""
    return list((HOME / stage).glob("*.py")) or [HOME / f"{stage}.py"]


def core_files():
    files = [path for path in HOME.glob("*.py") if path.stem not in ROOMS | {"__init__"}]
    return files + [path for package in ("kernels", "evidence") for path in (HOME / package).glob("*.py")]


@pytest.mark.parametrize("stage", STAGES + list(WITH))
def test_a_stage_never_imports_a_later_one(stage):
    place = STAGES.index(WITH.get(stage, stage))
    for path in files_of(stage):
        for name in tops(imported(path, always=True)) & (set(STAGES) | set(WITH)):
            assert STAGES.index(WITH.get(name, name)) <= place, f"{path.relative_to(HOME)} imports {name}"


def test_stages_are_all_there():
    assert all(path.exists() for name in [*STAGES, *WITH] for path in files_of(name))


@pytest.mark.parametrize("path", core_files(), ids=lambda path: path.stem)
def test_the_core_imports_no_room(path):
    assert not tops(imported(path)) & ROOMS


@pytest.mark.parametrize("path", list((HOME / "kernels").glob("*.py")), ids=lambda path: path.stem)
def test_kernels_import_kernels_only(path):
    assert tops(imported(path)) <= {"kernels"}


def test_nobody_imports_what_is_for_people():
    for path in HOME.rglob("*.py"):
        room = path.relative_to(HOME).with_suffix("").parts[0]
        if room not in FOR_PEOPLE:
            assert not tops(imported(path)) & FOR_PEOPLE, path


@pytest.mark.parametrize("used", ["sameas", "sameas.identify, sameas.Records, sameas.PoissonField, sameas.Sphere"])
def test_starting_up_imports_nothing_heavy(used):
    program = f"import sys, sameas; {used}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "sameas" in loaded and ("numpy" in loaded or used == "sameas")
    assert not loaded & {"astropy", "scipy", "numba", "pyarrow", "matplotlib", "pandas", "typer", "rich", "llvmlite"}


# The way of many sources: its own stages, each from earlier ones only.
MANY = ["observations", "joint", "union", "terms", "belief", "sets", "partition", "membership", "reasons", "objects",
        "many", "sequence"]  # fmt: skip


@pytest.mark.parametrize("stage", MANY)
def test_a_stage_of_many_sources_never_imports_a_later_one(stage):
    later = set(MANY[MANY.index(stage) + 1 :])
    assert not tops(imported(HOME / f"{stage}.py", always=True)) & later


def test_no_stage_of_two_sources_needs_many():
    for stage in STAGES + list(WITH):
        for path in files_of(stage):
            assert not tops(imported(path)) & {*MANY, "fusion"}, path
