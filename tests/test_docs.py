"""Every block of code in README.md and docs/ runs and prints what the page says; so do the examples of the docstrings.

A page is run from top to bottom in an empty directory. A ``python`` block is executed with the names of those before
it, and a ``text`` block right below one is what it prints. In a ``console`` block the commands after ``$`` are run, and
the lines below each are what it prints. Shown lines are to appear in this order, other lines may stand between; ``…``
stands for anything, and runs of spaces count as one. Comments before a block say what is special about it:

    <!-- not run: why -->       shown only          <!-- exit: 1 -->    the commands end with this exit code
    <!-- needs: name -->        run where the program or module is installed
    <!-- within: 0.05 -->       before what is printed: numbers may differ by 5 % (or by 0.05, if they are smaller)
"""

from __future__ import annotations

import contextlib
import doctest
import importlib
import importlib.util
import io
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import types
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import pytest

import sameas

HOME = Path(__file__).parents[1]
PAGES = [HOME / "README.md", *sorted((HOME / "docs").rglob("*.md"))]
OTHERS = [HOME / name for name in ("VISION.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")]
RUN = ("python", "console")

FENCE = re.compile(r"(?P<says>(?:^<!--[^\n]*-->\n)*)^```(?P<kind>\w*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
SAID = re.compile(r"<!-- ([\w ]+): (.+?) -->")
LINK = re.compile(r"\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its kind, options from comments, line in the page, and the text block below it."""

    kind: str
    code: str
    says: dict[str, str]
    line: int
    shown: str = ""
    within: float = 0.0


def blocks(page: Path) -> list[Block]:
    text, found, end = page.read_text(encoding="utf-8"), [], 0
    for match in FENCE.finditer(text):
        line, says = text.count("\n", 0, match.start("code")) + 1, dict(SAID.findall(match["says"]))
        beside = found and found[-1].kind == "python" and not text[end : match.start()].strip()
        if beside and match["kind"] == "text":
            last, within = found.pop(), float(says.get("within", 0.0))
            found.append(Block(last.kind, last.code, last.says, last.line, match["code"], within))
        else:
            found.append(Block(match["kind"], match["code"], says, line, within=float(says.get("within", 0.0))))
        end = match.end()
    return found


def not_run() -> Iterator[object]:
    for page in PAGES:
        for block in blocks(page):
            if "not run" in block.says:
                yield pytest.param(block, id=f"{page.stem}:{block.line}")


def named(page: Path) -> str:
    return page.stem


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_runs_and_prints_what_it_shows(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = types.ModuleType("page")  # dataclasses resolve annotations there
    monkeypatch.setitem(sys.modules, "page", module)
    names = vars(module)
    for block in blocks(page):
        if block.kind not in RUN or "not run" in block.says:
            continue
        if "needs" in block.says and not is_installed(block.says["needs"]):
            continue
        if block.kind == "python":
            printed = run_python(page, block, names)
            compare(block, block.shown, printed, f"{page.name}:{block.line}")
        else:
            run_console(page, block)


@pytest.mark.parametrize("block", list(not_run()))
def test_blocks_that_are_not_run_state_why(block):
    pytest.skip(block.says["not run"])


def is_installed(name: str) -> bool:
    return shutil.which(name) is not None or importlib.util.find_spec(name) is not None


def run_python(page: Path, block: Block, names: dict[str, object]) -> str:
    printed = io.StringIO()
    # Empty lines in front, so that a traceback names the line of the page.
    code = compile("\n" * block.line + block.code, str(page), "exec")
    with contextlib.redirect_stdout(printed):
        exec(code, names)
    return printed.getvalue()


def run_console(page: Path, block: Block) -> None:
    for part in re.split(r"^\$ ", block.code, flags=re.MULTILINE)[1:]:
        command, _, shown = part.replace("\\\n", " ").partition("\n")
        program, *arguments = shlex.split(command)
        assert program in ("sameas", "stilts"), f"{page.name}:{block.line}: say why `{command}` is not run"
        code, printed = run_sameas(arguments) if program == "sameas" else run_other(program, arguments)
        assert code == int(block.says.get("exit", 0)), f"{page.name}:{block.line}: {printed}"
        compare(block, shown, printed, f"{page.name}:{block.line}: {command}")


def run_sameas(arguments: list[str]) -> tuple[int, str]:
    """The exit code of the command and what it prints, in this process: a new one imports for a second first."""
    from typer.testing import CliRunner

    from sameas.cli.app import app

    result = CliRunner().invoke(app, arguments, prog_name="sameas")
    return result.exit_code, result.stdout + result.stderr


def run_other(program: str, arguments: list[str]) -> tuple[int, str]:
    done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def compare(block: Block, shown: str, printed: str, where: str) -> None:
    """Every shown line is printed, in this order."""
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    at = 0
    for line in shown.splitlines():
        wanted = " ".join(line.split())
        if wanted in ("", "…"):
            continue
        hit = next((k for k in range(at, len(lines)) if is_alike(wanted, lines[k], block.within)), None)
        assert hit is not None, f"{where}: {wanted!r} is not printed (in its place) in\n{printed}"
        at = hit + 1


def is_alike(wanted: str, line: str, within: float) -> bool:
    pieces = re.split(r"(…|\d+(?:\.\d+)?)" if within else "(…)", wanted)
    number = r"(\d+(?:\.\d+)?)"
    pattern = "".join(
        re.escape(piece) if k % 2 == 0 else ".*" if piece == "…" else number for k, piece in enumerate(pieces)
    )
    found = re.fullmatch(pattern, line)
    due = [float(piece) for piece in pieces[1::2] if piece != "…"]
    return found is not None and all(
        abs(float(here) - there) <= within * max(1.0, there) for here, there in zip(found.groups(), due, strict=True)
    )


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=named)
def test_links_are_valid(page):
    text = page.read_text(encoding="utf-8")
    for target in LINK.findall(re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        there = page if not path else (page.parent / path)
        assert there.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(there), f"{page.name}: {target}"


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and Python-Markdown make them of plain words."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", head.lower()).strip()) for head in heads}


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=named)
def test_documents_name_no_private_paths(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"/work\b|/tmp\b|/home/|\.\./shared|METHOD\.md|PERFORMANCE\.md|STYLE\.md", text)


def test_equations_cited_in_code_are_on_the_method_page():
    heads = re.findall(r"^#+ ([\d.]*\d)\.? ", (HOME / "docs/method.md").read_text(encoding="utf-8"), re.MULTILINE)
    for path in (HOME / "src").rglob("*.py"):
        for number in re.findall(r"METHOD (\d+(?:\.\d+)?)", path.read_text(encoding="utf-8")):
            assert number in heads, f"{path.name} cites METHOD {number}"


def test_readme_shows_the_body_of_identify():
    source = (HOME / "src/sameas/_identify.py").read_text(encoding="utf-8")
    body = source[source.index("    pairs = gate(") :]
    assert body.rstrip() in (HOME / "README.md").read_text(encoding="utf-8")


def test_every_benchmark_is_listed_once():
    folder = HOME / "benchmarks"
    modules = [*folder.glob("*.py"), *folder.glob("*/__main__.py")]
    runs = [path for path in modules if '\nif __name__ == "__main__"' in path.read_text(encoding="utf-8")]
    names = {path.parent.name if path.stem == "__main__" else path.stem for path in runs}
    listed = re.findall(r"^\| `(\w+)` \|", (folder / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(names - {"worker"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(HOME)))
def test_pages_import_public_names_only(page):
    """From the packages that list their public names, and from the adapters."""
    public = ("", ".evidence", ".io", ".io.sensors", ".picture", ".score", ".simulate", ".sky", ".tracks")
    for block in blocks(page):
        for module in re.findall(r"^(?:from|import) sameas([\w.]*)", block.code, flags=re.MULTILINE):
            assert module in public or module.startswith(".adapters."), f"{page.name}: sameas{module}"


@pytest.mark.parametrize("command, pages", [
    ("match", ["files-and-command"]), ("explain", ["files-and-command"]), ("compare", ["files-and-command"]),
    ("many", ["many-catalogues", "files-and-command"]), ("internal", ["tasks/internal", "files-and-command"]),
    ("frame", ["frame", "files-and-command"]),
    ("movers", ["movers", "frame", "files-and-command"]), ("picture", ["picture", "sensors", "files-and-command"]),
    ("watch", ["live", "picture", "files-and-command"]),
])  # fmt: skip
def test_every_option_is_documented(command, pages):
    """Each in a page of its command; --epoch stands for the --epoch1 and --epoch2 of a command for two catalogues."""
    typer = pytest.importorskip("typer")
    app = typer.Typer()
    app.command()(getattr(importlib.import_module(f"sameas.cli.{command}"), command))
    page = "".join((HOME / f"docs/{name}.md").read_text(encoding="utf-8") for name in pages)
    options = [one for one in typer.main.get_command(app).params if one.param_type_name == "option"]
    names = {name for one in options for name in (*one.opts, *one.secondary_opts) if name.startswith("--")}
    names -= {"--install-completion", "--show-completion"}
    stems = {name: re.sub(r"[0-9]+$", "", name) for name in names}
    missing = [name for name in names if not re.search(rf"[`\s(/]({name}|{stems[name]})(?![\w-])", page)]
    assert names and not sorted(missing)


def test_every_result_column_is_documented():
    from sameas.sky.output_columns import COLUMNS

    page = (HOME / "docs/files-and-command.md").read_text(encoding="utf-8")
    for name in takewhile(lambda name: name != "row_1", COLUMNS):  # of the joined table of two catalogues
        assert f"`{name}`" in page, f"{name} is not documented"


@pytest.mark.parametrize(
    "package", ["sameas", "sameas.sky", "sameas.tracks", "sameas.picture", "sameas.simulate", "sameas.score"]
)
def test_every_public_name_is_documented(package):
    page = (HOME / "docs/reference.md").read_text(encoding="utf-8")
    subpackages = {"evidence", "io", "picture", "plots", "score", "simulate", "sky", "tracks"}
    for name in set(importlib.import_module(package).__all__) - (subpackages if package == "sameas" else set()):
        assert f"::: {package}.{name}\n" in page or name in ("read_table", "write_table"), f"{package}.{name}"


def modules() -> list[str]:
    return [module.name for module in pkgutil.walk_packages(sameas.__path__, "sameas.")]


@pytest.mark.slow_after(41)
@pytest.mark.parametrize("name", modules())
def test_docstring_examples_run(name):
    if name.startswith("sameas.adapters."):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # their own
            pytest.importorskip(name.rpartition(".")[2])
    module = importlib.import_module(name)
    if name == "sameas.plots":
        pytest.importorskip("matplotlib")
    assert doctest.testmod(module).failed == 0


ROLE = re.compile(r":(?:func|class|data|meth|attr|mod|exc):`~?([\w.]+)`|`(sameas\.[\w.]*\w)`")


def is_name(name: str, module: types.ModuleType) -> bool:
    """Whether a name in a docstring is one of its module, of a class there, or one by its full path."""
    first, *rest = name.split(".")
    if first in ("sameas", "astropy", "stonesoup"):
        for k in range(len(rest), -1, -1):
            with contextlib.suppress(ImportError):
                return not rest[k:] or is_member(importlib.import_module(".".join((first, *rest[:k]))), rest[k:])
        return False
    classes = [value for value in vars(module).values() if isinstance(value, type)]
    return any(is_member(home, [first, *rest]) for home in (module, *classes))


def is_member(home: object, names: list[str]) -> bool:
    """Whether the first name is of ``home``, the second of its value, and so on; fields need no value."""
    if len(names) == 1 and names[0] in getattr(home, "__annotations__", ()):
        return True
    return hasattr(home, names[0]) and (len(names) == 1 or is_member(getattr(home, names[0]), names[1:]))


@pytest.mark.slow_after(41)
@pytest.mark.parametrize("name", [name for name in modules() if not name.startswith("sameas.adapters.")])
def test_names_in_docstrings_exist(name):
    module = importlib.import_module(name)
    text = Path(module.__file__).read_text(encoding="utf-8")
    wanted = {one or other for one, other in ROLE.findall(text)}
    assert [each for each in sorted(wanted) if not is_name(each, module)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_in_documents_exist(page):
    """Names of sameas by their full path, in the text and in code."""
    wanted = set(re.findall(r"(?<![\w/.-])sameas(?:\.[a-z_]\w*)+(?:\.\w+)*", page.read_text(encoding="utf-8")))
    files = {name for name in wanted if name.endswith((".fits", ".json", ".csv"))}
    known = {name for name in wanted if name.startswith("sameas.adapters.")}  # of packages that may be absent
    assert [name for name in sorted(wanted - files - known) if not is_name(name, sameas)] == []
