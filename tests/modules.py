"""The modules of sameas: their imports, their kinds, and which belong inside their only importer.

``scripts/house`` prints the numbers, ``test_layers.py`` keeps the rules.
"""

from __future__ import annotations

import ast
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path

HOME = Path(__file__).resolve().parent.parent / "src" / "sameas"
#: Folders in which every module is kept as a file of its own, even with one importer.
KINDS = {
    "adapters": "adapter", "cli": "command", "evidence": "rule", "io": "format", "kernels": "kernel",
    "pages": "page", "plots": "drawing", "report": "report", "score": "score", "simulate": "scene",
}  # fmt: skip
#: A module and its only importer stay separate above this total number of lines: one file of both would be too long.
TWO_IDEAS = 500
#: Modules shorter than SMALL lines need at least FEW importers, unless their folder is in KINDS.
SMALL, FEW = 100, 5


@dataclass(frozen=True)
class Module:
    """name : dotted, without ``sameas.``. importers : names of modules and packages, stubs included."""

    name: str
    path: Path
    lines: int
    importers: frozenset[str]

    @property
    def room(self) -> str:
        return self.name.split(".")[0]

    def kind(self, lines: dict[str, int]) -> str:
        """The kind of the module; "inside" if it has no reason to be separate from its importer."""
        if self.path.name in ("__init__.py", "__main__.py"):
            return "package"
        if self.room in KINDS:
            return KINDS[self.room]
        if "." not in self.name:
            return "stage"
        if any(one.split(".")[0] != self.room or (HOME / one.replace(".", "/")).is_dir() for one in self.importers):
            return "interface of its room"
        if len(self.importers) != 1:
            return "shared" if self.importers else "inside"
        return "long" if self.lines + lines[next(iter(self.importers))] > TWO_IDEAS else "inside"


def name_of(path: Path) -> str:
    """Dotted module name without ``sameas.``; "" for the package itself."""
    return ".".join(path.relative_to(HOME).with_suffix("").parts).removesuffix("__init__").removesuffix(".")


def is_module(name: str) -> bool:
    place = HOME.parent.joinpath(*name.split("."))
    return place.with_suffix(".py").exists() or (place / "__init__.py").exists()


@cache
def imported(path: Path) -> frozenset[str]:
    """Modules of sameas imported anywhere in a file or stub, as dotted names without ``sameas.``."""
    names = set()
    package = ".".join(path.parent.relative_to(HOME.parent).parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 or path.suffix == ".pyi", f"{path}: relative import"
            assert node.level < 2, f"{path}: an import from above"
            module = ".".join(part for part in (package if node.level else "", node.module or "") if part)
            for alias in node.names:
                inner = f"{module}.{alias.name}"
                names.add(inner if is_module(inner) else module)
    return frozenset(name.removeprefix("sameas.") for name in names if name.startswith("sameas."))


@cache
def modules() -> dict[str, Module]:
    """All modules by name."""
    files = {name_of(path): path for path in sorted(HOME.rglob("*.py"))}
    importers: dict[str, set[str]] = {name: set() for name in files}
    for path in sorted(HOME.rglob("*.py*")):
        if path.suffix in (".py", ".pyi"):
            for name in imported(path) & set(files) - {name_of(path)}:
                importers[name].add(name_of(path))
    return {
        name: Module(name, path, len(path.read_text(encoding="utf-8").splitlines()), frozenset(importers[name]))
        for name, path in files.items()
    }


def lines_of() -> dict[str, int]:
    return {name: module.lines for name, module in modules().items()}


def circles() -> list[str]:
    """Modules in import cycles, imports for type checking included; [] if there are none."""
    paths = {name: module.path for name, module in modules().items() if name}
    wanted = {name: imported(path) & set(paths) - {name} for name, path in paths.items()}
    done: set[str] = set()
    while left := {name: others - done for name, others in wanted.items() if name not in done}:
        free = {name for name, others in left.items() if not others}
        if not free:
            return sorted(left)
        done |= free
    return []


def belong_inside() -> list[str]:
    """Modules with at most one importer and no reason to be separate."""
    lines = lines_of()
    return [name for name, module in modules().items() if module.kind(lines) == "inside"]


def too_small() -> list[str]:
    """Very short modules with few importers."""
    lines = lines_of()
    kept = {"package", *KINDS.values()}
    return [
        name
        for name, module in modules().items()
        if module.lines < SMALL and len(module.importers) < FEW and module.kind(lines) not in kept
    ]


def _is_number(value: ast.expr) -> bool:
    """Whether it is a number, a tuple of numbers, or a calculation of numbers."""
    if isinstance(value, ast.Tuple):
        return bool(value.elts) and all(map(_is_number, value.elts))
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) and _is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def constants() -> list[str]:
    """Numeric constants of modules, which are not fields of a tuning, as ``module.NAME``."""
    found = []
    for name, module in modules().items():
        for node in ast.parse(module.path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and _is_number(node.value):
                targets = [one.id for one in ast.walk(node.targets[0]) if isinstance(one, ast.Name)]
                found += [f"{name}.{target}" for target in targets if target.isupper()]
    return found


def long_functions(most: int = 60) -> list[str]:
    """Functions whose body has more lines than this, as ``module.name``.

    Signature and docstring do not count: a command's signature is the list of its options.
    """
    found = []
    for name, module in modules().items():
        for node in ast.walk(ast.parse(module.path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
                docstring = len((ast.get_docstring(node, clean=False) or "").splitlines())
                if node.end_lineno - node.body[0].lineno + 1 - docstring > most:
                    found.append(f"{name}.{node.name}")
    return found


def of_one_importer() -> Counter[str]:
    """Number of modules with one importer, by kind."""
    lines = lines_of()
    return Counter(m.kind(lines) for m in modules().values() if len(m.importers) == 1 and m.kind(lines) != "package")
